# SPDX-License-Identifier: Apache-2.0
"""The daemon's side of the live worker: forwards requests to it, and its answers to clients.

It publishes changes of live maps as events.

A worker that dies loses nothing that it had answered: a new worker is started, which finds the chunks in
memory.  Unanswered requests are refused, and their clients repeat them.
"""

from __future__ import annotations

import contextlib
import math
import re
import select
import socket
import subprocess
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Final

import msgspec

import shmmap.live_messages as messages
from shmmap.daemon.events.log import EventLog
from shmmap.daemon.transport.connection import Peer
from shmmap.daemon.transport.sessions import Session
from shmmap.daemon.turns import WatchedDescriptors
from shmmap.errors import BadRequest, Busy, LiveInterrupted, Replaced, ShmmapError, error_from_wire
from shmmap.installed import RESTART, is_replaced
from shmmap.logfmt import log
from shmmap.processes.start_child import packet_buffer, receive_packet, start_child
from shmmap.protocol import events
from shmmap.protocol.codec import encode
from shmmap.protocol.live import LiveList, LiveListed, LiveRequest
from shmmap.protocol.rows import LiveMapRow
from shmmap.statistics.writer import StatisticsWriter

_CHUNK: Final = re.compile(r"chunk -?\d+_-?\d+_-?\d+")


@dataclass(eq=False, slots=True)
class LiveEvents:
    """Reports the state of live maps, and of the process that keeps them.

    No event is published before `begin`, since the first event must be that of the daemon's start.
    """

    event_log: EventLog
    statistics: StatisticsWriter
    _published: dict[str, LiveMapRow] = field(default_factory=dict)
    _adopted: int = 0
    _begun: bool = False

    def begin(self, maps: int, rows: Sequence[LiveMapRow]) -> None:
        """Publish events from now on, beginning with the present state of ``maps`` (number of maps)."""
        self._begun = True
        self.started(maps, self._adopted)
        self.update(rows)

    def started(self, maps: int, adopted: int) -> None:
        """Report that the process serves ``maps`` maps, and found ``adopted`` chunks in memory."""
        self._adopted = adopted
        if self._begun:
            self.event_log.publish(events.LiveStarted, maps, adopted)

    def ended(self, restarts: int) -> None:
        """Report that the process ended, for the ``restarts``-th time."""
        self.statistics.set("live_restarts", restarts)
        if self._begun:
            self.event_log.publish(events.LiveEnded, restarts)

    def update(self, rows: Sequence[LiveMapRow]) -> None:
        """Report the present state of the maps: publish the changes since the last publication."""
        if not self._begun:
            return
        for row in rows:
            before = self._published.get(row.name)
            known = before.damaged if before is not None else ()
            for what in row.damaged:
                if what not in known:
                    self.event_log.publish(events.LiveDamaged, row.name, what)
            if _cause(row.problem) != _cause(before.problem if before is not None else ""):
                self.event_log.publish(events.LiveProblem, row.name, row.problem)
            if before is not None and row.change != before.change:
                self.event_log.mention(events.LiveChanged, row.name, row.change)
        self._published = {row.name: row for row in rows}


def _cause(problem: str) -> str:
    """Return the cause of a problem, without the chunk that met it first."""
    return _CHUNK.sub("chunk", problem)


BEAT_S: Final = 0.5
START_END_S: Final = 2.0
"""Time for a worker that does not serve yet to end."""
END_S: Final = 60.0
"""Time for saving all chunks at the end; the unit's stop timeout is longer."""
PAUSES_S: Final = (0.0, 0.5, 2.0, 10.0, 30.0)
"""Pauses before a new worker is started: after the first failure, and after the next ones in a row."""
STARTS: Final = 2
"""How many workers may be killed before the maps are in memory."""
KILL_TIMEOUT_S: Final = 0.1
"""How long the loop waits for a killed worker to end; a worker that hangs in the kernel may never end."""
MESSAGES_PER_TURN: Final = 16
"""Messages from the worker that one turn of the loop handles."""
MAX_BYTES: Final = 1 << 12
"""Maximum length of a request about live maps, which consists of names and numbers."""
MAX_UNSENT: Final = 4096
"""Most messages queued for a worker that does not read: new sessions could send without bound."""
STABLE_S: Final = 1.0
"""Run time below which a worker counts as failed: it is restarted at once only the first time."""
MAX_PER_PROCESS: Final = 256
MAX_WAITING: Final = 4096
"""Most requests that wait for their answers, of one process and of all."""
REFUSED_PER_TURN: Final = 64
"""Requests that one turn of the loop refuses after a worker has ended."""


class Tickets:
    """Forwarded requests without an answer: bounded by session, by process, and in total."""

    def __init__(self) -> None:
        self._asked: dict[int, tuple[Session, int]] = {}
        self._of: dict[int, set[int]] = {}  # by session
        self._waiting: Counter[int] = Counter()  # by process
        self._lost: deque[tuple[Session, int]] = deque()
        self._last = 0

    def __len__(self) -> int:
        return len(self._asked) + len(self._lost)

    def give(self, session: Session, request: int) -> int:
        """Return a ticket for a request; raise Busy if too many wait."""
        for whose, waiting, most in (
            ("this session", len(self._of.get(session.slot, ())), messages.MAX_PER_SESSION),
            ("this process", self._waiting[session.asker], MAX_PER_PROCESS),
            ("all sessions", len(self), MAX_WAITING),
        ):
            if waiting >= most:
                raise Busy(f"{waiting} requests of {whose} about live maps wait", hint="wait for some")
        self._last += 1
        self._asked[self._last] = session, request
        self._of.setdefault(session.slot, set()).add(self._last)
        self._waiting[session.asker] += 1
        return self._last

    def take(self, ticket: int) -> Session | None:
        """Remove a ticket and return its session; None if the session has ended."""
        session, _ = self._asked.pop(ticket, (None, 0))
        if session is not None:
            self._of[session.slot].discard(ticket)
            self._waiting[session.asker] -= 1
            if not self._of[session.slot]:
                del self._of[session.slot]
            if not self._waiting[session.asker]:
                del self._waiting[session.asker]
        return session

    def on_disconnect(self, session: Session) -> None:
        """Drop the requests of a session that has ended."""
        for ticket in list(self._of.get(session.slot, ())):
            self.take(ticket)
        if self._lost:
            self._lost = deque(row for row in self._lost if row[0] is not session)

    def lose(self) -> None:
        """Record that the worker has ended: `refuse_some` then refuses all waiting requests."""
        self._lost += self._asked.values()
        self._asked = {}
        self._of.clear()
        self._waiting.clear()

    @property
    def are_lost(self) -> bool:
        """Whether there are requests to refuse."""
        return bool(self._lost)

    def refuse_some(self) -> None:
        """Refuse some of the requests whose worker has ended."""
        error = LiveInterrupted("the process that keeps live maps ended, and starts again")
        for _ in range(min(REFUSED_PER_TURN, len(self._lost))):
            session, request = self._lost.popleft()
            session.connection.refuse(request, error)


class NoLiveMaps:
    """Replacement for `LiveRelay` in a daemon without live maps: nothing is ever due, or unsaved."""

    next_s: Final = math.inf
    unsaved: Final[dict[str, int]] = {}

    def begin_events(self) -> None:
        """Do nothing."""

    def ask(self, session: Session, message: LiveRequest, body: bytes, now_s: float) -> None:
        """Refuse a request; a request for the list gets an empty list."""
        del body, now_s
        if isinstance(message, LiveList):
            session.connection.reply(encode(LiveListed(message.request, ())))
            return
        raise BadRequest(
            "this daemon keeps no live maps",
            hint="start it with --live NAME, or with [live.NAME] in its settings",
        )

    def on_disconnect(self, session: Session) -> None:
        """Do nothing."""

    def beat(self, now_s: float) -> None:
        """Do nothing."""

    def run_step(self, now_s: float) -> None:
        """Do nothing."""

    def close(self, *, keep: bool) -> None:
        """Do nothing."""


class LiveRelay:
    """Starts the live worker, and forwards messages to and from it.

    Parameters
    ----------
    begin
        Message with the worker's maps and directories.
    watched
        Watches the worker's channel.
    may_map
        Returns whether a process may change live maps.
    events
        Receives the state of the maps twice a second, and starts and ends of the worker.

    Attributes
    ----------
    restarts : int
        Number of workers that ended unexpectedly.
    unsaved : dict
        Number of chunks, by map, that could not be saved at the end.
    """

    def __init__(
        self,
        begin: messages.Begin,
        watched: WatchedDescriptors,
        may_map: Callable[[Peer, float], bool],
        events: LiveEvents,
    ) -> None:
        self.restarts = 0
        self.unsaved: dict[str, int] = {}
        self._begin = begin
        self._watched = watched
        self._may_map = may_map
        self._events = events
        self._process: subprocess.Popen[bytes] | None = None
        self._channel: socket.socket | None = None
        self._buffer = packet_buffer()
        self._unsent: deque[bytes] = deque()
        self._tickets = Tickets()
        self._known_sessions: set[int] = set()
        self._serving = False
        self._failures = 0
        self._start_s = self._served_s = 0.0
        self._refused: ShmmapError | None = None
        self._rows: tuple[LiveMapRow, ...] = ()
        self._ended: messages.Ended | None = None

    # --- the worker's process -------------------------------------------------------------------

    def start(self) -> None:
        """Start the worker; `wait_until_serving` waits for its maps.

        Raises
        ------
        Replaced
            shmmap was replaced: a worker would be of another version than this daemon.
        OSError
            Not enough processes, memory or descriptors at present.
        """
        self._process, self._channel = start_child("shmmap.live_worker.main", new_session=True)
        self._channel.setblocking(False)
        self._serving = False
        with contextlib.suppress(ConnectionError):
            self._channel.send(messages.encode(self._begin))
        self._watched.watch(self._channel.fileno(), self.on_readable, "answers")

    def wait_until_serving(self, seconds: float, *, alone: bool) -> None:
        """Wait until each map is in memory or has a problem; maps that take longer are served later.

        Parameters
        ----------
        seconds
            How long the daemon's point maps may wait for live maps.
        alone
            The daemon has nothing else to serve.

        Raises
        ------
        ShmmapError
            ``alone`` is true, and settings or another daemon prevent every map from being served.
        """
        begin_s = time.monotonic()
        end_s = begin_s + seconds
        while not self._serving and (left_s := end_s - time.monotonic()) > 0:
            if self._channel is None:
                if self._failures > STARTS:
                    break
                self.start()
            self._wait(min(left_s, BEAT_S))
            self.on_readable()
            self._events.statistics.beat()  # the daemon's loop does not run yet
        if alone and self._refused is not None:
            raise self._refused
        if not self._serving:
            waited_s = round(time.monotonic() - begin_s, 3)
            log.warning("live maps are not ready yet", maps=len(self._begin.maps), after_s=waited_s)
            self._show_problem("the process that keeps live maps is being started")

    def _show_problem(self, problem: str) -> None:
        """Show each map as not served at present."""
        budget_bytes = self._begin.budget_bytes // max(1, len(self._begin.maps))
        self._rows = tuple(messages.not_served(one, budget_bytes, problem) for one in self._begin.maps)
        self._events.update(self._rows)

    def begin_events(self) -> None:
        """Emit events from now on: clients are served."""
        self._events.begin(len(self._begin.maps), self._rows)

    def _wait(self, seconds: float) -> None:
        """Wait until the worker's channel is readable, or writable if messages are queued."""
        if self._channel is not None:
            poller = select.poll()  # `select.select` takes no descriptor above 1023
            poller.register(self._channel, select.POLLIN | (select.POLLOUT if self._unsent else 0))
            poller.poll(seconds * 1000)

    def beat(self, now_s: float) -> None:
        """Start a new worker when it is due."""
        if self._channel is None and now_s >= self._start_s:
            try:
                self.start()
            except Replaced:
                self._start_s = math.inf
                self._show_problem(RESTART)
            except OSError as error:
                self._start_s = now_s + PAUSES_S[-1]
                log.warning("live worker not started", reason=error.strerror)

    def on_readable(self) -> None:
        """Handle messages from the worker, and send queued ones."""
        for _ in range(MESSAGES_PER_TURN):
            if self._channel is None:
                return
            try:
                data, _ = receive_packet(self._channel, self._buffer)
            except BlockingIOError:
                break
            except ConnectionResetError:
                continue
            if not data:
                self._lost()
                return
            try:
                message = messages.decode_from_live(data)
            except msgspec.MsgspecError as error:
                log.error("live worker's message cannot be read", error=error)
                self._lost()
                return
            self._take(message)
        self._flush()

    def _take(self, message: messages.FromLive) -> None:
        if isinstance(message, messages.Reply):
            session = self._tickets.take(message.ticket)
            if session is not None:
                session.connection.reply(message.body)
        elif isinstance(message, messages.Status):
            self._rows = message.maps
            self._events.update(message.maps)
        elif isinstance(message, messages.Begun):
            self._serving, self._served_s = True, time.monotonic()
            self._refused = (
                error_from_wire(message.code, message.message, message.hint) if message.code else None
            )
            log.info("live maps ready", maps=message.maps, of=len(self._begin.maps), chunks=message.adopted)
            self._events.started(message.maps, message.adopted)
        elif isinstance(message, messages.Ended):
            self._ended = message

    def _lost(self) -> None:
        """Handle the worker's end: refuse waiting requests, and start a new worker soon."""
        now_s = time.monotonic()
        if self._serving and now_s >= self._served_s + STABLE_S:
            self._failures = 0
        self._forget()
        if self._ended is not None:
            return  # as requested
        self.restarts += 1
        self._start_s = now_s + PAUSES_S[min(self._failures, len(PAUSES_S) - 1)]
        self._failures += 1
        log.error("live worker ended", restarts=self.restarts)
        self._events.ended(self.restarts)
        if is_replaced():
            self._start_s = math.inf
            self._show_problem(RESTART)
        elif self._failures > 1:  # a single failure is harmless: chunks stay in memory
            self._show_problem("the process of the live maps keeps ending: see the log")
        self._tickets.lose()

    @property
    def next_s(self) -> float:
        """Time of the next step: now while requests to an ended worker are left, else infinity."""
        return 0.0 if self._tickets.are_lost else math.inf

    def run_step(self, now_s: float) -> None:
        """Refuse some of the requests to a worker that has ended."""
        del now_s
        self._tickets.refuse_some()

    def _forget(self) -> None:
        if self._channel is not None:
            self._watched.unwatch(self._channel.fileno())
            self._channel.close()
            self._channel = None
        if self._process is not None:
            self._process.kill()
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(KILL_TIMEOUT_S)
            self._process = None
        self._unsent.clear()
        self._serving = False

    # --- requests -------------------------------------------------------------------------------

    def ask(self, session: Session, message: LiveRequest, body: bytes, now_s: float) -> None:
        """Forward a request.

        Raises
        ------
        Busy
            Too many requests wait: of this session, of its process, or in total.
        BadRequest
            The request is too long.
        LiveInterrupted
            There is no worker at present.
        """
        if len(body) > MAX_BYTES:
            raise BadRequest(f"a request about a live map has at most {MAX_BYTES} bytes")
        if isinstance(message, LiveList) and not self._serving:
            session.connection.reply(encode(LiveListed(message.request, self._rows)))
            return
        if self._channel is None or not self._serving:
            if math.isinf(self._start_s):
                raise LiveInterrupted(f"the process that keeps live maps has ended, and {RESTART}")
            raise LiveInterrupted(
                "the process that keeps live maps is being started",
                hint="ask again: it takes long the first time",
            )
        if len(self._unsent) >= MAX_UNSENT:
            raise Busy("the process that keeps live maps does not answer at present", hint="ask again")
        maps = self._may_map(session.peer, now_s)
        self._known_sessions.add(session.slot)
        ticket = self._tickets.give(session, message.request)
        self._send(messages.Ask(ticket, session.slot, session.peer.uid, maps, bytes(body)))

    def on_disconnect(self, session: Session) -> None:
        """Handle the end of a session."""
        self._tickets.on_disconnect(session)
        if session.slot in self._known_sessions:
            self._known_sessions.discard(session.slot)
            if self._channel is not None:
                self._send(messages.Disconnected(session.slot))

    def _send(self, message: messages.ToLive) -> None:
        self._unsent.append(messages.encode(message))
        self._flush()

    def _flush(self) -> None:
        """Send queued messages until the channel is full; the rest later."""
        if self._channel is None:
            return
        try:
            while self._unsent:
                self._channel.send(self._unsent[0])
                self._unsent.popleft()
        except BlockingIOError:
            pass
        except OSError:
            return  # the worker has ended, which `on_readable` handles
        self._watched.watch_for(self._channel.fileno(), reading=True, writing=bool(self._unsent))

    # --- the end --------------------------------------------------------------------------------

    def close(self, *, keep: bool) -> None:
        """Save all chunks and remove them from memory; with ``keep``, leave them to the next run.

        Chunks that could not be saved stay in memory, and are listed in `unsaved`.
        """
        end_s = time.monotonic() + END_S
        ended, was_serving = None, False
        for _ in range(2):  # if a worker dies meanwhile, a new one takes over its chunks
            if self._served_s and not self._serving and self._ended is None and not keep:
                self._start_to_save(end_s)
            if self._channel is None:
                break
            was_serving = self._serving
            until_s = end_s if was_serving else min(end_s, time.monotonic() + START_END_S)
            ended = self._ask_to_end(until_s, keep=keep)
            if ended is not None or self._channel is not None:
                break
        if ended is not None and not keep:
            for one in ended.unsaved:
                self.unsaved[one.map] = one.chunks
                log.error(
                    "live map not saved: its chunks stay in memory for the next start",
                    map=one.map,
                    chunks=one.chunks,
                    reason=one.problem or "there was no time left",
                )
        elif ended is None and was_serving:
            unsaved = {row.name: row.unsaved for row in self._rows if row.unsaved}
            self.unsaved = {} if keep else unsaved
            log.error("live worker did not end in time: what is in memory stays there for the next start")
        self._forget()

    def _start_to_save(self, end_s: float) -> None:
        """Start a new worker, which takes over the chunks that the last one left in memory."""
        self._start_s = 0.0
        self.beat(time.monotonic())
        while self._channel is not None and not self._serving and (left_s := end_s - time.monotonic()) > 0:
            self._wait(left_s)
            self.on_readable()
        if not self._serving:
            log.error("live worker does not start: what is in memory stays there for the next start")

    def _ask_to_end(self, end_s: float, *, keep: bool) -> messages.Ended | None:
        """Make the worker end before ``end_s``; return its last message, if there is one."""
        self._ended = None
        self._unsent.append(messages.encode(messages.End(keep)))
        while self._channel is not None and self._ended is None and (left_s := end_s - time.monotonic()) > 0:
            self._flush()
            self._wait(left_s)
            self.on_readable()
        return self._ended
