# SPDX-License-Identifier: Apache-2.0
"""`MapWindow` of `shmmap.aio`: a window that a task keeps current, on the session of its client."""

from __future__ import annotations

import asyncio
import time
import warnings
from collections.abc import AsyncIterator, Callable, Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Any, Final

from shmmap.client.aio.client import Client
from shmmap.client.arguments import number, pose_intent, timeout_s
from shmmap.client.window.follower import PacedFollower
from shmmap.client.window.map_window import WindowView
from shmmap.client.window.refresh import WindowRefresher
from shmmap.client.window.retention import RetentionPolicy
from shmmap.client.window.state import EMPTY, WindowState, WindowUpdate, update_between
from shmmap.errors import BadRequest, InternalError, ShmmapError
from shmmap.protocol.messages import Intent

if TYPE_CHECKING:
    from numpy.typing import NDArray

_FAR_S: Final = 3600.0  # longest sleep of a window without a pose


class _LoopFollower(PacedFollower):
    """Keeps a window current in a task."""

    def __init__(
        self, client: Client, refresher: WindowRefresher, update_distance: float, refresh_interval_s: float
    ) -> None:
        super().__init__(refresher, update_distance, refresh_interval_s)
        self._client = client
        self._called = asyncio.Event()
        self.changed: asyncio.Future[None] = client.loop.create_future()

    def move(self, pose: Intent) -> WindowState:
        """Set a new pose; return the present state."""
        self._pose = pose
        self._called.set()
        return self.state

    def put(self, _: None) -> None:
        """Ask at once: the connection broke; called in any thread."""
        self._client.call(self._called.set)

    def end(self) -> None:
        """Forget the cells, and let all that wait see that."""
        self._publish(EMPTY, None)

    def _publish(self, state: WindowState, error: ShmmapError | None) -> None:
        super()._publish(state, error)
        changed, self.changed = self.changed, self._client.loop.create_future()
        changed.set_result(None)

    async def run(self) -> None:
        """Ask when a request is due, until cancelled."""
        session: Any = self._client.session
        session.notify_when_lost(self)
        try:
            while True:
                left_s = min(max(self._due_s - time.monotonic(), 0.0), _FAR_S)
                timer = self._client.loop.call_later(left_s, self._called.set)
                try:
                    await self._called.wait()  # before Python 3.12 `asyncio.wait_for` may lose a cancellation
                finally:
                    timer.cancel()
                self._called.clear()
                if (pose := self._due_pose()) is not None:
                    await self._refresh(pose)
        except Exception as error:
            self._publish(self.state, InternalError(f"the window's task ended: {error!r}"))
            raise
        finally:
            session.stop_notifying(self)

    async def _refresh(self, pose: Intent) -> None:
        wait_s = self._wait_s()
        try:
            state, progress = await self._client.run(self._refresher.steps(self.state, pose, wait_s))
        except (ShmmapError, OSError, ImportError) as error:
            self._failed(error)
        else:
            self._answered(state, progress, wait_s)


class MapWindow(WindowView):
    """The cells around a moving pose, kept current by a task of the loop: `shmmap.MapWindow` for asyncio.

    ::

        async with shmmap.aio.MapWindow(client, radius=50) as window:
            await window.move_to(x, y, wait=10)
            async for update in window:  # in one task; others call `move_to`
                print(len(update.added), "cells new")

    The window asks on its client's session, beside other requests and windows, and has no thread.  What it
    has is read as from `shmmap.MapWindow`; while the daemon fails it keeps its cells, see `error`.

    Parameters
    ----------
    client
        Client whose session to use.
    radius, layers, shape, update_distance, refresh_interval, retention, z, timeout
        As for `shmmap.MapWindow`.

    Raises
    ------
    BadRequest
        A parameter is invalid.
    """

    _client: Client
    _follower: _LoopFollower
    _task: asyncio.Task[None] | None = None

    def __init__(
        self,
        client: Client,
        radius: float = 150.0,
        *,
        layers: str | Sequence[str] = ("points",),
        shape: str = "circle",
        update_distance: float = 20.0,
        refresh_interval: float = 1.0,
        retention: RetentionPolicy | None = None,
        z: tuple[float, float] | None = None,
        timeout: float | None = None,
    ) -> None:
        update_distance = number("update_distance", update_distance, unit="metres")
        refresh_interval = number("refresh_interval", refresh_interval, positive=True)
        if timeout is not None:
            timeout = timeout_s("timeout", timeout)
        client.check_loop()
        self._client, self._radius = client, radius
        self._refresher = WindowRefresher(
            client,
            radius,
            layers=layers,
            shape=shape,
            z=z,
            retention=retention,
            populate=False,  # page faults of a whole cell would hold up the loop
            timeout_s=timeout,
        )
        self._follower = _LoopFollower(client, self._refresher, update_distance, refresh_interval)

    async def __aenter__(self) -> MapWindow:
        self._begin()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    def __del__(self) -> None:
        if not self._closed and self._task is not None:
            self._client.call(self._task.cancel)
            warnings.warn(f"{self!r} was not closed", ResourceWarning, stacklevel=2, source=self)

    def _begin(self) -> None:
        """Start the task, with the first use."""
        self._client.check_loop()
        if self._closed:
            raise BadRequest("this window is closed", hint="make another one")
        if self._task is None:
            self._task = self._client.loop.create_task(self._follower.run())

    async def close(self) -> None:
        """Stop following and drop the window's cells; views held elsewhere stay readable."""
        if self._closed:
            return
        self._client.check_loop()
        self._closed = True
        try:
            if self._task is not None:
                self._task.cancel()
                await asyncio.wait([self._task])
        finally:
            self._refresher.forget()
            self._seen = EMPTY.versions
            self._follower.end()

    async def move_to(
        self,
        x: float,
        y: float,
        *,
        vx: float = 0.0,
        vy: float = 0.0,
        heading: float | None = None,
        route: Sequence[tuple[float, float]] | NDArray[Any] = (),
        wait: float | None = None,
    ) -> WindowUpdate:
        """Set the window's pose; return the changes since the last call, at once or after ``wait``.

        Parameters
        ----------
        wait
            Seconds this call may take until the window is current; None: it does not wait.

        Other parameters are those of `shmmap.MapWindow.move_to`.

        Raises
        ------
        BadRequest
            A number is missing or invalid, the window is closed, or this is another event loop.
        """
        pose = pose_intent(x, y, vx, vy, heading, route)
        if wait is not None:
            wait = number("wait", wait)
        self._begin()
        state = self._follower.move(pose)
        return self._update(
            (await self._wait_for(self._follower.is_current, wait) if wait else None) or state
        )

    async def wait_until_current(self, timeout: float) -> bool:
        """Wait until the window answers the latest pose and nothing is being loaded.

        Cells that cannot be loaded (see `WindowUpdate.failed`) do not prolong the wait, except cells that
        wait for memory or for an unreachable origin.

        Returns
        -------
        bool
            False if that was not so within ``timeout`` seconds, or the window was closed.
        """
        timeout = number("timeout", timeout)
        self._client.check_loop()
        return await self._wait_for(self._follower.is_current, timeout) is not None

    async def _wait_for(self, fits: Callable[[WindowState], bool], wait_s: float) -> WindowState | None:
        end_s = time.monotonic() + wait_s
        while not self._closed and not fits(state := self._follower.state):
            left_s = end_s - time.monotonic()
            if left_s <= 0:
                return None
            await asyncio.wait([self._follower.changed], timeout=left_s)
        return None if self._closed else state

    async def __aiter__(self) -> AsyncIterator[WindowUpdate]:
        """Iterate over the changes: of cells, and each time the window has become complete; until `close`."""
        self._begin()
        seen, was_complete = EMPTY.versions, False
        while not self._closed:
            state, changed = self._follower.state, self._follower.changed
            update = update_between(seen, state, current=self._follower.answers(state))
            if update.any or (update.complete and not was_complete):
                seen = state.versions
                yield update
            was_complete = update.complete
            del state, update  # they keep cells
            await asyncio.shield(changed)
