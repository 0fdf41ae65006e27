# SPDX-License-Identifier: Apache-2.0
"""`MapWindow`: the cells around a moving pose, kept current."""

from __future__ import annotations

import math
import os
import time
import weakref
from collections.abc import Sequence
from itertools import chain
from types import TracebackType
from typing import TYPE_CHECKING, Any, Final

from shmmap.client.cell import Cell
from shmmap.client.client import Client, connect
from shmmap.client.points_around import PointsAround, points_around
from shmmap.client.retention import Retention, RetentionPolicy
from shmmap.client.window_follower import PENDING_WAIT_S, WindowFollower, moved
from shmmap.client.window_refresh import WindowRefresher
from shmmap.client.window_state import EMPTY, LayerKey, WindowState, WindowUpdate, update_between
from shmmap.errors import BadRequest, ShmmapError
from shmmap.geometry import Circle, ZRange
from shmmap.protocol.messages import Intent

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["MapWindow"]

_BLOCKING_WAIT_S: Final = 5.0
_FIRST_PAUSE_S: Final = 0.005  # between requests for what does not fit; doubles
_STALLED_S: Final = 0.5  # a blocking call gives up on what does not fit after this long without progress


class MapWindow:
    """The cells around a moving pose, attached and kept current by differential requests.

    In the background mode (the default) a thread asks the daemon, attaches and unmaps; `move_to`,
    `cells` and `points_around` never wait, and never open, map or unmap anything.  Each answer
    shows up as a whole: everything a call returns belongs to one state of the window.  A daemon that
    fails shows in `error` and `stale_since`, while the window serves what it has; a restarted one is
    found again by itself.

    With ``background=False`` everything happens in `move_to`, which raises what goes wrong.

    After a fork the child can read what the window held, but not move it.

    Parameters
    ----------
    client
        Client to ask through (other threads' requests wait for the window's, a quarter of a second at
        most, while cells load); or an endpoint as in `connect`, for a session of its own.
    radius
        Of the window around the pose, metres.
    layers
        What to have of each cell.
    shape
        ``"circle"``, or ``"square"`` for Autoware's area test (a square of half-side ``radius``).
    update_distance
        Metres the pose moves before the daemon is asked again (20 in Autoware).
    refresh_interval
        Seconds after which it is asked anyhow, to learn of a changed map.
    retention
        What to keep attached of what has left the window; default nothing.
    background
        Whether a thread does the work.
    z
        (lowest, highest) heights of interest, metres.
    name
        How the window's own session appears in ``shmmap clients``.

    Raises
    ------
    DaemonUnreachable, ProtocolMismatch
        As `connect`, where an endpoint is given.
    BadRequest
        A parameter makes no sense.
    """

    def __init__(
        self,
        client: Client | str | os.PathLike[str] | None = None,
        radius: float = 150.0,
        *,
        layers: str | Sequence[str] = ("points",),
        shape: str = "circle",
        update_distance: float = 20.0,
        refresh_interval: float = 1.0,
        retention: RetentionPolicy | None = None,
        background: bool = True,
        z: tuple[float, float] | None = None,
        name: str = "",
    ) -> None:
        if not update_distance >= 0 or not refresh_interval > 0:
            raise BadRequest(
                "update_distance must not be negative and refresh_interval must be positive,"
                f" they are {update_distance!r} m and {refresh_interval!r} s"
            )
        Circle(0.0, 0.0, radius)
        self._radius = radius
        self._owns_client = not isinstance(client, Client)
        self._client = client if isinstance(client, Client) else connect(client, name=name)
        self._layers = (layers,) if isinstance(layers, str) else tuple(layers)
        self._update_distance = update_distance
        self._refresh_interval_s = refresh_interval
        self._seen = EMPTY.versions
        self._state = EMPTY
        self._asked_s = 0.0
        self._closed = False
        self._follower: WindowFollower | None = None
        try:
            self._refresher = WindowRefresher(
                self._client,
                radius,
                layers=self._layers,
                shape=shape,
                z=ZRange(*z) if z is not None else None,
                retention=retention if retention is not None else Retention(),
                populate=background,  # page faults, too, are better taken by the thread
            )
        except ShmmapError:
            if self._owns_client:
                self._client.close()
            raise
        if background:
            follower = WindowFollower(
                self._refresher,
                self._client.unmapper,
                update_distance=update_distance,
                refresh_interval_s=refresh_interval,
            )
            self._follower = follower
            # also when nobody calls close(), and at the end of the program before sockets are closed
            self._finalizer = weakref.finalize(self, follower.stop)

    def __enter__(self) -> MapWindow:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def __repr__(self) -> str:
        where = "closed" if self._closed else f"of radius {self._radius:g} m"
        return f"<MapWindow {where}, {len(self.cells)} cells of {', '.join(self._layers)}>"

    def close(self) -> None:
        """Stop following and let the window's cells go; views that live elsewhere stay readable."""
        if self._closed:
            return
        self._closed = True
        if self._follower is not None:
            self._finalizer()
            self._follower.state = EMPTY
        self._refresher.forget()
        self._state = EMPTY
        self._seen = EMPTY.versions
        if self._owns_client:
            self._client.close()

    # --- moving -------------------------------------------------------------------------------------

    def move_to(
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
        """Tell the window the pose; returns what has changed since the last call.

        Parameters
        ----------
        x, y
            Metres, map frame.
        vx, vy
            Metres per second, map frame.
        heading
            Radians, counter-clockwise from the map's x axis.
        route
            The polyline ahead, (x, y) each or (N, 2); the daemon keeps what lies along it.
        wait
            Seconds this call may take until the window is current.  None: no waiting in the background mode,
            5 s in the blocking one, which waits no longer than half a second for cells that do not fit in
            the budget.

        Raises
        ------
        BadRequest
            A number is missing or makes no sense, the window is closed, or this is a forked child.
        ShmmapError
            Only in the blocking mode: the daemon cannot be asked; the window keeps what it has.
        """
        pose = _intent(x, y, vx, vy, heading, route)
        if wait is not None and not wait >= 0:
            raise BadRequest(f"wait must not be negative, it is {wait!r}")
        if self._closed:
            raise BadRequest("this window is closed")
        follower = self._follower
        state = None
        if follower is None:
            self._refresh(pose, _BLOCKING_WAIT_S if wait is None else wait)
        else:
            if follower.elsewhere:
                raise BadRequest(
                    "this window's thread lives in the parent process", hint="make a window after the fork"
                )
            follower.follow(pose)
            if wait:
                state = follower.wait_until_current(wait)
        state = state or self._current
        update = update_between(self._seen, state)
        self._seen = state.versions
        return update

    def wait_until_current(self, timeout: float) -> bool:
        """Wait until the window answers the latest pose and nothing is being loaded.

        Cells that cannot be had (see `WindowUpdate.failed`) do not hold it up, except those that wait for
        memory.

        Returns
        -------
        bool
            False if it was not so within ``timeout`` seconds.  In the blocking mode, whether it is so.
        """
        if self._follower is not None:
            return self._follower.wait_until_current(timeout) is not None
        return self._state.settled

    def _refresh(self, pose: Intent, wait_s: float) -> None:
        """Ask in the caller's thread until nothing is missing, nothing more comes, or time is up."""
        now_s = time.monotonic()
        state = self._state
        due = now_s - self._asked_s >= self._refresh_interval_s
        if state.settled and not due and not moved(state, pose, self._update_distance):
            return
        deadline_s = now_s + wait_s
        progress_s = now_s
        pause_s = _FIRST_PAUSE_S
        del state
        patience_s: float | None = None
        while True:
            after, progress = self._refresher.refresh(self._state, pose, patience_s)
            self._state = after
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
            patience_s = max(0.0, min(PENDING_WAIT_S, deadline_s - now_s))

    # --- what the window holds ------------------------------------------------------------------------

    @property
    def _current(self) -> WindowState:
        return self._state if self._follower is None else self._follower.state

    @property
    def client(self) -> Client:
        """The client the window asks through."""
        return self._client

    @property
    def cells(self) -> tuple[Cell, ...]:
        """Cells in the window, in id order."""
        return tuple(self._current.cells.values())

    @property
    def complete(self) -> bool:
        """Whether nothing in the window is missing: nothing pending, nothing failed."""
        state = self._current
        return state.asked is not None and not state.pending and not state.failed

    @property
    def error(self) -> ShmmapError | None:
        """Why the daemon could not be asked the last time; None if it could."""
        return None if self._follower is None else self._follower.error

    @property
    def stale_since(self) -> float | None:
        """`time.monotonic` since when the daemon cannot be asked; None while it can."""
        return None if self._follower is None else self._follower.stale_since

    @property
    def map_version(self) -> int:
        """State of the map the window shows."""
        return self._current.map_version

    def versions(self) -> dict[LayerKey, int]:
        """Version of each (cell id, layer) in the window."""
        return dict(self._current.versions)

    def points_around(self, x: float, y: float, radius: float, *, layer: str | None = None) -> PointsAround:
        """Views of the window's cells that touch a circle; nothing is copied.

        Parameters
        ----------
        x, y, radius
            Metres, map frame; what lies beyond the window is not there.
        layer
            Which of the window's layers, as it was asked for or as `Cell.layer` names it; by default the
            first.  Of two layers of one kind, the name is that of `Cell.layer` (`shmmap.canonical_layer`).

        Raises
        ------
        BadRequest
            The circle makes no sense, or the window has no such layer.
        """
        state = self._current
        name = self._name_of(layer if layer is not None else self._layers[0], state)
        cells = state.by_layer.get(name)
        if not cells:
            Circle(x, y, radius)
            return PointsAround(x, y, radius, (), ())
        return points_around(cells, state.boxes[name], x, y, radius)

    def _name_of(self, layer: str, state: WindowState) -> str:
        """Return the name that the cells of a layer go by, in whatever form it was asked for."""
        if layer in state.by_layer:
            return layer
        kind = _kind(layer)
        asked = [one for one in self._layers if _kind(one) == kind]
        if len(asked) > 1:
            return layer  # parameters tell them apart; only the canonical form does so by itself
        there = next((name for name in state.by_layer if _kind(name) == kind), None)
        if layer in asked:
            return there or layer
        if there or not asked:
            names = ", ".join([*state.by_layer] or self._layers)
            raise BadRequest(f"the window has no layer {layer!r}", hint=f"it has {names}")
        return layer


def _kind(layer: str) -> str:
    return layer.partition("(")[0].strip()


def _intent(
    x: float,
    y: float,
    vx: float,
    vy: float,
    heading: float | None,
    route: Sequence[tuple[float, float]] | NDArray[Any],
) -> Intent:
    """Return a pose as it travels, whatever kind of numbers it came in."""
    try:
        path = tuple([(float(route_x), float(route_y)) for route_x, route_y in route])
        angle = None if heading is None else float(heading)
        pose = Intent(float(x), float(y), float(vx), float(vy), angle, path)
    except (TypeError, ValueError) as error:
        raise BadRequest(f"pose: numbers are needed, and two for each point of a route: {error}") from error
    if not all(map(math.isfinite, (pose.x, pose.y, pose.vx, pose.vy, angle or 0.0, *chain(*path)))):
        raise BadRequest("pose: every number in it must be finite")
    return pose
