# SPDX-License-Identifier: Apache-2.0
"""`LiveMap`: what a program sees of a map that others write, and where it asks to write itself."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import TYPE_CHECKING, Final, TypeVar

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from shmmap import geometry
from shmmap.chunks.occupancy import Occupancy
from shmmap.chunks.voxels import ChunkKey, in_chunk, voxel_indices
from shmmap.client.live.attached_chunk import AttachedChunk
from shmmap.client.live.patience import until_served
from shmmap.client.live.voxels import Voxels, open_voxels
from shmmap.client.session import Session
from shmmap.errors import BadRequest, SegmentError, StaleHandle
from shmmap.protocol import live as messages
from shmmap.protocol.areas import BoxMessage, area_to_message

if TYPE_CHECKING:
    from shmmap.chunks.marking import ScanFilter
    from shmmap.client.live.mapper import LiveMapper

__all__ = ["ChunkInfo", "LiveMap", "Sphere"]

R = TypeVar("R")

LIST_S: Final = 60.0
"""How long putting voxels together may take, beside what any request may."""
SAVE_S: Final = 300.0
MOST_ATTACHED: Final = 512
"""Chunks that are kept mapped; the longest unused go first."""
VOXELS_AT_ONCE: Final = 1 << 20
"""Of rays, that are looked up at a time."""
_ROUNDS: Final = 4


class Sphere(msgspec.Struct, frozen=True):
    """All voxels whose middles are within ``radius`` metres of a place in the map's frame."""

    x: float
    y: float
    z: float
    radius: float


class ChunkInfo(msgspec.Struct, frozen=True):
    """One chunk of a live map.

    Attributes
    ----------
    key
        Which one.
    state
        ``loading``, ``clean``, ``dirty`` (changed since it was saved), ``saving``, or
        ``saved``: on disk alone.
    active, occupied, free
        Known voxels, and of these occupied and free ones.
    bytes
        Its memory, or its file.
    version
        Rises with each scan that it takes in.
    generation
        Another one each time that it comes into memory; 0 where it is not.
    """

    key: ChunkKey
    state: str
    active: int
    occupied: int
    free: int
    bytes: int
    version: int
    generation: int


class LiveMap:
    """A live map of the daemon; get one from `shmmap.Client.live`.

    Attributes
    ----------
    name, frame_id
        The map's, and that of its frame.
    map_id
        16 bytes: no other map has them.
    resolution
        Edge of a voxel, metres.
    """

    def __init__(self, session: Session, name: str, frame_id: str = "") -> None:
        self._session = session
        self.name = name
        self._frame_id = frame_id
        self._chunks: dict[ChunkKey, AttachedChunk] = {}
        self._rows: dict[ChunkKey, ChunkInfo] = {}
        self._change = 0
        self._open()

    def _open(self) -> None:
        self._opened = self._ask(
            lambda n: messages.LiveOpen(n, self.name, "", self._frame_id), messages.LiveOpened
        )
        opened = self._opened
        self.map_id, self.resolution, self.frame_id = opened.map_id, opened.resolution, opened.frame_id
        self._slot = self._session.welcome.session

    def _ask(self, make: Callable[[int], messages.LiveRequest], kind: type[R], *, quiet_s: float = 0.0) -> R:
        """Send a request; again if the process that keeps live maps is started anew."""
        return until_served(
            lambda: self._session.ask(make, kind, quiet_s=quiet_s), self._session.timeout_s + quiet_s
        )

    @property
    def occupancy(self) -> Occupancy:
        """What a hit and a miss are worth, as it was set when the map was made."""
        return Occupancy(*self._opened.probabilities)

    def __repr__(self) -> str:
        return f"<LiveMap {self.name}, voxels of {self.resolution} m in frame {self.frame_id}>"

    def mapper(
        self, name: str, scan_filter: ScanFilter | None = None, *, timeout_s: float = 60.0
    ) -> LiveMapper:
        """Send scans to this map.

        Parameters
        ----------
        name
            Which mapper this is, at most 64 characters: each program that maps has its own, and keeps it.
        scan_filter
            Which points count.
        timeout_s
            How long a scan may take until it is applied, a restart of the daemon included.

        Raises
        ------
        NotPermitted
            This user may not map.
        PackageMissing
            numba is not installed.
        """
        from shmmap.client.live.mapper import LiveMapper  # imports compiled kernels

        return LiveMapper(self._session, self.name, name, self.frame_id, scan_filter, timeout_s)

    def move_to(self, x: float, y: float, z: float) -> None:
        """Say where this process is, metres in the map's frame: chunks around it stay in memory."""
        self._ask(
            lambda n: messages.LiveMove(n, self.name, (float(x), float(y), float(z))), messages.LiveMoved
        )

    def save(self, *, timeout_s: float = SAVE_S) -> int:
        """Have everything that is applied by now saved; returns how many files there are.

        Raises
        ------
        NotPermitted
            This user may not map.
        NoAnswer
            It took longer: a disk is full, or slow; see `status`.
        """
        reply = self._ask(lambda n: messages.LiveSave(n, self.name), messages.LiveDurable, quiet_s=timeout_s)
        return reply.files

    def status(self) -> messages.LiveMapRow:
        """How the map is: chunks, memory, files, problems."""
        reply = self._ask(messages.LiveList, messages.LiveListed)
        for row in reply.maps:
            if row.name == self.name:
                return row
        raise StaleHandle(f"the daemon does not keep live map {self.name!r} any more")

    # --- chunks ---------------------------------------------------------------------------------

    def chunks(self, area: geometry.Box | Sphere | None = None, *, saved: bool = False) -> list[ChunkInfo]:
        """List chunks in memory, in the order of their keys.

        Parameters
        ----------
        area
            Only chunks that touch it.
        saved
            Those that are on disk alone, too.
        """
        return list(self._pages(area, 0, saved=saved)[0].values())

    def _pages(
        self, area: geometry.Box | Sphere | None, since: int, *, saved: bool = False
    ) -> tuple[dict[ChunkKey, ChunkInfo], list[ChunkKey], int, bool]:
        """What changed after ``since``, what left, the number to ask with next time, if that was known."""
        message = _area(area)
        found: dict[ChunkKey, ChunkInfo] = {}
        gone: list[ChunkKey] = []
        after: messages.Key | None = None
        change, known = -1, True
        while True:
            start = after
            page = self._ask(
                lambda n, start=start: messages.LiveChunks(n, self.name, message, since, saved, start),  # type: ignore[misc]
                messages.LiveChunkPage,
            )
            if change < 0:
                change, known = page.change, page.since_known
                gone = [ChunkKey(*key) for key in page.gone]
            for row in page.rows:
                key = ChunkKey(*row.key)
                found[key] = ChunkInfo(
                    key, row.state, row.active, row.occupied, row.free, row.bytes, row.version, row.generation
                )
            if not page.more or not page.rows:
                return found, gone, change, known
            after = page.rows[-1].key

    def _refresh(self) -> None:
        """Learn which chunks are in memory now."""
        rows, gone, change, known = self._pages(None, self._change)
        if not known or not self._change:
            self._rows = rows
        else:
            for key in gone:
                self._rows.pop(key, None)
            self._rows.update(rows)
        self._change = change

    def _attached(self, key: ChunkKey) -> AttachedChunk | None:
        """A chunk in memory, mapped; None where there is none."""
        row = self._rows.get(key)
        mapped = self._chunks.pop(key, None)
        if row is None or row.generation == 0:
            return None
        if mapped is None or not mapped.in_service:
            path = f"{self._shm_dir}{self._opened.prefix}{key.text}.{row.generation}"
            mapped = AttachedChunk(path, key, row.generation, self.map_id, self._session.welcome.session)
        self._chunks[key] = mapped  # the last used comes last
        while len(self._chunks) > MOST_ATTACHED:
            self._chunks.pop(next(iter(self._chunks)))
        return mapped

    @property
    def _shm_dir(self) -> str:
        return os.environ.get("SHMMAP_LIVE_SHM_DIR") or self._opened.shm_dir

    # --- voxels ---------------------------------------------------------------------------------

    def voxels(
        self,
        kind: str = "occupied",
        area: geometry.Box | Sphere | None = None,
        *,
        scope: str = "memory",
        since: int = 0,
    ) -> Voxels:
        """Voxels of an area, which the daemon puts together in shared memory.

        Parameters
        ----------
        kind
            ``occupied`` or ``free``.
        area
            Only voxels whose middles lie in it; None: all.
        scope
            ``memory``, ``disk`` (as last saved), or ``all``: what is not in memory as last saved.
        since
            `Voxels.change` of an earlier answer: only voxels of chunks that have changed since.

        Raises
        ------
        OverBudget
            There are too many for the daemon's memory: ask for a smaller area.
        """
        message = _area(area)
        reply = self._ask(
            lambda n: messages.LiveVoxels(n, self.name, kind, message, scope, since),
            messages.LiveVoxelsReply,
            quiet_s=LIST_S,
        )
        try:
            return open_voxels(self._shm_dir + reply.segment, reply.count, self.resolution, reply.change)
        finally:
            self._ask(lambda n: messages.LiveRelease(n, self.name, reply.segment), messages.LiveReleased)

    def occupied(self, area: geometry.Box | Sphere | None = None) -> NDArray[np.float64]:
        """Middles of the occupied voxels in memory, (N, 3) metres in the map's frame."""
        return self.voxels("occupied", area).xyz

    def free(self, area: geometry.Box | Sphere | None = None) -> NDArray[np.float64]:
        """Middles of the free voxels in memory, (N, 3) metres in the map's frame."""
        return self.voxels("free", area).xyz

    def log_odds(self, xyz: ArrayLike) -> NDArray[np.int16]:
        """What is known of the voxels in which points lie, from chunks that are in memory.

        Parameters
        ----------
        xyz
            (N, 3) metres, map frame.

        Returns
        -------
        (N,) int16, thousandths: above `occupied_above` occupied, below `free_below` free, 0 unknown.
        """
        self._refresh()
        return self._look_up(voxel_indices(np.asarray(xyz, np.float64).reshape(-1, 3), self.resolution))

    @property
    def occupied_above(self) -> int:
        """Voxels of more log-odds are occupied; thousandths."""
        return self._opened.occupied_above

    @property
    def free_below(self) -> int:
        """Voxels of less log-odds are free; thousandths."""
        return self._opened.free_below

    def _look_up(self, indices: NDArray[np.int32]) -> NDArray[np.int16]:
        found = np.zeros(len(indices), np.int16)
        if not len(indices):
            return found
        keys, places = in_chunk(indices)
        chunks, which = np.unique(keys, axis=0, return_inverse=True)
        which = which.reshape(-1)
        order = np.argsort(which, kind="stable")
        ends = np.cumsum(np.bincount(which, minlength=len(chunks)))
        begin = 0
        for key, end in zip(chunks.tolist(), ends.tolist(), strict=True):
            rows = order[begin:end]
            begin = end
            dense = self._dense(ChunkKey(*key))
            if dense is not None:
                found[rows] = dense[places[rows]]
        return found

    def _dense(self, key: ChunkKey) -> NDArray[np.int16] | None:
        for _ in range(_ROUNDS):
            try:
                chunk = self._attached(key)
                return chunk.dense() if chunk is not None else None
            except StaleHandle:  # noqa: PERF203  asked again, a few times
                self._chunks.pop(key, None)
                self._refresh()
        raise SegmentError(f"chunk {key.text} is written and given up all the time", hint="ask again")

    def first_hits(self, origins: ArrayLike, ends: ArrayLike) -> NDArray[np.float64]:
        """How far rays get: the distance to the first occupied voxel on each.

        The walk is that of mapping: a ray visits as many voxels as its longest axis has steps.

        Parameters
        ----------
        origins, ends
            (N, 3) or (3,) metres, map frame.

        Returns
        -------
        (N,) float64, metres from the origin to the middle of the first occupied voxel; infinity where there
        is none on the way, the last voxel included.
        """
        ends = np.asarray(ends, np.float64).reshape(-1, 3)
        origins = np.broadcast_to(np.asarray(origins, np.float64).reshape(-1, 3), ends.shape)
        first, last = voxel_indices(origins, self.resolution), voxel_indices(ends, self.resolution)
        steps = np.abs(last.astype(np.int64) - first).max(axis=1, initial=0)
        found = np.full(len(ends), np.inf)
        self._refresh()
        size = max(1, VOXELS_AT_ONCE // (int(steps.max(initial=0)) + 1))
        for begin in range(0, len(ends), size):
            part = slice(begin, begin + size)
            found[part] = self._hits(origins[part], first[part], last[part], steps[part])
        return found

    def _hits(
        self,
        origins: NDArray[np.float64],
        first: NDArray[np.int32],
        last: NDArray[np.int32],
        steps: NDArray[np.int64],
    ) -> NDArray[np.float64]:
        count = int(steps.max(initial=0)) + 1
        at = np.minimum(np.arange(count), steps[:, None])
        delta = last.astype(np.int64) - first
        way = np.abs(delta)[:, None, :] * at[:, :, None]
        whole = np.maximum(steps, 1)[:, None, None]
        moved = np.sign(delta)[:, None, :] * ((2 * way + whole) // (2 * whole))
        voxels = (first[:, None, :] + moved).astype(np.int32)
        hit = self._look_up(voxels.reshape(-1, 3)).reshape(len(first), count) > self.occupied_above
        which = hit.argmax(axis=1)
        rows = np.arange(len(first))
        away = (voxels[rows, which] + 0.5) * self.resolution - origins
        distance = np.sqrt((away * away).sum(axis=1))
        found: NDArray[np.float64] = np.where(hit.any(axis=1), distance, np.inf)
        return found


def _area(area: geometry.Box | Sphere | None) -> messages.LiveArea | None:
    if area is None:
        return None
    if isinstance(area, Sphere):
        return messages.SphereMessage(area.x, area.y, area.z, area.radius)
    message = area_to_message(area)
    if not isinstance(message, BoxMessage):
        raise BadRequest("an area of a live map is a Box or a Sphere")
    return message
