# SPDX-License-Identifier: Apache-2.0
"""The map around a moving vehicle, kept by Autoware's rules: no scan waits for an update.

`MapUpdater` has a thread that sends a request to the daemon when the vehicle has moved ``update_distance``.
It builds the next `VoxelMap` while the current one is in use (map_update_module of autoware_core does the
same with a second NDT object).  The caller always gets the newest map, without copying.  It waits only for
the first map, and for one that is late (``distance + lidar_radius > map_radius``).
"""

from __future__ import annotations

import math
import os
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from shmmap import BadRequest, Cell, Client, MapWindow, NoAnswer, ShmmapError
from shmmap.errors import InternalError
from shmmap.layers import canonical_layer
from shmmap_clients.closed_at_end import ClosedAtEnd
from shmmap_clients.ndt_scan_matcher.backends.backend import UploadStatistics
from shmmap_clients.ndt_scan_matcher.map.voxel_map import VoxelCell, VoxelMap, cell_from_layer
from shmmap_clients.spread import RunningSpread

_REFRESH_S: Final = 1.0  # Autoware's timer; also the longest delay until a changed map is noticed
_STEP_S: Final = 5.0  # interval of asking the daemon whether a map is still being loaded
_ARRIVAL_S: Final = 60.0


@dataclass(slots=True)
class UpdateStatistics:
    """Statistics of the changes of the map in use.

    Attributes
    ----------
    updates
        Number of changes.
    added, removed
        Cells added and removed by all changes.
    request_ms
        Time from the request until the daemon's cells are attached, milliseconds.
    build_ms
        Time to build the next map, milliseconds.
    prepare_ms
        Part of ``build_ms`` in which the backend prepares: covariances, tables, writes to a device.
    private_bytes
        Largest private memory of this process for a map.
    uploads
        Counts of writes to a device, including maps written again; the object is updated in place.
    """

    uploads: UploadStatistics = field(default_factory=UploadStatistics)
    updates: int = 0
    added: int = 0
    removed: int = 0
    request_ms: RunningSpread = field(default_factory=RunningSpread)
    build_ms: RunningSpread = field(default_factory=RunningSpread)
    prepare_ms: RunningSpread = field(default_factory=RunningSpread)
    private_bytes: int = 0

    def add(
        self,
        *,
        added: int,
        removed: int,
        request_s: float,
        build_s: float,
        prepare_s: float,
        private_bytes: int,
    ) -> None:
        """Count one change."""
        self.updates += 1
        self.added += added
        self.removed += removed
        self.request_ms.add(request_s * 1e3)
        self.build_ms.add(build_s * 1e3)
        self.prepare_ms.add(prepare_s * 1e3)
        self.private_bytes = max(self.private_bytes, private_bytes)


@dataclass(frozen=True, slots=True)
class MapRules:
    """When to ask for which part of the map; defaults as in Autoware.

    Attributes
    ----------
    update_distance
        Metres moved since the last request, after which the next is due.
    map_radius
        Half-side of the requested square, metres (Autoware's area test).
    lidar_radius
        Range of the scanner, metres; the requested area should reach beyond it.
    leaf
        Edge of a voxel, metres.
    max_voxels, max_bytes
        Limits on the map, see `VoxelMap`.
    wait_s
        Timeout of a wait for a map, seconds, counted from the daemon's last report that it is still loading.
        The first load compiles kernels, which takes minutes on a slow machine.
    """

    update_distance: float = 20.0
    map_radius: float = 150.0
    lidar_radius: float = 100.0
    leaf: float = 2.0
    max_voxels: int | None = None
    wait_s: float = 60.0
    max_bytes: int | None = None

    def __post_init__(self) -> None:
        if not (self.update_distance >= 0 and self.map_radius > 0 and self.lidar_radius >= 0):
            raise BadRequest("distances of the map's rules must not be negative")
        if self.lidar_radius + self.update_distance > self.map_radius:
            raise BadRequest(
                f"a map of {self.map_radius} m radius cannot keep {self.lidar_radius} m around a vehicle that"
                f" asks every {self.update_distance} m",
                hint="map_radius must be at least lidar_radius + update_distance",
            )

    @property
    def layer(self) -> str:
        """Name of the requested layer."""
        return canonical_layer(f"ndt(leaf={self.leaf!r})")


class MapUpdater(ClosedAtEnd):
    """Updater of the `VoxelMap` around a pose.

    Parameters
    ----------
    client
        A session with the daemon, or a socket as in `shmmap.connect` for a session of its own.
    rules
    prepare
        Called in the updater's thread with each new map, to prepare it for alignments.
    uploads
        Counts of writes to a device by ``prepare``, for the statistics: `NdtMatcher.uploads`.
    route
        Known path ahead of the vehicle, (N, 2), metres, map frame; the daemon prefetches the cells along
        it.

    Attributes
    ----------
    waited
        Whether the last `map_at` had to wait for its map.
    too_slow
        Number of maps that were waited for although the pose had not jumped.

    Raises
    ------
    ShmmapError
        The daemon cannot be reached, or has no such layer.
    """

    def __init__(
        self,
        client: Client | str | os.PathLike[str] | None = None,
        rules: MapRules | None = None,
        *,
        prepare: Callable[[VoxelMap], VoxelMap] = lambda voxel_map: voxel_map,
        uploads: UploadStatistics | None = None,
        route: NDArray[np.float64] | Sequence[tuple[float, float]] = (),
    ) -> None:
        self.rules = rules if rules is not None else MapRules()
        self.statistics = UpdateStatistics(uploads if uploads is not None else UploadStatistics())
        self.too_slow = 0
        self.waited = False
        self._prepare = prepare
        self._route = route
        self._velocity = (0.0, 0.0)
        self._window = MapWindow(
            client,
            self.rules.map_radius,
            layers=self.rules.layer,
            shape="square",
            update_distance=0.0,  # this class decides when to ask
            refresh_interval=_REFRESH_S,
            background=False,
            name="shmmap-ndt",
        )
        self._known: dict[str, tuple[Cell, VoxelCell]] = {}
        self._latest: tuple[VoxelMap, tuple[float, float]] | None = None
        self._changed = threading.Condition()
        self._asked: tuple[float, float, float, float] | None = None
        self._failed: tuple[float, float, float, float] | None = None
        self._error: ShmmapError | None = None
        self._loading_s = -math.inf  # time of the daemon's last report that it is loading
        self._closing = False
        self._busy = False
        self._thread = threading.Thread(target=self._run, name="ndt-map", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread and its own session, if any; maps already returned stay readable."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        self._thread.join()
        self._window.close()

    @property
    def error(self) -> ShmmapError | None:
        """Error of the last update; None if it succeeded."""
        return self._error

    def map_at(
        self, x: float, y: float, *, vx: float = 0.0, vy: float = 0.0, jumped: bool = False
    ) -> VoxelMap:
        """Return the newest map; `waited` is whether this call had to wait for it.

        If the daemon's map has no cells around the position, the `VoxelMap` is empty.

        Parameters
        ----------
        x, y
            Position of the vehicle, metres, map frame.
        vx, vy
            Velocity of the vehicle, metres per second, for prefetching cells ahead.
        jumped
            Whether the pose was corrected; a map that does not reach it then is not counted as ``too_slow``.

        Raises
        ------
        NoAnswer
            No map reaches far enough, and the daemon has not reported any loading for ``wait_s``.
        ShmmapError
            The first map could not be loaded.
        """
        rules = self.rules
        with self._changed:
            self._velocity = vx, vy
            reached = (
                self._latest is not None and self._distance(x, y) + rules.lidar_radius <= rules.map_radius
            )
            if self._latest is not None and not reached and not jumped:
                self.too_slow += 1
            if self._distance(x, y) > rules.update_distance:
                self._asked = (x, y, vx, vy)
                self._changed.notify_all()
            if not reached:
                if self._latest is None:
                    self._error = None  # of an earlier attempt
                self._wait_for(x, y)
            assert self._latest is not None  # noqa: S101  # waited for
            self.waited = not reached
            return self._latest[0]

    def wait_until_current(self, timeout_s: float) -> bool:
        """Wait until all requests have been answered; return False on timeout."""
        with self._changed:
            return self._changed.wait_for(lambda: self._asked is None and not self._busy, timeout_s)

    def _wait_for(self, x: float, y: float) -> None:
        rules, begin_s = self.rules, time.monotonic()
        while self._latest is None or self._distance(x, y) + rules.lidar_radius > rules.map_radius:
            if self._error is not None and self._latest is None:
                raise self._error
            left_s = max(begin_s, self._loading_s) + rules.wait_s - time.monotonic()
            if left_s <= 0:
                raise NoAnswer(
                    f"the map around ({x:.1f}, {y:.1f}) was not loaded within {rules.wait_s:.0f} s",
                    hint="`shmmap status` shows whether the daemon still loads, or has no memory left",
                )
            self._changed.wait(left_s)

    def _distance(self, x: float, y: float) -> float:
        if self._latest is None:
            return math.inf
        at = self._latest[1]
        return math.hypot(x - at[0], y - at[1])

    # --- the thread -------------------------------------------------------------------------------

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._asked is not None or self._closing, _REFRESH_S)
                if self._closing:
                    return
                asked = self._asked or self._failed
                if asked is None and self._latest is not None:
                    asked = (*self._latest[1], *self._velocity)  # to detect a change of the map itself
                self._asked = self._failed = None
                self._busy = True
            if asked is not None:
                self._update(*asked)
            with self._changed:
                self._busy = False
                self._changed.notify_all()

    def _update(self, x: float, y: float, vx: float, vy: float) -> None:
        try:
            self._follow(x, y, vx, vy)
        except Exception as error:  # noqa: BLE001  # all scans would wait for a dead thread
            with self._changed:
                if isinstance(error, ShmmapError):
                    self._error = error
                else:
                    self._error = InternalError(f"the map's update failed: {error!r}")
                self._failed = (x, y, vx, vy)
                self._changed.notify_all()

    def _follow(self, x: float, y: float, vx: float, vy: float) -> None:
        begin_s = time.perf_counter()
        cells = self._loaded(x, y, vx, vy)
        if not cells and not self._window.complete:
            raise NoAnswer("none of the cells could be loaded", hint="`shmmap status` shows why")
        request_s = time.perf_counter() - begin_s
        known = {cell.id: self._voxels(cell) for cell in cells}
        before = self._latest
        changed = {key for key in known if self._known.get(key) is not known[key]}
        gone = self._known.keys() - known.keys()
        if before is not None and not changed and not gone:
            voxel_map = before[0]
        else:
            begin_s = time.perf_counter()
            voxel_map = VoxelMap(
                {key: voxels for key, (_, voxels) in known.items()},
                max_voxels=self.rules.max_voxels,
                max_bytes=self.rules.max_bytes,
                centre=(x, y),
                previous=before[0] if before is not None else None,
            )
            made_s = time.perf_counter()
            voxel_map = self._prepare(voxel_map)
            done_s = time.perf_counter()
            self.statistics.add(
                added=len(changed),
                removed=len(gone),
                request_s=request_s,
                build_s=done_s - begin_s,
                prepare_s=done_s - made_s,
                private_bytes=voxel_map.private_bytes,
            )
        with self._changed:
            self._known = known
            self._error = None
            self._latest = (voxel_map, (x, y))
            if self._asked is not None and self._distance(*self._asked[:2]) <= self.rules.update_distance:
                self._asked = None  # asked again during this request
            self._changed.notify_all()

    def _loaded(self, x: float, y: float, vx: float, vy: float) -> tuple[Cell, ...]:
        """Wait for the window's cells; stop when no further cell arrives for long."""
        arrived_s = time.monotonic()
        while True:
            update = self._window.move_to(
                x, y, vx=vx, vy=vy, route=self._route, wait=min(_STEP_S, self.rules.wait_s / 4)
            )
            now_s, cells = time.monotonic(), self._window.cells
            if update.added or update.changed:
                arrived_s = now_s
            if not update.pending or self._closing or (cells and now_s - arrived_s > _ARRIVAL_S):
                return cells
            self._loading_s = now_s

    def _voxels(self, cell: Cell) -> tuple[Cell, VoxelCell]:
        known = self._known.get(cell.id)
        if known is not None and known[0].version == cell.version and known[0].segment == cell.segment:
            return known
        return cell, cell_from_layer(cell)
