# SPDX-License-Identifier: Apache-2.0
"""Live maps on the wire: what mappers and readers ask, and what is answered.

The daemon passes these requests on to the process that keeps live maps, and its answers back.
"""

from __future__ import annotations

from typing import Annotated, Final, TypeAlias

import msgspec

from shmmap.protocol.areas import BoxMessage

__all__ = [
    "FURTHEST_M",
    "LIVE_REQUESTS",
    "MOST_CHUNK_ROWS",
    "MOST_NAME_BYTES",
    "LiveApplied",
    "LiveArea",
    "LiveChunkPage",
    "LiveChunkRow",
    "LiveChunks",
    "LiveDurable",
    "LiveList",
    "LiveListed",
    "LiveMapRow",
    "LiveMove",
    "LiveMoved",
    "LiveOpen",
    "LiveOpened",
    "LiveRelease",
    "LiveReleased",
    "LiveReply",
    "LiveRequest",
    "LiveSave",
    "LiveScan",
    "LiveVoxels",
    "LiveVoxelsReply",
    "SphereMessage",
]

MOST_NAME_BYTES: Final = 64
MOST_CHUNK_ROWS: Final = 1000
"""Rows of one page of chunks."""
FURTHEST_M: Final = 1e150
"""Place and radius of a sphere are less, metres: so that their squares are numbers."""

Name: TypeAlias = Annotated[str, msgspec.Meta(max_length=MOST_NAME_BYTES)]
Point: TypeAlias = tuple[float, float, float]
Key: TypeAlias = tuple[int, int, int]


class SphereMessage(msgspec.Struct, array_like=True, tag="sphere", frozen=True):
    """Voxels whose middles are within ``radius`` of a place; metres."""

    x: float
    y: float
    z: float
    radius: float


LiveArea: TypeAlias = BoxMessage | SphereMessage


class LiveList(msgspec.Struct, array_like=True, tag="live_list"):
    """Which live maps there are, and how they are."""

    request: int


class LiveOpen(msgspec.Struct, array_like=True, tag="live_open"):
    """Use a live map; with the name of a ``mapper`` send scans to it, too.

    ``frame_id`` is the frame that the client works in; empty: whatever the map's is.
    """

    request: int
    map: Name
    mapper: Name = ""
    frame_id: Name = ""


class LiveScan(msgspec.Struct, array_like=True, tag="live_scan"):
    """A scan's marks are in the file ``marks`` of the directory of marks, ``bytes`` long.

    ``mapper`` is the number that `LiveOpened` gave, ``scan`` rises with each scan.  ``sensor`` is where it
    was: the window of chunks in memory follows it.
    """

    request: int
    map: Name
    mapper: int
    scan: int
    marks: Name
    bytes: int
    sensor: Point


class LiveMove(msgspec.Struct, array_like=True, tag="live_move"):
    """The client is here: chunks around it stay in memory."""

    request: int
    map: Name
    position: Point


class LiveSave(msgspec.Struct, array_like=True, tag="live_save"):
    """Save all chunks now; answered when everything applied before is durable."""

    request: int
    map: Name


class LiveChunks(msgspec.Struct, array_like=True, tag="live_chunks"):
    """The chunks in memory, and with ``saved`` those that are on disk alone, too.

    ``since`` is a `LiveChunkPage.change`: only what changed after it.  ``after`` is the last key of the
    page before.
    """

    request: int
    map: Name
    area: LiveArea | None = None
    since: int = 0
    saved: bool = False
    after: Key | None = None


class LiveVoxels(msgspec.Struct, array_like=True, tag="live_voxels"):
    """Voxels of a kind, ``occupied`` or ``free``, of an area, in a segment of their own.

    ``scope`` is ``memory``, ``disk`` or ``all``; ``since`` as in `LiveChunks`: only voxels of chunks that
    changed after it.
    """

    request: int
    map: Name
    kind: Name = "occupied"
    area: LiveArea | None = None
    scope: Name = "memory"
    since: int = 0


class LiveRelease(msgspec.Struct, array_like=True, tag="live_release"):
    """The client has read the segment of a `LiveVoxelsReply`, or does not need it: it may go."""

    request: int
    map: Name
    segment: str


LiveRequest: TypeAlias = (
    LiveList | LiveOpen | LiveScan | LiveMove | LiveSave | LiveChunks | LiveVoxels | LiveRelease
)
LIVE_REQUESTS: Final = (
    LiveList, LiveOpen, LiveScan, LiveMove, LiveSave, LiveChunks, LiveVoxels, LiveRelease,
)  # fmt: skip


class LiveMapRow(msgspec.Struct, array_like=True, frozen=True):
    """How a live map is.

    Attributes
    ----------
    chunks, active, bytes
        Chunks in memory, known voxels in them, and their memory.
    loading, dirty, saving
        Chunks that are being read, that are changed and not saved, that are being written.
    evicting, evicting_bytes
        0: memory of a chunk that is given up is free at once.
    waiting_bytes
        Scans that wait for chunks or for memory.
    files, file_bytes
        Chunks on disk.
    scans, durable
        Scans applied since the start, and of these how many are on the disk.
    damaged
        Files that were put aside, chunks that are missing.
    mappers
        Who has mapped, ``uid/name``.
    problem
        What keeps chunks from being saved or loaded just now; empty: nothing.
    change
        Number of the map's last change, as in `LiveChunkPage`.
    beside_bytes
        Memory of lists of voxels and of marks, within the budget as the chunks.
    readers
        Sessions whose requests took most of the worker's time in the last seconds, and how much of one
        processor each took, in thousandths; the greatest first.
    """

    name: str
    path: str
    resolution: float
    frame_id: str
    chunks: int
    active: int
    bytes: int
    loading: int
    dirty: int
    saving: int
    evicting: int
    evicting_bytes: int
    waiting_bytes: int
    files: int
    file_bytes: int
    scans: int
    durable: int
    budget_bytes: int
    damaged: tuple[str, ...] = ()
    mappers: tuple[str, ...] = ()
    problem: str = ""
    change: int = 0
    beside_bytes: int = 0
    readers: tuple[tuple[int, int], ...] = ()


class LiveListed(msgspec.Struct, array_like=True, tag="live_listed"):
    """Answer to `LiveList`."""

    request: int
    maps: tuple[LiveMapRow, ...]


class LiveOpened(msgspec.Struct, array_like=True, tag="live_opened"):
    """Answer to `LiveOpen`.

    Attributes
    ----------
    map_id
        16 bytes, the map's for ever.
    resolution, frame_id
        Edge of a voxel, metres; frame of the map.
    hit, miss, clamp_min, clamp_max, occupied_above, free_below
        What evidence is worth: log-odds in thousandths.
    shm_dir, prefix
        Chunks are ``prefix`` + key + ``.`` + generation in this directory.
    marks_dir
        Where files of marks are to lie; empty for who does not map.
    slot
        Of no use: chunks are not locked any more.
    mapper, next_scan
        The mapper's number, and the least that a new scan of it may have.
    most_marks_bytes
        The longest file of marks.
    probabilities
        The six that the log-odds stand for, as they were set.
    applied
        All scans of the mapper up to this one are in the map: at least.
    """

    request: int
    map_id: bytes
    resolution: float
    frame_id: str
    hit: int
    miss: int
    clamp_min: int
    clamp_max: int
    occupied_above: int
    free_below: int
    shm_dir: str
    prefix: str
    slot: int
    marks_dir: str = ""
    mapper: int = 0
    next_scan: int = 1
    most_marks_bytes: int = 0
    probabilities: tuple[float, ...] = ()
    applied: int = 0


class LiveApplied(msgspec.Struct, array_like=True, tag="live_applied"):
    """Answer to `LiveScan`: it is applied; all scans of the mapper up to ``durable`` are on the disk."""

    request: int
    scan: int
    durable: int


class LiveMoved(msgspec.Struct, array_like=True, tag="live_moved"):
    """Answer to `LiveMove`; ``change`` as in `LiveChunkPage`."""

    request: int
    change: int


class LiveDurable(msgspec.Struct, array_like=True, tag="live_durable"):
    """Answer to `LiveSave`; ``scan``: all scans up to it, of the session's mapper, are on the disk."""

    request: int
    scan: int
    files: int


class LiveChunkRow(msgspec.Struct, array_like=True, frozen=True, gc=False):
    """A chunk: ``state`` is ``loading``, ``clean``, ``dirty``, ``saving`` or ``saved`` (on disk alone).

    ``version`` rises with each scan that it takes in; ``bytes`` is its memory, or its file.
    """

    key: Key
    generation: int
    version: int
    state: str
    active: int
    occupied: int
    free: int
    bytes: int


class LiveChunkPage(msgspec.Struct, array_like=True, tag="live_chunk_page"):
    """Answer to `LiveChunks`, in the order of keys; ``more`` is false on the last page.

    ``change`` numbers the map's changes: send it as ``since`` to get what comes after.  ``gone`` are chunks
    that left memory after ``since``; ``since_known`` is false when that was not known any more, and all is
    answered instead.
    """

    request: int
    change: int
    rows: tuple[LiveChunkRow, ...]
    more: bool = False
    gone: tuple[Key, ...] = ()
    since_known: bool = True


class LiveVoxelsReply(msgspec.Struct, array_like=True, tag="live_voxels_reply"):
    """Answer to `LiveVoxels`: where ``count`` voxels are.

    The segment's columns are ``voxel`` (3 x int32, indices) and ``log_odds`` (int16).
    """

    request: int
    change: int
    segment: str
    count: int
    bytes: int


class LiveReleased(msgspec.Struct, array_like=True, tag="live_released"):
    """Answer to `LiveRelease`."""

    request: int


LiveReply: TypeAlias = (
    LiveListed
    | LiveOpened
    | LiveApplied
    | LiveMoved
    | LiveDurable
    | LiveChunkPage
    | LiveVoxelsReply
    | LiveReleased
)
