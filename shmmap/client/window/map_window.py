# SPDX-License-Identifier: Apache-2.0
"""`MapWindow`: the cells around a moving pose, kept current."""

from __future__ import annotations

import os
import weakref
from collections.abc import Collection, Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Any, NoReturn

from shmmap.client.arguments import number, pose_intent, timeout_s
from shmmap.client.cell import Cell
from shmmap.client.client import Client, connect
from shmmap.client.points_around import PointsAround, points_around
from shmmap.client.session_state import SessionState
from shmmap.client.window.follower import BlockingFollower, Follower, WindowFollower
from shmmap.client.window.refresh import WindowRefresher
from shmmap.client.window.retention import RetentionPolicy
from shmmap.client.window.state import EMPTY, LayerKey, WindowState, WindowUpdate, update_between
from shmmap.errors import BadRequest, ConnectionLost, ShmmapError
from shmmap.geometry import Circle

if TYPE_CHECKING:
    from numpy.typing import NDArray


class WindowView:
    """The content of a window, which a follower keeps current."""

    _client: SessionState
    _follower: Follower
    _refresher: WindowRefresher
    _radius: float
    _closed = False
    _seen = EMPTY.versions

    def __repr__(self) -> str:
        where = "closed" if self._closed else f"of radius {self._radius:g} m"
        return f"<MapWindow {where}, {len(self.cells)} cells of {', '.join(self._refresher.layers)}>"

    def _update(self, state: WindowState) -> WindowUpdate:
        """Return the changes up to a state since the last one that was shown."""
        update = update_between(self._seen, state, current=self._follower.answers(state))
        self._seen = state.versions
        return update

    @property
    def cells(self) -> tuple[Cell, ...]:
        """Cells in the window, in id order."""
        return tuple(self._follower.state.cells.values())

    @property
    def complete(self) -> bool:
        """Whether the window answers the last pose, and no cell is pending, failed or not listed yet.

        A pose is answered if it lies in the last requested area, less than ``update_distance`` from the pose
        of that request.  So this is False right after a jump, and as soon as the vehicle leaves the area of
        the last answer of a daemon that died.
        """
        state = self._follower.state
        answered = self._follower.answers(state) and state.covered
        return answered and not state.pending and not state.failed

    def covers(self, x: float, y: float, radius: float = 0.0) -> bool:
        """Return whether the window has all cells of the map within a circle, in all its layers.

        It is False if the circle reaches beyond the area of the last answer or touches a cell that has
        failed; while a cell of the window is being loaded and no older version is attached; and while the
        daemon does not know all cells in the window.

        Parameters
        ----------
        x, y, radius
            Metres, map frame.

        Raises
        ------
        BadRequest
            The circle is invalid.
        """
        Circle(x, y, radius)
        return self._follower.state.covers(x, y, radius)

    @property
    def error(self) -> ShmmapError | None:
        """The error of the last request or of the connection; None if the last request succeeded."""
        error = self._follower.error
        if error is None and self._client.disconnected_since is not None:
            return ConnectionLost(
                f"{self._client.endpoint}: the daemon closed the connection: it ended, or was restarted",
                hint="the window serves what it has, and connects again by itself",
            )
        return error

    @property
    def stale_since(self) -> float | None:
        """`time.monotonic` since when requests fail; None while they succeed.

        A daemon that ends is noticed at once, a daemon that hangs when a reply is overdue (``timeout``).
        """
        known = (self._follower.stale_since, self._client.disconnected_since)
        return min((since for since in known if since is not None), default=None)

    @property
    def map_version(self) -> int:
        """State of the map that the window shows."""
        return self._follower.state.map_version

    def versions(self) -> dict[LayerKey, int]:
        """Version of each (cell id, layer) in the window."""
        return dict(self._follower.state.versions)

    def points_around(self, x: float, y: float, radius: float, *, layer: str | None = None) -> PointsAround:
        """Return views of the window's cells that touch a circle; nothing is copied.

        `PointsAround.covered` is True if these are all points that the map has there.  Without it, a pose
        beyond the window's area (after a jump, or after the daemon died) would look like an empty place.

        Parameters
        ----------
        x, y, radius
            Metres, map frame.  Points beyond the window are missing, and then ``covered`` is False.
        layer
            One of the window's layers, as requested or as `Cell.layer` names it; by default the first.  To
            distinguish two layers of one kind, use the name of `Cell.layer` (`layers.canonical_layer`).

        Raises
        ------
        BadRequest
            The circle is invalid, or the window has no such layer.
        """
        state, asked = self._follower.state, self._refresher.layers
        name = _layer_name(layer if layer is not None else asked[0], asked, state.by_layer)
        Circle(x, y, radius)
        covered = state.covers(x, y, radius, name)
        cells = state.by_layer.get(name)
        if not cells:
            return PointsAround(x, y, radius, (), (), covered)
        return points_around(cells, state.boxes[name], x, y, radius, covered=covered)


class MapWindow(WindowView):
    """The cells around a moving pose, attached and kept current by differential requests.

    In the background mode (the default) a thread sends requests, attaches and unmaps; `move_to`, `cells` and
    `points_around` never wait, and never open, map or unmap anything.  Each answer is applied as a whole: all
    results of a call belong to one state of the window.  While the daemon fails, `error` and `stale_since`
    show that, and the window keeps its cells; it reconnects by itself after a restart.

    With ``background=False`` all work is done in `move_to`, which also raises the errors.

    The daemon prefetches the cells that the window will need next: along the ``route`` of `move_to`, or
    without a route straight ahead and to both sides.  A radius larger than needed has no benefit.

    After a fork the child can read the window's cells, but not move the window.

    Parameters
    ----------
    client
        Client whose session to use, beside other requests.  Or an endpoint as in `connect`, for a separate
        session.
    radius
        Radius of the window around the pose, metres.
    layers
        Layers to attach of each cell.
    shape
        ``"circle"``, or ``"square"`` for Autoware's area test (a square of half-side ``radius``).
    update_distance
        Distance that the pose moves before the next request, metres (20 in Autoware).
    refresh_interval
        Seconds after which a request is sent without movement: it shows the window a changed map, and the
        daemon a new route or velocity.
    retention
        Policy for keeping cells attached that have left the window; by default none are kept.
    background
        Whether a thread does the work.
    z
        (lowest, highest) heights of interest, metres.
    name
        Name of the window's own session in ``shmmap clients``; empty: the name of the program.
    timeout
        Seconds that a reply may take, in addition to the time that the daemon may wait for loads; None: the
        client's timeout.  A daemon that hangs shows in `error` after this time, a daemon that ended at once.

    instance
        Name of the daemon's instance, instead of a client or an endpoint.

    Raises
    ------
    DaemonUnreachable, ProtocolMismatch
        As `connect`, if no client is given.
    LimitReached
        This process may not have the descriptors or threads that are needed.
    BadRequest
        A parameter is invalid.
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
        timeout: float | None = None,
        instance: str | None = None,
    ) -> None:
        update_distance = number("update_distance", update_distance, unit="metres")
        refresh_interval = number("refresh_interval", refresh_interval, positive=True)
        if timeout is not None:
            timeout = timeout_s("timeout", timeout)
        Circle(0.0, 0.0, radius)
        self._radius = radius
        if isinstance(client, Client) and instance is not None:
            raise BadRequest("give a client or an instance, not both")
        self._owns_client = not isinstance(client, Client)
        self._client: Client = (
            client if isinstance(client, Client) else connect(client, instance=instance, name=name)
        )
        self._follower: WindowFollower | BlockingFollower
        try:
            self._refresher = WindowRefresher(
                self._client,
                radius,
                layers=layers,
                shape=shape,
                z=z,
                retention=retention,
                populate=background,  # page faults, too, should occur in the thread
                timeout_s=timeout,
            )
            if background:
                self._follower = WindowFollower(
                    self._refresher,
                    self._client.session,
                    owner=self,
                    update_distance=update_distance,
                    refresh_interval_s=refresh_interval,
                )
            else:
                self._follower = BlockingFollower(self._refresher, update_distance, refresh_interval)
        except BaseException:
            if self._owns_client:
                self._client.close()
            raise
        # runs also without close(); at interpreter exit Python stops the thread
        self._finalizer = weakref.finalize(self, self._follower.stop)
        self._finalizer.atexit = False

    def __enter__(self) -> MapWindow:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def __reduce__(self) -> NoReturn:
        raise TypeError(
            "a MapWindow cannot be pickled: a thread of this process keeps it current. Make one in each"
            " process, MapWindow(...); cells can be pickled, window.cells: they go as handles"
        )

    def close(self) -> None:
        """Stop following and drop the window's cells; views held elsewhere stay readable."""
        if self._closed:
            return
        self._closed = True
        self._finalizer()
        self._follower.state = EMPTY
        self._refresher.forget()
        self._seen = EMPTY.versions
        if self._owns_client:
            self._client.close()

    @property
    def client(self) -> Client:
        """The client whose session the window uses."""
        return self._client

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
        """Set the window's pose; return the changes since the last call.

        Parameters
        ----------
        x, y
            Metres, map frame.
        vx, vy
            Velocity in metres per second, map frame; both 0: the daemon estimates it from the poses.
        heading
            Radians, counter-clockwise from the map's x axis.
        route
            The polyline ahead, a sequence of (x, y) or an (N, 2) array; pass it with every pose.  The daemon
            prefetches the cells along it, and keeps them longest.  A route of more than 512 places is
            resampled to 512, equally spaced.
        wait
            Seconds this call may take until the window is current.  None: no waiting in the background mode,
            5 s in the blocking mode.  The blocking mode waits at most half a second for cells that do not fit
            in the budget, are unreachable, or are not listed yet.

        Raises
        ------
        BadRequest
            A number is missing or invalid, the window is closed, or this is a forked child.
        ShmmapError
            Only in the blocking mode: the request failed; the window keeps its cells.
        """
        pose = pose_intent(x, y, vx, vy, heading, route)
        if wait is not None:
            wait = number("wait", wait)
        if self._closed:
            raise BadRequest("this window is closed", hint="make another one")
        return self._update(self._follower.move(pose, wait))

    def wait_until_current(self, timeout: float) -> bool:
        """Wait until the window answers the latest pose and nothing is being loaded.

        Cells that cannot be loaded (see `WindowUpdate.failed`) do not prolong the wait, except cells that
        wait for memory or for an unreachable origin.

        Returns
        -------
        bool
            False if the window was not current within ``timeout`` seconds, or requests fail.  In the blocking
            mode, whether the window is current now.
        """
        return self._follower.wait_until_current(number("timeout", timeout)) is not None


def _layer_name(layer: str, asked: Sequence[str], present: Collection[str]) -> str:
    """Return the layer name that `Cell.layer` uses, for a layer named in any form.

    Parameters
    ----------
    layer
        The layer as it was requested, or as `Cell.layer` names it.
    asked
        The window's layers as they were requested.
    present
        Layers of the window's cells, in canonical form.

    Raises
    ------
    BadRequest
        The window has no such layer.
    """
    if layer in present:
        return layer
    kind = _kind(layer)
    alike = [one for one in asked if _kind(one) == kind]
    if len(alike) > 1:
        return layer  # several layers of this kind: only the canonical form is unambiguous
    there = next((name for name in present if _kind(name) == kind), None)
    if layer in alike:
        return there or layer
    if there or not alike:
        raise BadRequest(
            f"the window has no layer {layer!r}", hint=f"it has {', '.join([*present] or asked)}"
        )
    return layer


def _kind(layer: str) -> str:
    return layer.partition("(")[0].strip()
