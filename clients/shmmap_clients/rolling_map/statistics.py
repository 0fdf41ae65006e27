# SPDX-License-Identifier: Apache-2.0
"""Counts and times of a drive: a line for each scan, and a summary; its size does not depend on how many."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

from shmmap import ChunkInfo, Counts, LiveMapRow
from shmmap_clients.decimation import Decimated
from shmmap_clients.rolling_map.drive import MappedScan
from shmmap_clients.spread import RunningSpread

__all__ = ["DriveStatistics", "states_text", "usage_text"]


class DriveStatistics:
    """Sums over the scans of a drive."""

    def __init__(self) -> None:
        self.scans = 0
        self.points = 0
        self.first: int | None = None
        self.last: int | None = None
        self._counts: Counter[str] = Counter(dict.fromkeys(Counts.__struct_fields__, 0))
        self._path: Decimated[tuple[float, float, float]] = Decimated()
        self._position: tuple[float, float, float] | None = None
        self._add_ms = RunningSpread()

    def add(self, mapped: MappedScan) -> None:
        """Count one scan."""
        self.scans += 1
        self.points += len(mapped.scan.xyz)
        self.first = mapped.number if self.first is None else self.first
        self.last = mapped.number
        self._counts.update({name: getattr(mapped.counts, name) for name in Counts.__struct_fields__})
        self._add_ms.add(mapped.add_s * 1e3)
        T = mapped.scan.T_map_sensor
        if T is not None:
            x, y, z = T[:3, 3].tolist()
            self._position = (x, y, z)
            self._path.add(self._position)

    @property
    def counted(self) -> int:
        """Points that said something: in range, or beyond it."""
        return self._counts["near"] + self._counts["far"]

    @property
    def path(self) -> Sequence[tuple[float, float, float]]:
        """Where the sensor was, metres; of a long drive a part of the places."""
        path = self._path.values
        return path if self._position is None or path[-1] == self._position else [*path, self._position]

    @property
    def left_out(self) -> str:
        """Why points were left out, and how many; empty where none was."""
        return _left_out(self._counts)

    def line(self, mapped: MappedScan) -> str:
        """One line about the latest scan."""
        counts = {name: getattr(mapped.counts, name) for name in Counts.__struct_fields__}
        left_out = _left_out(counts)
        return (
            f"{mapped.scan.name}: {len(mapped.scan.xyz)} points, {counts['near']} in range,"
            f" {counts['far']} beyond"
            + (f", {left_out}" if left_out else "")
            + f"; {mapped.add_s * 1e3:.1f} ms"
            + (f", {mapped.on_their_way} on their way" if mapped.on_their_way > 1 else "")
        )

    def summary(self, *, applied: int, durable: int) -> dict[str, Any]:
        """Return what ``--json`` prints of the drive; times in milliseconds, null without a scan."""
        spread = self._add_ms.spread
        return {
            "scans": self.scans,
            "points": self.points,
            "counts": dict(self._counts),
            "first_scan": self.first,
            "last_scan": self.last,
            "applied": applied,
            "durable": durable,
            "add_ms": {"p50": spread.p50, "p99": spread.p99, "max": spread.max} if self.scans else None,
        }


def usage_text(usage: LiveMapRow) -> str:
    """What a map takes, in words: 1 234 567 active cells, 12.3 MB, 27 chunks."""
    waiting = f", {usage.waiting_bytes / 1e6:.1f} MB waiting" if usage.waiting_bytes else ""
    active = f"{usage.active:,}".replace(",", " ")
    return f"{active} active cells, {usage.bytes / 1e6:.1f} MB, {usage.chunks} chunks{waiting}"


def states_text(chunks: Sequence[ChunkInfo]) -> str:
    """How many chunks are in which state, in words; the most frequent first."""
    states = Counter(row.state for row in chunks)
    return ", ".join(f"{count} {state}" for state, count in states.most_common())


def _left_out(counts: Counter[str] | dict[str, int]) -> str:
    reasons = (("too_near", "too near"), ("outside_z", "too low or high"), ("not_finite", "not finite"))
    return ", ".join(f"{counts[name]} {words}" for name, words in reasons if counts[name])
