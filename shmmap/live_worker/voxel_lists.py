# SPDX-License-Identifier: Apache-2.0
"""Lists of the voxels of an area, as files in shared memory: replies to requests for many voxels.

A list is N x 3 int32, the voxels' indices, followed by N int16, their log-odds in thousandths.  Its memory
counts towards the map's budget.  It is kept until its reader releases it, requests more lists than a session
may have, or disconnects, and for `KEPT_S` at most.  Then it is truncated to nothing, even if its reader has
it open or mapped.
"""

from __future__ import annotations

import contextlib
import errno
import math
import mmap
import os
import secrets
import time
from collections.abc import Callable, Generator, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap.chunks.layout import ChunkView
from shmmap.chunks.reading import select_voxels
from shmmap.chunks.voxels import ChunkKey, voxel_centers
from shmmap.errors import MapDataError, OverBudget
from shmmap.live_worker.areas import inside, touches
from shmmap.live_worker.paged_map import PagedMap
from shmmap.protocol.areas import LiveArea
from shmmap.protocol.live import MAX_LACKING, LackingChunk, LiveVoxels, LiveVoxelsReply

LISTS_PER_SESSION: Final = 4
VOXEL_BYTES: Final = 14
PART_OF_BUDGET: Final = 4
"""Divisor of the map's budget for all lists together."""
KEPT_S: Final = 10.0
"""How long a list is kept for its reader."""
ROOM_S: Final = 10.0
"""How long a list waits until chunks are evicted for it."""
ASK_AGAIN_S: Final = 0.005
FILES_PER_STEP: Final = 8
"""Chunks that a thread reads for a list before it serves others."""
BYTES_PER_STEP: Final = 256 << 10
LOST_PER_STEP: Final = 64
NAME: Final = "voxels."

_Part = tuple[NDArray[np.int32], NDArray[np.int16]]


@dataclass(frozen=True, slots=True)
class Later:
    """Seconds after which a request continues."""

    seconds: float


Steps = Generator[Callable[[], Any] | Later | None, Any, Any]
"""A request in progress: yields None after a step, `Later`, or a function for a thread, and gets its outcome.

It returns the reply.
"""


@dataclass(eq=False, slots=True)
class _List:
    session: int
    name: str
    nbytes: int
    until_s: float


@dataclass(eq=False)
class VoxelLists:
    """Makes lists of one map's voxels, step by step.

    Attributes
    ----------
    is_closed
        Whether the lists are closed: threads then read no further file.
    """

    paged: PagedMap
    _lists: list[_List] = field(default_factory=list)
    _making: int = 0
    _asked: list[int] = field(default_factory=list)
    is_closed: bool = False

    @property
    def nbytes(self) -> int:
        """Memory of all lists."""
        return sum(one.nbytes for one in self._lists)

    @property
    def asked_bytes(self) -> int:
        """The smallest amount of memory that a list waits for; 0 if none waits."""
        return min(self._asked, default=0)

    @property
    def next_expiry_s(self) -> float:
        """Time at which the next list expires; infinity for never."""
        return min((one.until_s for one in self._lists), default=math.inf)

    def collect(
        self, message: LiveVoxels, keys: Iterator[list[ChunkKey]], session: int, change: int
    ) -> Steps:
        """Make a list of the voxels of these chunks; return the reply, which names chunks that are lacking.

        Raises
        ------
        OverBudget
            The voxels need more memory than lists may use, or than is free at present.
        MapDataError
            A file cannot be read at present, and may be good.
        OSError
            The list cannot be written.
        """
        parts: list[_Part] = []
        lacking: dict[ChunkKey, str] = {}
        made = 0
        pick = partial(self._picked, message)

        def keep(part: _Part) -> None:
            nonlocal made
            if len(part[1]):
                parts.append(part)
                made += len(part[1]) * VOXEL_BYTES
                self._making += len(part[1]) * VOXEL_BYTES
                self._check(made, message.kind)

        try:
            for some in keys:
                cold: list[ChunkKey] = []
                for key in some:
                    there = self.paged.chunks.get(key)
                    if message.scope != "disk" and there is not None:
                        keep(pick(there.view))
                        yield None
                    elif message.scope != "memory" and key in self.paged.database.rows:
                        cold.append(key)
                for first in range(0, len(cold), FILES_PER_STEP):
                    found, lost = yield partial(self._read, cold[first : first + FILES_PER_STEP], pick)
                    for part in found:
                        keep(part)
                    for key in lost:
                        self.paged.note_lost(key, time.monotonic())
                        lacking[key] = "what was saved is damaged"
                yield None
            lacking |= yield from lacking_chunks(self.paged, message.area)
            yield from self._room(_pages(made))
            name = yield from self._write(parts, made, session)
        finally:
            self._making -= made
        count = made // VOXEL_BYTES
        return LiveVoxelsReply(message.request, change, name, count, made, *shown(lacking))

    def _check(self, made: int, kind: str) -> None:
        most = self.paged.limits.budget_bytes // PART_OF_BUDGET
        if self.nbytes + self._making > most:
            raise OverBudget(
                f"{made // VOXEL_BYTES} voxels and more are {kind} there: all lists together may take {most}"
                " bytes",
                hint="ask for a smaller area, or raise --live-budget",
            )

    def _picked(self, message: LiveVoxels, view: ChunkView) -> _Part:
        indices, log_odds = select_voxels(view, message.kind)
        if message.area is None:
            return indices, log_odds
        wanted = inside(message.area, voxel_centers(indices, self.paged.resolution))
        return indices[wanted], log_odds[wanted]

    def _read(
        self, keys: list[ChunkKey], pick: Callable[[ChunkView], _Part]
    ) -> tuple[list[_Part], list[ChunkKey]]:
        """Return voxels of chunks as last saved, and the chunks without a good file; called in a thread."""
        found: list[_Part] = []
        lost: list[ChunkKey] = []
        for key in keys:
            if self.is_closed:
                break
            try:
                data = self.paged.database.load(key)
            except OSError as error:
                raise MapDataError(
                    f"it cannot be read: {error.strerror}", path=key.text, cause="unreadable"
                ) from error
            if data is None:
                lost.append(key)
            else:
                found.append(pick(ChunkView(data)))
        return found, lost

    def _room(self, nbytes: int) -> Steps:
        """Wait until chunks are evicted for a list."""
        until_s = time.monotonic() + ROOM_S
        self._asked.append(nbytes)
        try:
            while nbytes and not self.paged.residency.fits(nbytes):
                if time.monotonic() >= until_s:
                    raise OverBudget(
                        f"a list of {nbytes} bytes has no room: chunks that cannot be saved take all of it",
                        hint="see what `shmmap live ls` says, or raise --live-budget",
                    )
                yield Later(ASK_AGAIN_S)
        finally:
            self._asked.remove(nbytes)

    def _write(
        self, parts: list[_Part], nbytes: int, session: int
    ) -> Generator[Callable[[], Any] | Later | None, Any, str]:
        memory = self.paged.memory
        one = _List(session, f"{memory.prefix}{NAME}{secrets.token_hex(8)}", _pages(nbytes), math.inf)
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC | os.O_NOFOLLOW
        fd = os.open(memory.path + one.name, flags, 0o600)
        self._lists.append(one)
        self.paged.residency.beside_bytes += one.nbytes
        try:
            for column in (0, 1):
                for part in parts:
                    left = np.ascontiguousarray(part[column]).data.cast("B")
                    while left:
                        done = os.write(fd, left[:BYTES_PER_STEP])
                        left = left[done:]
                        if done == BYTES_PER_STEP:
                            yield None
            memory.give_access(fd)
        except BaseException:
            self._remove([other for other in self._lists if other is one])
            raise
        finally:
            os.close(fd)
        one.until_s = time.monotonic() + KEPT_S
        kept = sorted(
            (other for other in self._lists if other.session == session), key=lambda other: other.until_s
        )
        self._remove(kept[:-LISTS_PER_SESSION])
        return one.name

    def release(self, session: int, name: str) -> None:
        """Remove a list of this session."""
        self._remove([one for one in self._lists if (one.session, one.name) == (session, name)])

    def expire(self, now_s: float) -> None:
        """Remove expired lists."""
        self._remove([one for one in self._lists if one.until_s <= now_s])

    def on_disconnect(self, session: int) -> None:
        """Remove the lists of a session that has ended."""
        self._remove([one for one in self._lists if one.session == session])

    def remove_all(self) -> None:
        """Remove all lists, including those of previous runs."""
        self._remove(list(self._lists))
        start = self.paged.memory.prefix.lstrip("/") + NAME
        for name in os.listdir(self.paged.memory.path):
            if name.startswith(start):
                self._free("/" + name)

    def _remove(self, lists: list[_List]) -> None:
        for one in lists:
            self._lists.remove(one)
            self.paged.residency.beside_bytes -= one.nbytes
            self._free(one.name)

    def _free(self, name: str) -> None:
        """Free a file's memory, even while readers use it, and remove its name."""
        path = self.paged.memory.path + name
        with contextlib.suppress(FileNotFoundError, PermissionError):  # files of other users are left alone
            try:
                fd = os.open(path, os.O_WRONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
            except OSError as error:
                if error.errno not in (errno.ELOOP, errno.ENXIO, errno.EISDIR):
                    raise
            else:
                try:
                    os.ftruncate(fd, 0)
                finally:
                    os.close(fd)
            os.unlink(path)


def lacking_chunks(paged: PagedMap, area: LiveArea | None) -> Generator[None, None, dict[ChunkKey, str]]:
    """Return the chunks that touch an area and have lost something, and what; yield after each step."""
    found: dict[ChunkKey, str] = {}
    for number, (text, one) in enumerate(dict(paged.database.record.lost).items(), 1):
        key = ChunkKey.from_text(text)
        if touches(area, key, paged.resolution):
            found[key] = one.text
        if number % LOST_PER_STEP == 0:
            yield None
    return found


def shown(lacking: Mapping[ChunkKey, str]) -> tuple[tuple[LackingChunk, ...], int]:
    """Return the first of these chunks, as many as an answer names, and the number of all."""
    rows = [LackingChunk(key, lacking[key]) for key in sorted(lacking)[:MAX_LACKING]]
    return tuple(rows), len(lacking)


def _pages(nbytes: int) -> int:
    """Return the memory used by a file of this many bytes."""
    return -(-nbytes // mmap.PAGESIZE) * mmap.PAGESIZE
