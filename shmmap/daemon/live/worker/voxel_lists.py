# SPDX-License-Identifier: Apache-2.0
"""Voxels of an area, put together into a file in shared memory: the answer to whoever asks for many.

A list is N x 3 int32, the voxels' indices, and behind them N int16, their log-odds in thousandths.  Its name
goes when the reader has opened it, asks for more lists than a session may have, or leaves.
"""

from __future__ import annotations

import contextlib
import os
import secrets
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from shmmap.chunks.chunk_file import decode_chunk
from shmmap.chunks.layout import ChunkView
from shmmap.chunks.reading import select_voxels
from shmmap.chunks.voxels import ChunkKey, voxel_centers
from shmmap.daemon.live.live_map import LiveMap
from shmmap.errors import BadRequest, MapDataError, OverBudget
from shmmap.protocol.live import LiveArea, LiveVoxels, LiveVoxelsReply, SphereMessage

__all__ = ["VoxelLists", "check_area", "touches"]

LISTS_OF_A_SESSION: Final = 4
VOXEL_BYTES: Final = 14
PART_OF_BUDGET: Final = 4
"""All lists together may take this part of the map's budget."""
CHUNKS_A_STEP: Final = 8
NAME: Final = "voxels."


def check_area(area: LiveArea) -> None:
    """Refuse an area that makes no sense; `BadRequest`."""
    if isinstance(area, SphereMessage):
        good = bool(np.isfinite([area.x, area.y, area.z, area.radius]).all()) and area.radius >= 0.0
    else:
        low, high = (area.min_x, area.min_y), (area.max_x, area.max_y)
        if (area.z_min is None) != (area.z_max is None):
            raise BadRequest("area: a z range has two ends")
        if area.z_min is not None and area.z_max is not None:
            low, high = (*low, area.z_min), (*high, area.z_max)  # type: ignore[assignment]
        good = bool(np.isfinite([*low, *high]).all()) and all(a <= b for a, b in zip(low, high, strict=True))
    if not good:
        raise BadRequest("area: it is not finite, or nothing can lie in it")


def touches(area: LiveArea | None, key: ChunkKey, resolution: float) -> bool:
    """Whether a chunk and an area have anything in common."""
    if area is None:
        return True
    low_x, low_y, low_z, high_x, high_y, high_z = key.box(resolution)
    if isinstance(area, SphereMessage):
        gaps = (
            max(low - value, 0.0, value - high)
            for value, low, high in (
                (area.x, low_x, high_x), (area.y, low_y, high_y), (area.z, low_z, high_z),
            )
        )  # fmt: skip
        return sum(gap * gap for gap in gaps) <= area.radius**2
    flat = low_x <= area.max_x and high_x >= area.min_x and low_y <= area.max_y and high_y >= area.min_y
    if area.z_min is None or area.z_max is None:
        return flat
    return flat and low_z <= area.z_max and high_z >= area.z_min


def inside(area: LiveArea | None, centers: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which of these places, (N, 3) metres, lie in an area."""
    if area is None:
        return np.ones(len(centers), np.bool_)
    found: NDArray[np.bool_]
    if isinstance(area, SphereMessage):
        away = centers - np.array([area.x, area.y, area.z])
        found = (away * away).sum(axis=1) <= area.radius**2
        return found
    x, y, z = centers.T
    found = (x >= area.min_x) & (x <= area.max_x) & (y >= area.min_y) & (y <= area.max_y)
    if area.z_min is not None and area.z_max is not None:
        found &= (z >= area.z_min) & (z <= area.z_max)
    return found


@dataclass(eq=False)
class VoxelLists:
    """Makes lists of one map's voxels, a step at a time.

    Parameters
    ----------
    live
        The map.
    path, mode, gid
        Directory of the lists, and who may read them.
    """

    live: LiveMap
    path: str
    mode: int
    gid: int
    _names: dict[int, deque[tuple[str, int]]] = field(default_factory=dict)
    _making: int = 0

    @property
    def nbytes(self) -> int:
        """Memory of all lists that have names, and of those that are being made."""
        return self._making + sum(nbytes for names in self._names.values() for _, nbytes in names)

    def collect(
        self, message: LiveVoxels, keys: Iterable[ChunkKey], session: int, change: int
    ) -> Iterator[LiveVoxelsReply | None]:
        """Make a list, of these chunks; the last thing that this gives is the reply.

        Raises
        ------
        OverBudget
            There are more voxels than lists may take memory.
        BadRequest
            The request makes no sense.
        """
        parts: list[tuple[NDArray[np.int32], NDArray[np.int16]]] = []
        most = self.live.limits.budget_bytes // PART_OF_BUDGET
        count = 0
        try:
            for number, key in enumerate(keys):
                there = self.live.chunks.get(key) if message.scope != "disk" else None
                if number % CHUNKS_A_STEP == CHUNKS_A_STEP - 1 or there is None:
                    yield None
                view = self._view(key, message.scope)
                if view is None:
                    continue
                indices, log_odds = select_voxels(view, message.kind)
                wanted = inside(message.area, voxel_centers(indices, self.live.files.settings.resolution))
                parts.append((indices[wanted], log_odds[wanted]))
                more = len(parts[-1][1])
                count += more
                self._making += more * VOXEL_BYTES
                if self.nbytes > most:
                    raise OverBudget(
                        f"{count} voxels and more are {message.kind} there: all lists together may take"
                        f" {most} bytes",
                        hint="ask for a smaller area, or raise --live-budget",
                    )
            name = self._write(parts, session)
        finally:
            self._making -= count * VOXEL_BYTES
        yield LiveVoxelsReply(message.request, change, name, count, count * VOXEL_BYTES)

    def _view(self, key: ChunkKey, scope: str) -> ChunkView | None:
        """A chunk as it is in memory, or on disk; None where it is not there."""
        there = self.live.chunks.get(key)
        if scope != "disk" and there is not None:
            return there.view
        data = self.live.files.load(key) if scope != "memory" else None
        if data is None:
            return None
        try:
            return ChunkView(decode_chunk(data, self.live.identity(key, 0), key.text))
        except MapDataError:
            return None  # it is put aside when it is loaded

    def _write(self, parts: list[tuple[NDArray[np.int32], NDArray[np.int16]]], session: int) -> str:
        name = f"{self.live.memory.prefix}{NAME}{secrets.token_hex(8)}"
        fd = os.open(
            self.path + name, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600
        )
        try:
            with open(fd, "wb") as file:
                for column in (0, 1):
                    for part in parts:
                        file.write(np.ascontiguousarray(part[column]).data)
                file.flush()
                if self.gid >= 0:
                    os.fchown(fd, -1, self.gid)
                os.fchmod(fd, self.mode)
                nbytes = os.fstat(fd).st_blocks * 512
        except OSError:
            self._remove(name)
            raise
        names = self._names.setdefault(session, deque())
        names.append((name, nbytes))
        if len(names) > LISTS_OF_A_SESSION:
            self._remove(names.popleft()[0])
        return name

    def release(self, session: int, name: str) -> None:
        """Take a list's name away, of those that this session was given."""
        names = self._names.get(session, deque())
        for row in list(names):
            if row[0] == name:
                names.remove(row)
                self._remove(name)

    def left(self, session: int) -> None:
        """A session has ended."""
        for name, _ in self._names.pop(session, ()):
            self._remove(name)

    def remove_all(self) -> None:
        """Take all names away, those of an earlier life too."""
        self._names.clear()
        start = self.live.memory.prefix.lstrip("/") + NAME
        for name in os.listdir(self.path):
            if name.startswith(start):
                self._remove("/" + name)

    def _remove(self, name: str) -> None:
        with contextlib.suppress(FileNotFoundError, PermissionError):  # somebody else's is not one of ours
            os.unlink(self.path + name)
