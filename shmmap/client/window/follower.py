# SPDX-License-Identifier: Apache-2.0
"""What keeps a window current: a thread that asks, attaches and unmaps, or the call that moves the window.

Either asks the daemon when the pose has moved (`shmmap.client.window.state.moved`), when
``refresh_interval_s`` have passed since it last asked, and while something is missing.
"""

from __future__ import annotations

import _thread
import contextlib
import math
import os
import threading
import time
import weakref
from collections.abc import Callable
from queue import Empty, SimpleQueue
from typing import Final

from shmmap.client.connection_watch import enter, running, start_thread
from shmmap.client.session import Session
from shmmap.client.window.refresh import WindowRefresher
from shmmap.client.window.state import EMPTY, WindowState, moved
from shmmap.errors import BadRequest, InternalError, ShmmapError
from shmmap.protocol.messages import Intent
from shmmap.segment.attach import Owned
from shmmap.segment.process_limits import no_files_left

__all__ = ["BlockingFollower", "WindowFollower"]

_PENDING_WAIT_S: Final = 0.25
"""How long one request waits for loads: what is ready then is shown, and a new pose is taken."""

_RETRY_S: Final = 0.05  # first pause after an answer that brought nothing although something is missing
_RETRY_MAX_S: Final = 1.0  # pauses double up to this
_OVER_S: Final = 0.5  # a wait for the thread's end looks again after this long

_BLOCKING_WAIT_S: Final = 5.0  # of a call that does not say how long it may take
_FIRST_PAUSE_S: Final = 0.005  # between a call's requests for what does not fit; doubles
_STALLED_S: Final = 0.5  # a call gives up on what does not fit after this long without progress


class WindowFollower:
    """Keeps a window current in a thread of its own.

    Everything reaches the thread through one queue: new poses, memory to unmap, that the connection
    broke, the end.
    Everything leaves it by replacing one attribute; that is waited for in queues, not by a lock that a
    signal handler's exception could leave taken.

    Parameters
    ----------
    owner
        Whose thread it is: see `shmmap.client.connection_watch`.

    Attributes
    ----------
    state : WindowState
        The latest; read it from any thread.
    error : ShmmapError or None
        Why the last request failed, None after one that did not.
    stale_since : float or None
        `time.monotonic` of the first failure after the last success.
    """

    def __init__(
        self,
        refresher: WindowRefresher,
        session: Session,
        *,
        owner: object,
        update_distance: float,
        refresh_interval_s: float,
    ) -> None:
        self.owner = weakref.ref(owner)
        self._refresher = refresher
        self._session = session
        self._update_distance = update_distance
        self._refresh_interval_s = refresh_interval_s
        self._mailbox: SimpleQueue[Owned | None] = SimpleQueue()
        self._pose: Intent | None = None
        self._called = False
        self._stopping = False
        self._pause_s = 0.0
        self._due_s = math.inf  # nothing to ask before there is a pose
        self._waiters: list[weakref.ref[SimpleQueue[None]]] = []
        self._over: SimpleQueue[None] = SimpleQueue()
        self._ended = False
        self._pid = os.getpid()
        self.state = EMPTY
        self.error: ShmmapError | None = None
        self.stale_since: float | None = None
        session.attacher.unmap_in(self._mailbox)
        session.notify_when_lost(self._mailbox)
        self._thread = 0
        try:
            start_thread(self._run)
        except BaseException:
            session.stop_notifying(self._mailbox)
            session.attacher.stop_unmapping_in(self._mailbox)
            raise

    @property
    def _elsewhere(self) -> bool:
        """Whether this is a forked child, where the thread does not exist."""
        return os.getpid() != self._pid

    def answers(self, state: WindowState) -> bool:
        """Whether a state answers the latest pose."""
        pose = self._pose
        return pose is not None and not moved(state, pose, self._update_distance)

    def move(self, pose: Intent, wait_s: float | None) -> WindowState:
        """Take a new pose and return a state: at once, or when it is current, at the latest after ``wait_s``.

        Raises
        ------
        BadRequest
            This is a forked child.
        """
        if self._elsewhere:
            raise BadRequest(
                "this window's thread lives in the parent process", hint="make a window after the fork"
            )
        self._pose = pose
        if not self._called and moved(self.state, pose, self._update_distance):
            self._called = True  # once is enough, however often poses come
            self._mailbox.put(None)
        return (self.wait_until_current(wait_s) if wait_s else None) or self.state

    def wait_until_current(self, timeout_s: float) -> WindowState | None:
        """Wait until the state answers the latest pose and nothing is missing; None at the deadline.

        The state is that one, even if a later one has replaced it meanwhile.
        """
        return self.wait_for(self._is_current, timeout_s)

    def wait_for(self, fits: Callable[[WindowState], bool], timeout_s: float) -> WindowState | None:
        """Wait for a state that fits and return it; None at the deadline."""
        deadline_s = time.monotonic() + min(timeout_s, threading.TIMEOUT_MAX)
        changed: SimpleQueue[None] = SimpleQueue()
        self._waiters.append(weakref.ref(changed))  # it ends with this call, however that ends
        while not fits(state := self.state):
            left_s = min(max(deadline_s - time.monotonic(), 0.0), threading.TIMEOUT_MAX)
            try:
                changed.get(timeout=left_s)
            except Empty:
                return None
        return state

    def _is_current(self, state: WindowState) -> bool:
        return self.answers(state) and self.error is None and state.settled and not self._refresher.lost

    def stop(self) -> None:
        """End the thread; what is attached stays so."""
        if self._elsewhere:
            return
        self.request_stop()
        while not self._ended and _thread.get_ident() != self._thread:  # it may be where garbage ends
            with contextlib.suppress(Empty):
                self._over.get(timeout=_OVER_S)

    def request_stop(self) -> None:
        """Ask the thread to end."""
        self._stopping = True
        self._mailbox.put(None)

    # --- the thread -----------------------------------------------------------------------------------

    def _run(self) -> None:
        self._thread = _thread.get_ident()
        try:
            enter(self)
            while self._wait(self._due_s):
                pose = self._pose
                if pose is None:
                    continue
                if self.error is None and (not self.answers(self.state) or self._refresher.lost):
                    self._due_s = 0.0
                if time.monotonic() >= self._due_s:
                    self._due_s = time.monotonic() + self._refresh(pose)
        except BaseException as error:
            self._publish(self.state, InternalError(f"the window's thread ended: {error!r}"))
            raise
        finally:
            self._session.stop_notifying(self._mailbox)
            self._session.attacher.stop_unmapping_in(self._mailbox)
            running.discard(self)
            self._ended = True
            self._over.put(None)

    def _wait(self, until_s: float) -> bool:
        """Unmap what arrives, until it is time to ask or there is a new pose; False at the end."""
        while True:
            remaining_s = until_s - time.monotonic()
            try:
                if remaining_s <= 0:
                    memory = self._mailbox.get_nowait()
                else:
                    memory = self._mailbox.get(timeout=min(remaining_s, threading.TIMEOUT_MAX))
            except Empty:
                return not self._stopping
            if memory is not None:
                memory.end()  # the thread that put it here may still have it for a moment
                del memory
                continue
            self._called = False  # before the pose is read: the next one calls again
            if remaining_s > 0 or self._stopping:
                return not self._stopping

    def _refresh(self, pose: Intent) -> float:
        """Ask once and publish what came; returns after how many seconds to ask again."""
        before = self.state
        wait_s = _PENDING_WAIT_S if before.pending and self.error is None else None
        try:
            state, progress = self._refresher.refresh(before, pose, wait_s)
        except ShmmapError as error:
            self._publish(before, error)
            return self._pause()
        except (OSError, ImportError) as error:
            limit = no_files_left(error)  # to load a module, say
            if limit is None:
                raise
            self._publish(before, limit)
            return self._pause()
        del before  # the last reference to what was replaced may be this one
        self._publish(state, None)
        if state.settled:
            self._pause_s = 0.0
            return self._refresh_interval_s
        if progress or (state.pending and wait_s is None):
            self._pause_s = 0.0
            return 0.0
        return 0.0 if state.pending else self._pause()

    def _pause(self) -> float:
        self._pause_s = min(max(self._pause_s * 2, _RETRY_S), _RETRY_MAX_S)
        return self._pause_s

    def _publish(self, state: WindowState, error: ShmmapError | None) -> None:
        self.state = state  # before the error: where there is none, the state is the one that came with it
        if error is None:
            self.stale_since = None
        elif self.stale_since is None:
            self.stale_since = time.monotonic()
        self.error = error
        for waiter in tuple(self._waiters):
            queue = waiter()
            if queue is None:
                self._waiters.remove(waiter)
            else:
                queue.put(None)


class BlockingFollower:
    """Keeps a window current in the thread that moves it; otherwise as `WindowFollower`."""

    def __init__(
        self, refresher: WindowRefresher, *, update_distance: float, refresh_interval_s: float
    ) -> None:
        self._refresher = refresher
        self._update_distance = update_distance
        self._refresh_interval_s = refresh_interval_s
        self._pose: Intent | None = None
        self._asked_s = 0.0
        self.state = EMPTY
        self.error: ShmmapError | None = None
        self.stale_since: float | None = None

    def answers(self, state: WindowState) -> bool:
        """Whether a state answers the latest pose."""
        return self._pose is not None and not moved(state, self._pose, self._update_distance)

    def move(self, pose: Intent, wait_s: float | None) -> WindowState:
        """Take a new pose, ask until nothing is missing, nothing more comes, or time is up.

        Raises
        ------
        ShmmapError
            The daemon cannot be asked; the state stays as it was.
        """
        self._pose = pose
        try:
            self._refresh(pose, _BLOCKING_WAIT_S if wait_s is None else wait_s)
        except ShmmapError as error:
            self.error = error
            if self.stale_since is None:
                self.stale_since = time.monotonic()
            raise
        return self.state

    def wait_until_current(self, timeout_s: float) -> WindowState | None:  # noqa: ARG002
        """Return the state if it answers the latest pose and nothing is missing; waiting changes nothing."""
        state = self.state
        asked_in_vain = self.error is not None or self._refresher.lost
        return state if self.answers(state) and state.settled and not asked_in_vain else None

    def stop(self) -> None:
        """Do nothing: there is no thread."""

    def _refresh(self, pose: Intent, wait_s: float) -> None:
        now_s = time.monotonic()
        state = self.state
        due = now_s - self._asked_s >= self._refresh_interval_s or self.error is not None
        if state.settled and not due and not moved(state, pose, self._update_distance):
            return
        deadline_s = now_s + wait_s
        progress_s = now_s
        pause_s = _FIRST_PAUSE_S
        del state  # the last reference to what is replaced may be this one
        request_wait_s: float | None = None
        while True:
            after, progress = self._refresher.refresh(self.state, pose, request_wait_s)
            self.state = after
            self.error = self.stale_since = None
            self._asked_s = now_s = time.monotonic()
            if after.settled or now_s >= deadline_s:
                return
            if progress or after.pending:
                progress_s, pause_s = now_s, _FIRST_PAUSE_S
            elif now_s - progress_s >= _STALLED_S:
                return  # what is missing waits for memory that others have
            else:
                time.sleep(min(pause_s, deadline_s - now_s))  # what was just dropped has to be freed
                pause_s *= 2
            del after
            request_wait_s = max(0.0, min(_PENDING_WAIT_S, deadline_s - now_s))
