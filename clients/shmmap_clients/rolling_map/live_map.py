# SPDX-License-Identifier: Apache-2.0
"""Use of the live map by this program: sending scans, reading all voxels, reporting memory."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap import Box, DaemonUnreachable
from shmmap.errors import LiveInterrupted, OverBudget
from shmmap.live import ChunkInfo, LiveMap, LiveMapRow, ScanCounts
from shmmap_clients.command_line import counted, format_bytes
from shmmap_clients.spread import Decimated, RunningSpread

if TYPE_CHECKING:
    from shmmap.live import LiveMapper  # needs numba, which readers do without
    from shmmap_clients.scans.scan_sequence import Scan

_SIDE: Final = 64  # side of a chunk, voxels


@dataclass(frozen=True, slots=True, eq=False)
class MappedScan:
    """A scan that was sent to the map.

    Attributes
    ----------
    scan
        The scan as read.
    number
        Number of the scan among this mapper's scans.
    counts
        Number of its points by outcome.
    on_their_way
        Number of scans sent but not applied yet, including this one.
    add_s
        Seconds for marking and sending the scan, including the wait for space.
    """

    scan: Scan
    number: int
    counts: ScanCounts
    on_their_way: int
    add_s: float


def map_scan(scan: Scan, mapper: LiveMapper) -> MappedScan:
    """Send a scan to the map, whose window follows it.

    Raises
    ------
    BadRequest
        The scan has no pose.
    ShmmapError
        The daemon refuses the scan.
    """
    begin_s = time.perf_counter()
    number = mapper.add(scan.xyz, scan.pose)
    add_s = time.perf_counter() - begin_s
    return MappedScan(scan, number, mapper.counts, max(0, number - mapper.applied), add_s)


class DriveStatistics:
    """Running statistics of a drive's scans, in constant memory.

    Parameters
    ----------
    live
        The map, whose memory the progress shows.
    """

    def __init__(self, live: LiveMap | None = None) -> None:
        self._live = live
        self.scans = 0
        self.points = 0
        self.first: int | None = None
        self.last: int | None = None
        self._counts: Counter[str] = Counter(dict.fromkeys(ScanCounts.__struct_fields__, 0))
        self._path: Decimated[tuple[float, float, float]] = Decimated()
        self._position: tuple[float, float, float] | None = None
        self._add_ms = RunningSpread()

    def add(self, mapped: MappedScan) -> None:
        """Count one scan."""
        self.scans += 1
        self.points += len(mapped.scan.xyz)
        self.first = mapped.number if self.first is None else self.first
        self.last = mapped.number
        self._counts.update({name: getattr(mapped.counts, name) for name in ScanCounts.__struct_fields__})
        self._add_ms.add(mapped.add_s * 1e3)
        x, y, z = mapped.scan.pose[:3, 3].tolist()
        self._position = (x, y, z)
        self._path.add(self._position)

    @property
    def counted(self) -> int:
        """Number of points used, within or beyond the range."""
        return self._counts["near"] + self._counts["far"]

    @property
    def path(self) -> Sequence[tuple[float, float, float]]:
        """Positions of the sensor, metres; a subset for a long drive."""
        path = self._path.values
        return path if self._position is None or path[-1] == self._position else [*path, self._position]

    @property
    def left_out(self) -> str:
        """Description of the points left out, with counts; empty if there are none."""
        return _left_out(self._counts)

    def line(self, mapped: MappedScan) -> str:
        """Return one line about the latest scan."""
        counts = {name: getattr(mapped.counts, name) for name in ScanCounts.__struct_fields__}
        left_out = _left_out(counts)
        return (
            f"{mapped.scan.name}: {len(mapped.scan.xyz):,} points, {counts['near']:,} in range,"
            f" {counts['far']:,} beyond"
            + (f", {left_out}" if left_out else "")
            + f"; {mapped.add_s * 1e3:.1f} ms"
            + (f", {mapped.on_their_way} on their way" if mapped.on_their_way > 1 else "")
            + ("" if self._live is None else f"; {_usage_now(self._live)}")
        )

    def summary(self, *, applied: int, durable: int) -> dict[str, Any]:
        """Return the JSON object that ``--json`` prints; times in milliseconds, null without a scan."""
        return {
            "scans": self.scans,
            "points": self.points,
            "counts": dict(self._counts),
            "first_scan": self.first,
            "last_scan": self.last,
            "applied": applied,
            "durable": durable,
            "add_ms": self._add_ms.document,
        }


def usage_text(usage: LiveMapRow) -> str:
    """Return the size of a map as text: ``1,234,567 voxels known, 11.8 MiB, 27 chunks``."""
    waiting = f", {format_bytes(usage.waiting_bytes)} waiting" if usage.waiting_bytes else ""
    chunks = counted(usage.chunks, "chunk")
    return f"{counted(usage.active, 'voxel')} known, {format_bytes(usage.bytes)}, {chunks}{waiting}"


def _usage_now(live: LiveMap) -> str:
    """Return the present size of the map, or that the daemon does not answer, as text."""
    try:
        return usage_text(live.status())
    except (DaemonUnreachable, LiveInterrupted):
        return "the daemon does not answer"


def states_text(chunks: Sequence[ChunkInfo]) -> str:
    """Return the number of chunks in each state as text, most frequent first."""
    states = Counter(row.state for row in chunks)
    return ", ".join(f"{count:,} {state}" for state, count in states.most_common())


def _left_out(counts: Counter[str] | dict[str, int]) -> str:
    reasons = (("too_near", "too near"), ("outside_z", "too low or high"), ("not_finite", "not finite"))
    return ", ".join(f"{counts[name]:,} {words}" for name, words in reasons if counts[name])


def all_voxels(live: LiveMap, kind: str, scope: str = "memory") -> NDArray[np.float64]:
    """Return the centres of all occupied or free voxels, (N, 3), metres, map frame.

    Parameters
    ----------
    kind, scope
        As in `shmmap.live.LiveMap.voxels`.

    Raises
    ------
    OverBudget
        The daemon has no memory even for the voxels of a minimal box.
    """
    rows = live.chunks(saved=scope != "memory")
    keys = np.array([row.key for row in rows], np.int64).reshape(-1, 3) * _SIDE
    counts = np.array([row.occupied if kind == "occupied" else row.free for row in rows], np.int64)
    found = [np.empty((0, 3))]
    if not len(keys):
        return found[0]
    waiting = [(keys.min(axis=0), keys.max(axis=0) + _SIDE)]
    too_many = math.inf
    while waiting:
        low, high = waiting.pop()
        inside = (keys < high).all(axis=1) & (keys + _SIDE > low).all(axis=1)
        expected = int(counts[inside].sum())
        if expected and (expected < too_many or inside.sum() == 1):
            try:
                found.append(live.voxels(kind, _box(low, high, live.resolution), scope=scope).xyz)
            except OverBudget:
                if (high - low).max() == 1:
                    raise
                too_many = min(too_many, expected)
                waiting += _halves(low, high)
        elif expected:
            waiting += _halves(low, high)
    return np.concatenate(found)


def _box(low: NDArray[np.int64], high: NDArray[np.int64], resolution: float) -> Box:
    """Return the box of voxels from ``low`` to below ``high``; no voxel has its centre on a face."""
    (x0, y0, z0), (x1, y1, z1) = (low * resolution).tolist(), (high * resolution).tolist()
    return Box(x0, y0, x1, y1, (z0, z1))


def _halves(
    low: NDArray[np.int64], high: NDArray[np.int64]
) -> list[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Return two halves along the longest axis, split between chunks if there are several."""
    axis = int((high - low).argmax())
    size = int(high[axis] - low[axis])
    half = size // 2 if size <= _SIDE else size // _SIDE // 2 * _SIDE
    middle_high, middle_low = high.copy(), low.copy()
    middle_high[axis] = middle_low[axis] = low[axis] + half
    return [(low, middle_high), (middle_low, high)]
