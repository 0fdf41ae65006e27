# SPDX-License-Identifier: Apache-2.0
"""Requests whose answers are awaited later (`Client.futures`): `concurrent.futures.Future` objects.

One thread of the process attaches the cells of all futures' answers and runs their callbacks, which are the
user's code.  The thread that receives replies does neither, so no callback holds up another client's request.
"""

from __future__ import annotations

import contextlib
import os
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, InvalidStateError
from queue import Empty, SimpleQueue
from typing import Any, Final, TypeVar

from shmmap.client.connection import reply_error
from shmmap.client.connection_watch import start_thread
from shmmap.client.request_table import Outstanding
from shmmap.client.session import Asked, Session, Steps
from shmmap.errors import BadRequest

R = TypeVar("R")

_OVER_S: Final = 0.5  # interval at which a wait checks again, should another thread wait, too


class _Condition(threading.Condition):
    """A condition whose lock is released whatever exception a signal handler raises (`connection_watch`)."""

    __slots__ = ("__enter__", "__exit__")

    __enter__: Any
    __exit__: Any

    def __init__(self) -> None:
        lock = threading.RLock()
        super().__init__(lock)
        self.__enter__, self.__exit__ = lock.__enter__, lock.__exit__


class _Answer(Future[R]):
    """The answer to some requests that are sent one after another.

    `Future.result` may leave its lock taken when a signal handler's exception interrupts it, and the thread
    that completes futures would wait without bound.  So here waiting takes no lock.
    """

    def __init__(self, session: Session, steps: Steps[R]) -> None:
        super().__init__()
        self._condition = _Condition()
        self._work: tuple[Session, Steps[R]] | None = session, steps  # None when it is over
        self._over: SimpleQueue[None] = SimpleQueue()
        self._asked: Asked | None = None
        self._withdraw: Callable[[], None] | None = None

    def advance(self, reply: Any = None) -> None:
        """Send the next request of the steps, or raise `StopIteration` with their answer."""
        if self._work is None:
            return
        session, steps = self._work
        self._asked = asked = steps.send(reply)
        self._withdraw = withdraw = session.begin(asked, _answers, self)
        if self.cancelled():  # meanwhile
            withdraw()

    def take(self, answered: Outstanding) -> None:
        """Go on with a reply, in the thread that completes futures."""
        asked, message = self._asked, answered.message
        assert asked is not None  # noqa: S101  else there were no reply
        assert message is not None  # noqa: S101  futures ask for more than a session
        try:
            if not isinstance(answered.reply, asked.kind):
                raise reply_error(message, answered.reply)
            self.advance(answered.reply)
        except StopIteration as end:
            self._end(self.set_result, end.value)
        except BaseException as error:  # noqa: BLE001  it is the answer
            self._end(self.set_exception, error)

    def _end(self, end: Callable[[Any], None], what: object) -> None:
        _open.discard(self)
        with contextlib.suppress(InvalidStateError):  # cancelled meanwhile
            end(what)

    def _invoke_callbacks(self) -> None:
        """Wake those that wait, when the future is over, before the callbacks are run."""
        self._work = None
        self._over.put(None)
        super()._invoke_callbacks()  # type: ignore[misc]

    def abandon(self) -> None:
        """End it in a forked child, where nothing completes it, without callbacks."""
        self._condition = _Condition()
        self._done_callbacks: list[Any] = []
        self._waiters: list[Any] = []
        if not self.done():
            hint = "ask again in the child"
            self.set_exception(BadRequest("this future was begun before the fork, in the parent", hint=hint))

    # --- for the user ---------------------------------------------------------------------------------

    def cancel(self) -> bool:
        """End the request; the daemon goes on with loads that have begun, and keeps nothing else for it."""
        try:
            return super().cancel()
        finally:
            if self.cancelled():
                _open.discard(self)
                if self._withdraw is not None:
                    self._withdraw()

    def result(self, timeout: float | None = None) -> R:
        """Wait for the answer; raise what the request raised, or `TimeoutError`."""
        self._wait(timeout)
        return super().result(0)

    def exception(self, timeout: float | None = None) -> BaseException | None:
        """Wait for the end of the request; return what it raised."""
        self._wait(timeout)
        return super().exception(0)

    def _wait(self, timeout: float | None) -> None:
        end_s = None if timeout is None else time.monotonic() + timeout
        while not self.done():
            left_s = _OVER_S if end_s is None else min(end_s - time.monotonic(), _OVER_S)
            if left_s <= 0:
                return
            try:
                self._over.get(timeout=left_s)
            except Empty:
                continue
            self._over.put(None)  # for the others that wait


def begin(session: Session, steps: Steps[R]) -> Future[R]:
    """Send the first request of ``steps``; return the future of their answer."""
    if not _threads:
        start_thread(_complete)
    answer = _Answer(session, steps)
    _open.add(answer)
    try:
        answer.advance()
    except BaseException:
        _open.discard(answer)
        raise
    return answer


# --- the thread that completes them -------------------------------------------------------------------

_answers: SimpleQueue[Outstanding] = SimpleQueue()
_open: Final[set[_Answer[Any]]] = set()
"""Futures that are under way."""
_threads: Final[list[int]] = []
"""The thread that completes futures; empty before the first one."""


def _complete() -> None:
    _threads.append(threading.get_ident())
    if _threads[0] != threading.get_ident():  # two threads began their first futures at once
        return
    while True:
        answered = _answers.get()
        try:
            answered.for_whom.take(answered)
        except BaseException:  # noqa: BLE001  of a callback; the other futures have to be completed
            sys.excepthook(*sys.exc_info())
        del answered  # it refers to the session


def _after_fork_in_child() -> None:
    global _answers
    _answers = SimpleQueue()
    _threads.clear()
    for answer in tuple(_open):
        answer.abandon()
    _open.clear()


os.register_at_fork(after_in_child=_after_fork_in_child)
