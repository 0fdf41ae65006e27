# SPDX-License-Identifier: Apache-2.0
"""Keep a window current: in a thread that requests, attaches and unmaps, or in the call that sets the pose.

Both send a request when the pose has moved (`shmmap.client.window.state.moved`), ``refresh_interval_s``
seconds after the last request, and while cells are missing.
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

_PENDING_WAIT_S: Final = 0.25
"""How long one request waits for loads; then the loaded cells are published, and a new pose is accepted."""

_RETRY_S: Final = 0.05  # first pause after an answer without new cells while cells are missing
_RETRY_MAX_S: Final = 1.0  # pauses double up to this
_OVER_S: Final = 0.5  # interval at which a wait for the thread's end checks again

_BLOCKING_WAIT_S: Final = 5.0  # wait of a call without a given one
_FIRST_PAUSE_S: Final = 0.005  # between a call's requests for cells that do not fit; doubles
_STALLED_S: Final = 0.5  # a call gives up on cells that do not fit after this long without progress


class Follower:
    """State, latest pose and last error of a window, for both kinds of followers.

    Attributes
    ----------
    state : WindowState
        The latest state, readable from any thread.
    error : ShmmapError or None
        The error of the last request; None if it succeeded.
    stale_since : float or None
        `time.monotonic` of the first failure after the last success.
    """

    def __init__(self, refresher: WindowRefresher, update_distance: float, refresh_interval_s: float) -> None:
        self._refresher = refresher
        self._update_distance = update_distance
        self._refresh_interval_s = refresh_interval_s
        self._pose: Intent | None = None
        self.state = EMPTY
        self.error: ShmmapError | None = None
        self.stale_since: float | None = None

    def answers(self, state: WindowState) -> bool:
        """Return whether a state answers the latest pose."""
        pose = self._pose
        return pose is not None and not moved(state, pose, self._update_distance)

    def _note(self, error: ShmmapError | None) -> None:
        if error is None:
            self.stale_since = None
        elif self.stale_since is None:
            self.stale_since = time.monotonic()
        self.error = error


class PacedFollower(Follower):
    """A follower that decides by itself when to ask."""

    def __init__(self, refresher: WindowRefresher, update_distance: float, refresh_interval_s: float) -> None:
        super().__init__(refresher, update_distance, refresh_interval_s)
        self._pause_s = 0.0
        self._due_s = math.inf  # no request before the first pose

    def is_current(self, state: WindowState) -> bool:
        """Return whether a state answers the latest pose, and nothing is missing."""
        return self.answers(state) and self.error is None and state.settled and not self._refresher.lost

    def _due_pose(self) -> Intent | None:
        """Return the pose to ask for now, if a request is due."""
        pose = self._pose
        if pose is None:
            return None
        if self.error is None and (not self.answers(self.state) or self._refresher.lost):
            self._due_s = 0.0
        return pose if time.monotonic() >= self._due_s else None

    def _wait_s(self) -> float | None:
        """Return how long the next request lets the daemon wait."""
        return _PENDING_WAIT_S if self.state.pending and self.error is None else None

    def _answered(self, state: WindowState, progress: bool, wait_s: float | None) -> None:
        """Publish an answer, and set the time of the next request."""
        self._publish(state, None)
        pause_s = 0.0
        if state.settled:
            self._pause_s, pause_s = 0.0, self._refresh_interval_s
        elif progress or (state.pending and wait_s is None):
            self._pause_s = 0.0
        elif not state.pending:
            pause_s = self._pause()
        self._due_s = time.monotonic() + pause_s

    def _failed(self, error: Exception) -> None:
        """Publish an error of a request, and set the time of the next one; raise what is none of ours."""
        if not isinstance(error, ShmmapError):
            limit = no_files_left(error)  # to load a module, for example
            if limit is None:
                raise error
            error = limit
        self._publish(self.state, error)
        self._due_s = time.monotonic() + self._pause()

    def _pause(self) -> float:
        self._pause_s = min(max(self._pause_s * 2, _RETRY_S), _RETRY_MAX_S)
        return self._pause_s

    def _publish(self, state: WindowState, error: ShmmapError | None) -> None:
        self.state = state  # before the error: a reader without an error sees the matching state
        self._note(error)


class WindowFollower(PacedFollower):
    """Keeps a window current in a thread of its own.

    All inputs reach the thread through one queue: new poses, memory to unmap, loss of the connection, the
    end. Its only output is the attribute `state`, which it replaces.  Callers wait for that in queues, not by
    a lock that a signal handler's exception could leave locked.

    Parameters
    ----------
    owner
        The object that stops the thread; see `shmmap.client.connection_watch`.
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
        super().__init__(refresher, update_distance, refresh_interval_s)
        self.owner = weakref.ref(owner)
        self._session = session
        self._mailbox: SimpleQueue[Owned | None] = SimpleQueue()
        self._called = False
        self._stopping = False
        self._waiters: list[weakref.ref[SimpleQueue[None]]] = []
        self._over: SimpleQueue[None] = SimpleQueue()
        self._ended = False
        self._pid = os.getpid()
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

    def move(self, pose: Intent, wait_s: float | None) -> WindowState:
        """Set a new pose and return a state: the current one at once, or one for this pose within ``wait_s``.

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
            self._called = True  # one wake-up is enough for any number of poses
            self._mailbox.put(None)
        return (self.wait_until_current(wait_s) if wait_s else None) or self.state

    def wait_until_current(self, timeout_s: float) -> WindowState | None:
        """Wait until a state answers the latest pose and nothing is missing; return it, None at the deadline.

        The returned state is that one, even if a later state has replaced it meanwhile.
        """
        return self.wait_for(self.is_current, timeout_s)

    def wait_for(self, fits: Callable[[WindowState], bool], timeout_s: float) -> WindowState | None:
        """Wait for a state for which ``fits`` is true and return it; None at the deadline."""
        deadline_s = time.monotonic() + min(timeout_s, threading.TIMEOUT_MAX)
        changed: SimpleQueue[None] = SimpleQueue()
        self._waiters.append(weakref.ref(changed))  # gone when this call ends, even by an exception
        while not fits(state := self.state):
            left_s = min(max(deadline_s - time.monotonic(), 0.0), threading.TIMEOUT_MAX)
            try:
                changed.get(timeout=left_s)
            except Empty:
                return None
        return state

    def stop(self) -> None:
        """End the thread; attached cells stay attached."""
        if self._elsewhere:
            return
        self.request_stop()
        while not self._ended and _thread.get_ident() != self._thread:  # a finalizer may run in the thread
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
                if (pose := self._due_pose()) is not None:
                    self._refresh(pose)
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
        """Unmap memory from the queue until a request is due or a new pose arrives; False at the end."""
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
                memory.end()  # the thread that put it here may still hold a reference for a moment
                del memory
                continue
            self._called = False  # before the pose is read: the next pose wakes the thread again
            if remaining_s > 0 or self._stopping:
                return not self._stopping

    def _refresh(self, pose: Intent) -> None:
        """Send one request and publish the resulting state."""
        wait_s = self._wait_s()
        try:
            state, progress = self._refresher.refresh(self.state, pose, wait_s)
        except (ShmmapError, OSError, ImportError) as error:
            self._failed(error)
        else:
            self._answered(state, progress, wait_s)

    def _publish(self, state: WindowState, error: ShmmapError | None) -> None:
        super()._publish(state, error)
        for waiter in tuple(self._waiters):
            queue = waiter()
            if queue is None:
                self._waiters.remove(waiter)
            else:
                queue.put(None)


class BlockingFollower(Follower):
    """Keep a window current in the calling thread; same interface as `WindowFollower`."""

    _asked_s = 0.0  # of the last request

    def move(self, pose: Intent, wait_s: float | None) -> WindowState:
        """Set a new pose; send requests until nothing is missing, no more cells arrive, or time is up.

        Raises
        ------
        ShmmapError
            The daemon cannot be asked; the state stays as it was.
        """
        self._pose = pose
        try:
            self._refresh(pose, _BLOCKING_WAIT_S if wait_s is None else wait_s)
        except ShmmapError as error:
            self._note(error)
            raise
        return self.state

    def wait_until_current(self, timeout_s: float) -> WindowState | None:  # noqa: ARG002
        """Return the state if it answers the latest pose and nothing is missing, else None; never wait."""
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
        del state  # this may be the last reference to the replaced cells
        request_wait_s: float | None = None
        while True:
            after, progress = self._refresher.refresh(self.state, pose, request_wait_s)
            self.state = after
            self._note(None)
            self._asked_s = now_s = time.monotonic()
            if after.settled or now_s >= deadline_s:
                return
            if progress or after.pending:
                progress_s, pause_s = now_s, _FIRST_PAUSE_S
            elif now_s - progress_s >= _STALLED_S:
                return  # the missing cells wait for memory that other clients use
            else:
                time.sleep(min(pause_s, deadline_s - now_s))  # the memory just dropped has to be freed first
                pause_s *= 2
            del after
            request_wait_s = max(0.0, min(_PENDING_WAIT_S, deadline_s - now_s))
