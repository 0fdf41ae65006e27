# SPDX-License-Identifier: Apache-2.0
"""A session's requests that are not answered yet: what to send, whose each reply is, what is overdue.

There is no I/O here: a thread, an event loop or a test can drive the table.  Messages in flight are lost when
a daemon is killed.  So requests are sent again, with the same id, when a session begins, and at intervals
during silence; replies to requests that are not in the table any more are dropped.

Of the requests with a wait the daemon lets `PLACES` of a session really wait; it answers others at once, with
cold cells as pending.  A request that was answered so, while others wait, is *held*: it is sent again when
one of them ends, or at once if one has ended since it was sent.
"""

from __future__ import annotations

import math
from collections import OrderedDict, deque
from collections.abc import Callable, Iterable
from typing import Any, Final, Protocol

import msgspec

from shmmap.errors import ShmmapError
from shmmap.protocol.codec import encode
from shmmap.protocol.messages import Cancel, Cells, ErrorReply, Reply, Request

PLACES: Final = 64
"""Requests of one session that the daemon lets wait."""
RESEND_S: Final = 1.0
"""First repetition on silence; the interval then doubles."""
TICK_S: Final = 0.01
"""Least time between two looks at all requests."""


class Answers(Protocol):
    """Where answered requests go, like a `queue.SimpleQueue`."""

    def put(self, answered: Outstanding, /) -> None:
        """Take a request whose `Outstanding.reply` is there."""


class Outstanding:
    """A request that is not answered yet.

    Parameters
    ----------
    message
        The request; None only asks for a session to be begun, and the reply is its `Welcome`.
    data
        Its bytes.
    answers
        Where it goes when it is answered.
    deadline_s
        When it counts as unanswered.
    wait_s
        How long it lets the daemon wait, during which silence is normal.
    for_whom
        What the consumer of ``answers`` needs.

    Attributes
    ----------
    reply : Reply or ShmmapError
        The answer, or why there is none.
    due_s : float
        When it is sent again.
    freed : int
        How many places had been left unused when it was sent.
    """

    __slots__ = (
        *("answers", "data", "deadline_s", "due_s", "for_whom", "interval_s"),
        *("freed", "message", "quiet_s", "reply", "request", "timeout_s", "wait_until_s"),
    )

    def __init__(
        self,
        message: Request | None,
        data: bytes,
        answers: Answers,
        *,
        now_s: float,
        deadline_s: float,
        wait_s: float,
        request: int,
        for_whom: Any = None,
    ) -> None:
        self.message, self.data, self.answers, self.for_whom = message, data, answers, for_whom
        self.request = request
        self.deadline_s, self.timeout_s = deadline_s, deadline_s - now_s
        self.quiet_s, self.wait_until_s = wait_s, now_s + wait_s
        self.interval_s = RESEND_S
        self.due_s = math.inf
        self.freed = 0
        self.reply: Reply | ShmmapError | None = None

    def note_sent(self, now_s: float) -> None:
        """Note that it was sent."""
        self.due_s = now_s + self.quiet_s + self.interval_s
        self.interval_s *= 2

    def shorten(self, now_s: float) -> None:
        """Let it ask for no more than what is left of its wait."""
        left_s = max(0.0, self.wait_until_s - now_s)
        if self.message is not None and left_s < self.quiet_s and hasattr(self.message, "wait"):
            self.message = msgspec.structs.replace(self.message, wait=left_s or None)
            self.data, self.quiet_s = encode(self.message), left_s
        self.due_s = math.inf


class RequestTable:
    """Requests that are not answered yet; not thread-safe.

    Attributes
    ----------
    entries : dict
        All of them, by request id, in the order in which they were added.
    hello : Outstanding or None
        The request for a session that has to be answered before anything else is sent.
    cancels : deque
        Ids of requests whose waits the daemon should end.
    next_s : float
        When `tick` has something to do, at the earliest.
    """

    def __init__(self) -> None:
        self.entries: dict[int, Outstanding] = {}
        self.hello: Outstanding | None = None
        self.cancels: deque[int] = deque()
        self.next_s = math.inf
        self._unsent: OrderedDict[int, Outstanding] = OrderedDict()
        self._held: OrderedDict[int, Outstanding] = OrderedDict()
        self._waiting: dict[int, Outstanding] = {}
        self._freed = 0  # places that ended when no request was held; one may be refused for lack of them

    @property
    def is_busy(self) -> bool:
        """Whether anything is to be sent or received."""
        return bool(self.entries or self.cancels)

    def add(self, entry: Outstanding, *, sent_s: float | None = None) -> None:
        """Add a request, to be sent or sent at ``sent_s``."""
        self.entries[entry.request] = entry
        if sent_s is None:
            self._unsent[entry.request] = entry
        else:
            self._note_sent(entry, sent_s)
        self.next_s = min(self.next_s, entry.deadline_s)

    def withdraw(self, requests: Iterable[tuple[int, bool]], now_s: float) -> None:
        """Forget requests whose answers are not wanted; have the daemon end their waits.

        Of each the id, and whether one that is not in the table was sent and may wait in the daemon.
        """
        places = 0
        for request, waits in requests:
            if request in self._waiting or (waits and request not in self.entries):
                places += 1
                if self.hello is None:
                    self.cancels.append(request)
            elif request in self._unsent:  # it may have been held, and about to use a place
                places += 1
            self._forget(request)
        for _ in range(places):
            self._use_free_place(now_s)

    # --- sending ------------------------------------------------------------------------------------

    def next_to_send(self) -> bytes | None:
        """Return what is to be sent next; `sent` says that it was."""
        if self.hello is not None:
            return self.hello.data if self.hello.due_s == math.inf else None
        if self.cancels:
            return encode(Cancel(self.cancels[0]))
        for entry in self._unsent.values():
            return entry.data
        return None

    def sent(self, now_s: float) -> None:
        """Note that what `next_to_send` returned was sent."""
        if self.hello is not None:
            self.hello.note_sent(now_s)
            self.next_s = min(self.next_s, self.hello.due_s)
        elif self.cancels:
            self.cancels.popleft()
        else:
            self._note_sent(self._unsent.popitem(last=False)[1], now_s)

    def _note_sent(self, entry: Outstanding, now_s: float) -> None:
        entry.note_sent(now_s)
        entry.freed = self._freed
        if entry.quiet_s:
            self._waiting[entry.request] = entry
        self.next_s = min(self.next_s, entry.due_s)

    # --- sessions -----------------------------------------------------------------------------------

    def begin_session(self, hello: Outstanding, now_s: float) -> None:
        """Send nothing but ``hello`` until `session_begun`, and then all requests again."""
        self.hello = hello
        self.cancels.clear()
        self._held.clear()
        self._waiting.clear()
        self._unsent = OrderedDict(self.entries)
        for entry in self._unsent.values():
            entry.shorten(now_s)

    def session_begun(self, welcome: Reply) -> None:
        """Let requests be sent; answer those that asked for the session alone."""
        self.hello = None
        for entry in [entry for entry in self.entries.values() if entry.message is None]:
            self._finish(entry, welcome)

    # --- answers ------------------------------------------------------------------------------------

    def receive(self, reply: Reply, now_s: float) -> bool:
        """Give a reply to the request that it answers; return whether a session has to be begun first."""
        entry = self.entries.get(reply.request)
        if entry is None:
            return False
        if isinstance(reply, ErrorReply) and reply.code == "no_session":
            return self.hello is None
        if self._is_early(entry, reply, now_s):
            del self._waiting[entry.request]
            self._held[entry.request] = entry
            entry.due_s = math.inf
            self.next_s = min(self.next_s, entry.wait_until_s)
            if entry.freed != self._freed:
                self._use_free_place(now_s)
        else:
            self._finish(entry, reply)
            self._use_free_place(now_s)
        return False

    def _is_early(self, entry: Outstanding, reply: Reply, now_s: float) -> bool:
        """Whether a reply lacks cells only because too many other requests wait."""
        return (
            entry.request in self._waiting
            and (len(self._waiting) > 1 or entry.freed != self._freed)
            and now_s < entry.wait_until_s - TICK_S
            and isinstance(reply, Cells)
            and not reply.next
            and bool(reply.pending or not (reply.covered or reply.reason))
        )

    def _use_free_place(self, now_s: float) -> None:
        """Send a request that was held, if another one has left the daemon a place for it."""
        if self._held and len(self._waiting) < PLACES:
            self._ask_again(next(iter(self._held.values())), now_s)
        else:
            self._freed += 1

    def _ask_again(self, entry: Outstanding, now_s: float) -> None:
        entry.shorten(now_s)
        self._unsent[entry.request] = entry
        self._held.pop(entry.request, None)  # last: an exception of a signal handler may come in between

    def _finish(self, entry: Outstanding, reply: Reply | ShmmapError) -> None:
        self._forget(entry.request)
        entry.reply = reply
        entry.answers.put(entry)

    def _forget(self, request: int) -> None:
        self._unsent.pop(request, None)
        self._held.pop(request, None)
        self._waiting.pop(request, None)
        self.entries.pop(request, None)

    # --- time ---------------------------------------------------------------------------------------

    def tick(self, now_s: float, silence: Callable[[Outstanding], ShmmapError]) -> None:
        """Send again what is due, and end what is overdue with the error that ``silence`` returns."""
        if now_s < self.next_s:
            return
        next_s = math.inf
        hello = self.hello
        if hello is not None and self.entries:
            if now_s >= hello.due_s:
                hello.due_s = math.inf
            next_s = hello.due_s
        for entry in list(self.entries.values()):
            if now_s >= entry.deadline_s:
                if entry.request in self._waiting:
                    self.cancels.append(entry.request)
                self._finish(entry, silence(entry))
                self._use_free_place(now_s)
                continue
            held = entry.request in self._held
            if held and now_s >= entry.wait_until_s:
                self._ask_again(entry, now_s)
            elif now_s >= entry.due_s:
                entry.due_s = math.inf
                self._unsent[entry.request] = entry
            next_s = min(next_s, entry.deadline_s, entry.due_s, entry.wait_until_s if held else math.inf)
        self.next_s = max(next_s, now_s + TICK_S)

    def fail_all(self, error: Callable[[], ShmmapError]) -> None:
        """End all requests with an error of their own each."""
        for entry in list(self.entries.values()):
            self._finish(entry, error())
