# SPDX-License-Identifier: Apache-2.0
"""`LiveMap`: a program's view of a live map, which others may be writing."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final, TypeVar

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

import shmmap.geometry as geometry
from shmmap.chunks.occupancy import Occupancy
from shmmap.chunks.voxels import ChunkKey, voxel_centers
from shmmap.client.arguments import checked_seconds
from shmmap.client.connection import until_served
from shmmap.client.live.chunk_reader import ChunkInfo, ChunkReader, Place
from shmmap.client.live.problems import PROBLEM_S, with_problem
from shmmap.client.session import Session
from shmmap.errors import BadRequest, NoAnswer, SegmentCorrupt, SegmentError, StaleHandle
from shmmap.lacking import warn_of_lost_chunks
from shmmap.lazy_imports import needed_packages
from shmmap.protocol import live as messages
from shmmap.protocol.areas import FURTHEST_M, BoxMessage, LiveArea, SphereMessage, area_to_message

if TYPE_CHECKING:
    from shmmap.chunks.occupancy import ScanFilter
    from shmmap.client.live.mapper import LiveMapper

R = TypeVar("R")

LIST_S: Final = 60.0
"""How long a list of voxels may take, beyond the timeout of any request."""
SAVE_S: Final = 300.0
MAX_RAY_VOXELS: Final = 100_000
"""Longest ray along an axis, in voxels: 5 km of voxels of 5 cm take about half a second."""
LIST_TRIES: Final = 4
"""How often a list of voxels is requested: a list may be removed while it is read."""
_VOXEL_BYTES: Final = 14


class Sphere(msgspec.Struct, frozen=True):
    """All voxels whose centres are within ``radius`` metres of a place in the map's frame."""

    x: float
    y: float
    z: float
    radius: float


@dataclass(frozen=True, slots=True)
class Voxels:
    """Voxels of one kind in an area, as the daemon lists them.

    Attributes
    ----------
    indices
        (N, 3) int32: ``floor(x / resolution)`` along each axis.
    log_odds
        (N,) int16, thousandths.
    resolution
        Edge of a voxel, metres.
    change
        Number of the map's last change before the list was made; pass it as ``since`` to get later changes.
    lacking
        Chunks of the area of which something that was saved is lost, each with what: their file is damaged or
        gone.  At most 64; a `ShmmapWarning` names them, too.
    """

    indices: NDArray[np.int32]
    log_odds: NDArray[np.int16]
    resolution: float
    change: int
    lacking: dict[ChunkKey, str] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.log_odds)

    @property
    def xyz(self) -> NDArray[np.float64]:
        """The voxels' centres, (N, 3) metres in the map's frame."""
        return voxel_centers(self.indices, self.resolution)

    @property
    def probability(self) -> NDArray[np.float64]:
        """Probability that each voxel is occupied, (N,), between 0 and 1."""
        odds = self.log_odds.astype(np.float64) / 1000.0
        chance: NDArray[np.float64] = 1.0 / (1.0 + np.exp(-odds))
        return chance


class LiveMap:
    """A live map of the daemon; get one from `shmmap.Client.live`.

    Attributes
    ----------
    name, frame_id
        Names of the map and of its frame.
    map_id
        Unique id of the map, 16 bytes.
    resolution
        Edge of a voxel, metres.
    """

    def __init__(self, session: Session, name: str, frame_id: str = "") -> None:
        self._session = session
        self.name = name
        self._frame_id = frame_id
        self._open()
        self._warned: tuple[messages.LackingChunk, ...] = ()
        self._reader = ChunkReader(self._place, lambda since: self._pages(None, since))

    def _open(self) -> None:
        self._opened = self._ask(
            lambda n: messages.LiveOpen(n, self.name, "", self._frame_id), messages.LiveOpened
        )
        opened = self._opened
        self.map_id, self.resolution, self.frame_id = opened.map_id, opened.resolution, opened.frame_id

    def _ask(self, make: Callable[[int], messages.LiveRequest], kind: type[R], *, quiet_s: float = 0.0) -> R:
        """Send a request; repeat it while the process that keeps live maps is restarting."""
        try:
            return until_served(
                lambda: self._session.ask(make, kind, quiet_s=quiet_s), self._session.timeout_s + quiet_s
            )
        except NoAnswer as error:
            if not quiet_s:  # the daemon itself does not answer
                raise
            raise with_problem(
                error,
                self.name,
                lambda: self._session.ask(messages.LiveList, messages.LiveListed, timeout_s=PROBLEM_S),
            ) from error

    @property
    def occupancy(self) -> Occupancy:
        """The map's log-odds parameters (weights of hits and misses), as set when it was created."""
        return Occupancy(*self._opened.probabilities)

    def __repr__(self) -> str:
        return f"<LiveMap {self.name}, voxels of {self.resolution} m in frame {self.frame_id}>"

    def mapper(
        self,
        name: str,
        scan_filter: ScanFilter | None = None,
        *,
        resume: bool = False,
        timeout_s: float = 60.0,
    ) -> LiveMapper:
        """Return a mapper that sends scans to this map.

        Parameters
        ----------
        name
            Name of the mapper, at most 64 characters.  Each mapping program has its own, the same in every
            run.
        scan_filter
            Selects the points to use.
        resume
            For a program that adds the same scans in the same order in every run, from files: it must
            continue with the scan after `LiveMapper.applied`.  If it begins earlier, scans get other numbers
            and are counted twice.
        timeout_s
            Seconds until a scan must be applied, a restart of the daemon included.

        Raises
        ------
        NotPermitted
            This user may not map.
        PackageMissing
            numba is not installed.
        """
        with needed_packages("mapping"):
            from shmmap.client.live.mapper import LiveMapper  # imports compiled kernels

        return LiveMapper(
            self._session, self.name, name, self.frame_id, scan_filter, timeout_s, resume=resume
        )

    def move_to(self, x: float, y: float, z: float) -> None:
        """Set this process's position, metres in the map's frame: chunks around it stay in memory."""
        place = _points("position", [x, y, z])[0].tolist()
        self._ask(lambda n: messages.LiveMove(n, self.name, tuple(place)), messages.LiveMoved)

    def save(self, *, timeout_s: float = SAVE_S) -> int:
        """Save all applied scans; return the number of files of the map.

        Raises
        ------
        NotPermitted
            This user may not map.
        NoAnswer
            Saving took longer, because a disk is full or slow; see `status`.
        """
        seconds = checked_seconds(timeout_s)
        reply = self._ask(lambda n: messages.LiveSave(n, self.name), messages.LiveDurable, quiet_s=seconds)
        return reply.files

    def status(self) -> messages.LiveMapRow:
        """Return the state of the map: chunks, memory, files, problems."""
        reply = self._ask(messages.LiveList, messages.LiveListed)
        for row in reply.maps:
            if row.name == self.name:
                return row
        raise StaleHandle(f"the daemon does not keep live map {self.name!r} any more")

    # --- chunks ---------------------------------------------------------------------------------

    def chunks(self, area: geometry.Box | Sphere | None = None, *, saved: bool = False) -> list[ChunkInfo]:
        """List chunks that are in memory, or being loaded or saved, in the order of their keys.

        Parameters
        ----------
        area
            Only chunks that touch it.
        saved
            Also list chunks that are only on disk.
        """
        return list(self._pages(area, 0, saved=saved)[0].values())

    def _pages(
        self, area: geometry.Box | Sphere | None, since: int, *, saved: bool = False
    ) -> tuple[dict[ChunkKey, ChunkInfo], list[ChunkKey], int, bool]:
        """Return changed chunks, keys that left memory, the last change, and whether ``since`` is known."""
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
                if page.lacking != self._warned:  # each look-up asks for a page
                    self._warned = page.lacking
                    warn_of_lost_chunks(self.name, page.lacking, page.lacking_count)
                gone = [ChunkKey(*key) for key in page.gone]
            for row in page.rows:
                key = ChunkKey(*row.key)
                found[key] = ChunkInfo(
                    key, row.state, row.active, row.occupied, row.free, row.bytes, row.version, row.generation
                )
            if not page.more or not page.rows:
                return found, gone, change, known
            after = page.rows[-1].key

    def lost(self, area: geometry.Box | Sphere | None = None) -> dict[ChunkKey, str]:
        """Return the chunks of which something that was saved is lost, each with what; at most 64.

        Each stays in this list, also when it is mapped again, until ``shmmap live fsck --repair`` forgets it.

        Parameters
        ----------
        area
            Only chunks that touch it.
        """
        message, since = _area(area), max(1, self.status().change)
        page = self._ask(lambda n: messages.LiveChunks(n, self.name, message, since), messages.LiveChunkPage)
        return _by_key(page.lacking)

    def _place(self) -> Place:
        opened = self._opened
        return Place(self._shm_dir + opened.prefix, self.map_id, self.resolution, opened.occupied_above)

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
        """List the voxels of an area; the daemon collects them.

        Parameters
        ----------
        kind
            ``occupied`` or ``free``.
        area
            Only voxels whose centres lie in it; None: all.
        scope
            ``memory``, ``disk`` (as last saved), or ``all``: chunks in memory, and all others as last saved.
        since
            `Voxels.change` of a previous list: only voxels of chunks that have changed since.

        Raises
        ------
        OverBudget
            There are too many voxels for the daemon's memory; request a smaller area.
        MapDataError
            The file of a chunk cannot be read at present, and may be good.
        """
        message = _area(area)

        def ask(request: int) -> messages.LiveRequest:
            return messages.LiveVoxels(request, self.name, kind, message, scope, since)

        for _ in range(LIST_TRIES - 1):
            with contextlib.suppress(StaleHandle):  # the worker ended, or this process was stopped for long
                return self._listed(ask)
        return self._listed(ask)

    def _listed(self, ask: Callable[[int], messages.LiveRequest]) -> Voxels:
        reply = self._ask(ask, messages.LiveVoxelsReply, quiet_s=LIST_S)
        try:
            path = self._shm_dir + reply.segment
            found = _read_voxels(path, reply.count, self.resolution, reply.change)
        finally:
            self._ask(lambda n: messages.LiveRelease(n, self.name, reply.segment), messages.LiveReleased)
        warn_of_lost_chunks(self.name, reply.lacking, reply.lacking_count)
        return replace(found, lacking=_by_key(reply.lacking))

    def occupied(self, area: geometry.Box | Sphere | None = None) -> NDArray[np.float64]:
        """Return centres of the occupied voxels in memory, (N, 3) metres in the map's frame."""
        return self.voxels("occupied", area).xyz

    def free(self, area: geometry.Box | Sphere | None = None) -> NDArray[np.float64]:
        """Return centres of the free voxels in memory, (N, 3) metres in the map's frame."""
        return self.voxels("free", area).xyz

    def log_odds(self, xyz: ArrayLike) -> NDArray[np.int16]:
        """Return the log-odds of the voxels that contain the points, from chunks in memory.

        Parameters
        ----------
        xyz
            (N, 3) metres, map frame.

        Returns
        -------
        (N,) int16, thousandths: occupied above `occupied_above`, free below `free_below`, unknown at 0.
        """
        return self._reader.look_up(_points("xyz", xyz))

    @property
    def occupied_above(self) -> int:
        """Log-odds above which a voxel is occupied, thousandths."""
        return self._opened.occupied_above

    @property
    def free_below(self) -> int:
        """Log-odds below which a voxel is free, thousandths."""
        return self._opened.free_below

    def first_hits(self, origins: ArrayLike, ends: ArrayLike) -> NDArray[np.float64]:
        """Return the distance to the first occupied voxel on each ray.

        Rays are traversed as in mapping: a ray visits one voxel per step along its longest axis.

        Parameters
        ----------
        origins, ends
            (N, 3) or (3,) metres, map frame.

        Returns
        -------
        (N,) float64, metres from the origin to the centre of the first occupied voxel; infinity if no voxel
        is occupied up to and including the last one.

        Raises
        ------
        BadRequest
            A ray is longer than 100 000 voxels along an axis, or is not a valid ray.
        """
        ends = _points("ends", ends)
        origins = _points("origins", origins)
        if len(origins) not in (1, len(ends)):
            raise BadRequest(
                f"{len(origins)} origins of {len(ends)} rays: give each its own, or all the same one"
            )
        origins = np.broadcast_to(origins, ends.shape)
        longest = float(np.abs(ends - origins).max(initial=0.0))
        if not longest <= MAX_RAY_VOXELS * self.resolution:  # nor NaN
            most = f"{MAX_RAY_VOXELS * self.resolution:.6g} m for voxels of {self.resolution} m"
            raise BadRequest(
                f"a ray is {longest:.6g} m long; at most {most}", hint="cut it where the map ends"
            )
        return self._reader.first_hits(origins, ends)


def _by_key(lacking: tuple[messages.LackingChunk, ...]) -> dict[ChunkKey, str]:
    return {ChunkKey(*one.key): one.reason for one in lacking}


def _points(what: str, values: ArrayLike) -> NDArray[np.float64]:
    """Return points as an (N, 3) array; raise BadRequest if they are invalid or masked."""
    try:
        if np.ma.is_masked(values):
            raise ValueError("some are masked")
        return np.asarray(values, np.float64).reshape(-1, 3)
    except OverflowError as error:
        raise BadRequest(f"{what}: a number of metres is not finite") from error
    except (TypeError, ValueError) as error:
        raise BadRequest(f"{what}: need numbers of the shape (N, 3): {error}") from None


def _area(area: geometry.Box | Sphere | None) -> LiveArea | None:
    if area is None:
        return None
    if isinstance(area, Sphere):
        x, y, z, radius = _metres(area.x, area.y, area.z, area.radius)
        if not all(abs(value) < FURTHEST_M for value in (x, y, z, radius)) or radius < 0.0:
            raise BadRequest(f"{area}: it is not finite, or nothing can lie in it")
        return SphereMessage(x, y, z, radius)
    message = area_to_message(area)
    if not isinstance(message, BoxMessage):
        raise BadRequest("an area of a live map is a Box or a Sphere")
    return message


def _metres(*values: float) -> tuple[float, ...]:
    """Return numbers as floats to send; raise BadRequest if one is too large for a float."""
    try:
        return tuple(float(value) for value in values)
    except OverflowError as error:
        raise BadRequest(f"{values}: a number of metres is not finite") from error


def _read_voxels(path: str, count: int, resolution: float, change: int) -> Voxels:
    """Read a list of voxels into memory of this process.

    Raises
    ------
    StaleHandle
        The list is partly or wholly removed: the daemon keeps it for a few seconds only.
    SegmentError, SegmentCorrupt
        The file is not readable for this user, or has another size.
    """
    if not count:
        return Voxels(np.empty((0, 3), np.int32), np.empty(0, np.int16), resolution, change)
    data = np.empty(count * _VOXEL_BYTES, np.uint8)
    try:
        fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
    except FileNotFoundError as error:
        raise StaleHandle(f"{path}: the list is gone") from error
    except OSError as error:
        raise SegmentError(f"{path}: {error.strerror}", hint="see `shmmap doctor`") from error
    try:
        at = 0
        while at < len(data) and (some := os.preadv(fd, [data.data[at:]], at)):
            at += some
        size = os.fstat(fd).st_size  # after reading: a file truncated meanwhile is shorter now
    except OSError as error:
        raise SegmentError(f"{path}: {error.strerror}") from error
    finally:
        os.close(fd)
    if not size:
        raise StaleHandle(f"{path}: the list is gone")
    if size != len(data) or at != size:
        raise SegmentCorrupt(f"{path}: it is no list of {count} voxels")
    indices = data[: 12 * count].view("<i4").reshape(count, 3)
    return Voxels(indices, data[12 * count :].view("<i2"), resolution, change)
