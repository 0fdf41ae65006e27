# SPDX-License-Identifier: Apache-2.0
"""An event loop that sends and receives for a session, in place of the connection's thread.

The loop watches zmq's descriptor.  That is signalled once: each time all that has come is taken, and a
sender looks once more (`shmmap.client.connection`).
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import threading
import weakref
from collections.abc import Callable
from typing import Any, Final, Protocol, TypeVar

from shmmap.client.connection import reply_error
from shmmap.client.request_table import Outstanding
from shmmap.client.session import Asked, Session, Steps
from shmmap.errors import BadRequest

R = TypeVar("R")

_LATE_S: Final = 1e-3  # a timer may be so much later than asked for


class _Closable(Protocol):
    def close(self) -> None: ...


C = TypeVar("C", bound=_Closable)


async def made_in_thread(make: Callable[[], C]) -> C:
    """Return what ``make`` does in a thread; close that if this is cancelled meanwhile."""
    is_wanted = True
    made: list[C] = []  # who takes it out returns or closes it

    def making() -> None:
        made.append(make())
        if not is_wanted:  # the loop may be about to end
            close()

    def close() -> None:
        with contextlib.suppress(IndexError):
            made.pop().close()

    def over(future: asyncio.Future[None]) -> None:
        if not future.cancelled() and future.exception() is None and made:
            threading.Thread(target=close).start()  # the loop's executor may be at its end

    future = asyncio.get_running_loop().run_in_executor(None, making)
    try:
        await asyncio.shield(future)
    except asyncio.CancelledError:
        is_wanted = False
        future.add_done_callback(over)
        raise
    return made.pop()


class LoopDriver:
    """Drives the requests of one session by the running event loop.

    Parameters
    ----------
    session
        The session, which is connected.
    """

    def __init__(self, session: Session) -> None:
        self.loop = asyncio.get_running_loop()
        self._session = session
        self._pid = os.getpid()
        self._timer: asyncio.TimerHandle | None = None
        self._is_called = False
        # the loop keeps the connection until `stop`, that is no socket is closed while in use; the
        # connection's thread does not
        mine = weakref.ref(self)

        def wake() -> None:
            if (driver := mine()) is not None:
                driver._wake()

        self._file, self._work = session.drive_by(wake)
        self.loop.add_reader(self._file, self._ready)

    def stop(self) -> None:
        """Watch no more; in the loop's thread."""
        if self._file >= 0 and self._pid == os.getpid():  # a forked child shares the loop's descriptors
            if not self.loop.is_closed():
                self.loop.remove_reader(self._file)
            os.close(self._file)
            self._file = -1
        if self._timer is not None:
            self._timer.cancel()

    def drop(self) -> None:
        """Watch no more; in any thread, and when the loop is over."""
        if self.loop.is_closed():
            self.stop()
        else:
            self.call(self.stop)

    def call(self, work: Callable[..., object], *arguments: object) -> None:
        """Have the loop call something, from any thread; nothing where the loop is closed."""
        with contextlib.suppress(RuntimeError):
            if self._runs_here():
                self.loop.call_soon(work, *arguments)
            else:
                self.loop.call_soon_threadsafe(work, *arguments)

    def _runs_here(self) -> bool:
        """Whether the loop runs in this thread; it may have begun in another one."""
        try:
            return asyncio.get_running_loop() is self.loop
        except RuntimeError:  # no loop runs here
            return False

    # --- requests ---------------------------------------------------------------------------------

    def check_loop(self) -> None:
        """Refuse another loop, or none.

        Raises
        ------
        BadRequest
            The running loop is not that in which the session began.
        """
        is_forked = self._pid != os.getpid()
        if self._runs_here() and not is_forked:
            return
        whose = "the parent process" if is_forked else "another event loop"
        raise BadRequest(f"this client belongs to {whose}", hint="connect in each loop, shmmap.aio.connect()")

    async def run(self, steps: Steps[R]) -> R:
        """Send the requests of ``steps`` and wait for each reply; return the answer."""
        try:
            asked = next(steps)
            while True:
                asked = steps.send(await self._reply(asked))
        except StopIteration as end:
            answer: R = end.value
            return answer
        finally:
            steps.close()

    async def _reply(self, asked: Asked) -> Any:
        self.check_loop()
        answered: asyncio.Future[Outstanding] = self.loop.create_future()
        withdraw = self._session.begin(asked, self, answered)
        try:
            entry = await answered
        except BaseException:
            withdraw()
            raise
        if isinstance(entry.reply, asked.kind):
            return entry.reply
        assert entry.message is not None  # noqa: S101  it is a request
        raise reply_error(entry.message, entry.reply)

    def put(self, answered: Outstanding) -> None:
        """Complete what waits for a reply; in the loop, or where the connection is closed."""
        if self._runs_here():
            self._complete(answered)
        else:
            self.call(self._complete, answered)

    def _complete(self, answered: Outstanding) -> None:
        waiting, answered.for_whom = answered.for_whom, None  # else they refer to each other
        if not waiting.done():
            waiting.set_result(answered)

    # --- in the loop ------------------------------------------------------------------------------

    def _wake(self) -> None:
        """Have the loop look at the socket; in any thread."""
        if not self._is_called:  # at worst it is called twice
            self._is_called = True
            self.call(self._ready)

    def _ready(self) -> None:
        self._is_called = False
        self._serve(is_timer=False)

    def _on_time(self) -> None:
        self._timer = None
        self._serve(is_timer=True)

    def _serve(self, *, is_timer: bool) -> None:
        if self._file < 0:
            return
        left_s = self._work(is_timer=is_timer)
        if left_s is None:
            return
        due_s = self.loop.time() + left_s
        if self._timer is not None:
            if self._timer.when() <= due_s + _LATE_S:
                return
            self._timer.cancel()
        self._timer = self.loop.call_at(due_s, self._on_time)
