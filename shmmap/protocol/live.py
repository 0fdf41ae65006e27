# SPDX-License-Identifier: Apache-2.0
"""Live maps on the wire: what mappers and readers ask, and what is answered.

The daemon passes these requests on to the process that keeps live maps, and its answers back.
"""

from __future__ import annotations

from typing import Annotated, Final, TypeAlias

import msgspec

from shmmap.protocol.areas import LiveArea
from shmmap.protocol.rows import LiveMapRow

__all__ = [
    "LIVE_REQUESTS",
    "MAX_CHUNK_ROWS",
    "MAX_NAME_BYTES",
    "LiveApplied",
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
]

MAX_NAME_BYTES: Final = 64
MAX_CHUNK_ROWS: Final = 1000
"""Rows of one page of chunks."""

Name: TypeAlias = Annotated[str, msgspec.Meta(max_length=MAX_NAME_BYTES)]
Point: TypeAlias = tuple[float, float, float]
Key: TypeAlias = tuple[int, int, int]


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


class LiveListed(msgspec.Struct, array_like=True, tag="live_listed"):
    """Answer to `LiveList`."""

    request: int
    maps: tuple[LiveMapRow, ...]


class LiveOpened(msgspec.Struct, array_like=True, tag="live_opened"):
    """Answer to `LiveOpen`.

    Attributes
    ----------
    map_id
        16 bytes, permanently the map's.
    resolution, frame_id
        Edge of a voxel, metres; frame of the map.
    hit, miss, clamp_min, clamp_max, occupied_above, free_below
        What evidence is worth: log-odds in thousandths.
    shm_dir, prefix
        Chunks are ``prefix`` + key + ``.`` + generation in this directory.
    marks_dir
        Where files of marks are to lie; empty for a session that does not map.
    mapper, next_scan
        The mapper's number, and the least that a new scan of it may have.
    max_marks_bytes
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
    marks_dir: str = ""
    mapper: int = 0
    next_scan: int = 1
    max_marks_bytes: int = 0
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
