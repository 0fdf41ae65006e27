# SPDX-License-Identifier: Apache-2.0
"""The map around a moving vehicle, kept by Autoware's rules: no scan waits for an update.

`MapUpdater` has a thread that asks the daemon when the vehicle has moved ``update_distance``, and makes
the next `VoxelMap` beside the one in use (map_update_module of autoware_core does the same with a second
NDT object).  The caller gets whichever is newest; taking it is an assignment.  Only the first map, and one
that came too late (``distance + lidar_radius > map_radius``), is waited for.
"""

from __future__ import annotations

import math
import os
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Final

import numpy as np
from numpy.typing import NDArray

from shmmap import BadRequest, Cell, Client, MapWindow, NoAnswer, ShmmapError
from shmmap.errors import InternalError
from shmmap.layers import canonical_layer
from shmmap_clients.ndt_scan_matcher.backends.backend import UploadStatistics
from shmmap_clients.ndt_scan_matcher.map.voxel_map import VoxelCell, VoxelMap, cell_from_layer
from shmmap_clients.spread import RunningSpread

__all__ = ["MapRules", "MapUpdater", "UpdateStatistics"]

_REFRESH_S: Final = 1.0  # Autoware's timer; also how soon a changed map is noticed
_STEP_S: Final = 5.0  # how often the daemon is asked whether a map is still being loaded
_ARRIVAL_S: Final = 60.0


class UpdateStatistics:
    """What the changes of the map in use were like.

    Attributes
    ----------
    updates
        How many there were.
    added, removed
        Cells, over all of them.
    request_ms
        From asking until the daemon's cells were attached, milliseconds.
    build_ms
        For the map beside the one in use, milliseconds.
    prepare_ms
        The part of it in which the backend got ready: covariances, tables, writing to a device.
    private_bytes
        This process's own memory for a map, at most.
    uploads
        What was written to a device, also for a map that had to be written again.

    Parameters
    ----------
    uploads
        Where that is counted.
    """

    def __init__(self, uploads: UploadStatistics | None = None) -> None:
        self.updates = 0
        self.added = 0
        self.removed = 0
        self.request_ms = RunningSpread()
        self.build_ms = RunningSpread()
        self.prepare_ms = RunningSpread()
        self.private_bytes = 0
        self.uploads = uploads if uploads is not None else UploadStatistics()

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
        Of the area that is asked for, metres (a square of that half-side, Autoware's area test).
    lidar_radius
        How far the scanner sees, metres: the area should reach beyond that.
    leaf
        Edge of a voxel, metres.
    max_voxels, max_bytes
        Limits on the map, see `VoxelMap`.
    wait_s
        How long a map that has to be waited for may take, from when the daemon last said that it is being
        loaded: the first time kernels are compiled for it, on a slow machine for minutes.
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
        """The layer that is asked for."""
        return canonical_layer(f"ndt(leaf={self.leaf!r})")


class MapUpdater:
    """Keeps a `VoxelMap` around a pose.

    Parameters
    ----------
    client
        A session with the daemon, or a socket as in `shmmap.connect`: then it has a session of its own.
    rules
    prepare
        Called in the updater's thread with each new map; computes what alignments need of it.
    uploads
        Where ``prepare`` counts what it writes to a device, `NdtMatcher.uploads`; for the statistics.
    name
        Of its own session, for ``shmmap clients``.
    route
        The path that the vehicle will take, (N, 2), metres, map frame, as far as it is known: the daemon
        fetches what lies along it before it is asked for.

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
        name: str = "shmmap-ndt",
        route: NDArray[np.float64] | Sequence[tuple[float, float]] = (),
    ) -> None:
        self.rules = rules if rules is not None else MapRules()
        self.statistics = UpdateStatistics(uploads)
        self.too_slow = 0
        self._prepare = prepare
        self._route = route
        self._velocity = (0.0, 0.0)
        self._window = MapWindow(
            client,
            self.rules.map_radius,
            layers=self.rules.layer,
            shape="square",
            update_distance=0.0,  # when to ask is decided here
            refresh_interval=_REFRESH_S,
            background=False,
            name=name,
        )
        self._known: dict[str, tuple[Cell, VoxelCell]] = {}
        self._latest: tuple[VoxelMap, tuple[float, float]] | None = None
        self._changed = threading.Condition()
        self._asked: tuple[float, float, float, float] | None = None
        self._failed: tuple[float, float, float, float] | None = None
        self._error: ShmmapError | None = None
        self._loading_s = -math.inf  # when the daemon last said that it loads
        self._closing = False
        self._busy = False
        self._thread = threading.Thread(target=self._run, name="ndt-map", daemon=True)
        self._thread.start()

    def __enter__(self) -> MapUpdater:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the thread, and the session if it is its own; a map taken before stays readable."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        self._thread.join()
        self._window.close()

    @property
    def error(self) -> ShmmapError | None:
        """Why the last update failed; None if it did not."""
        return self._error

    def map_at(
        self, x: float, y: float, *, vx: float = 0.0, vy: float = 0.0, jumped: bool = False
    ) -> tuple[VoxelMap, bool]:
        """Return the newest map, and whether it had to be waited for.

        Where the daemon's map has nothing around the place, this is a `VoxelMap` without cells.

        Parameters
        ----------
        x, y
            Where the vehicle is, metres, map frame.
        vx, vy
            Its velocity, metres per second: what lies ahead is loaded before it is asked for.
        jumped
            The pose was corrected: that the map does not reach so far does not count as ``too_slow``.

        Raises
        ------
        NoAnswer
            There is no map that reaches far enough, and for ``wait_s`` the daemon has not said that one is
            being loaded.
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
            return self._latest[0], not reached

    def wait_until_current(self, timeout_s: float) -> bool:
        """Wait until everything asked for has been answered; False if it was not in time."""
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
                asked, self._asked = self._asked, None
                self._busy = True
                if asked is None and self._failed is not None:
                    asked = self._failed
                elif asked is None and self._latest is not None:
                    asked = (*self._latest[1], *self._velocity)  # has the map itself changed?
                self._failed = None
            if asked is not None:
                self._update(*asked)
            with self._changed:
                self._busy = False
                self._changed.notify_all()

    def _update(self, x: float, y: float, vx: float, vy: float) -> None:
        try:
            self._follow(x, y, vx, vy)
        except Exception as error:  # noqa: BLE001  # a thread that ended would keep all scans waiting
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
                self._asked = None  # asked again while this was on its way
            self._changed.notify_all()

    def _loaded(self, x: float, y: float, vx: float, vy: float) -> tuple[Cell, ...]:
        """Wait for the window's cells; those of which none follows another for long are left out."""
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
