# SPDX-License-Identifier: Apache-2.0
"""Messages about live maps: requests of mappers and readers, and their replies.

The daemon forwards these requests to the process that keeps live maps, and returns its answers.
"""

from __future__ import annotations

from typing import Annotated, Final, TypeAlias

import msgspec

from shmmap.protocol.areas import LiveArea, Message
from shmmap.protocol.rows import LiveMapRow as LiveMapRow

MAX_NAME_BYTES: Final = 64
MAX_CHUNK_ROWS: Final = 1000
"""Most rows of one page of chunks."""
MAX_LACKING: Final = 64
"""Most lacking chunks that an answer names."""

Name: TypeAlias = Annotated[str, msgspec.Meta(max_length=MAX_NAME_BYTES)]
Point: TypeAlias = tuple[float, float, float]
Key: TypeAlias = tuple[int, int, int]


class LiveList(Message, tag="live_list"):
    """List the live maps and their state."""


class LiveOpen(Message, tag="live_open"):
    """Use a live map; with the name of a ``mapper`` send scans to it, too.

    ``frame_id`` is the frame in which the client works; empty: the map's own.
    """

    map: Name
    mapper: Name = ""
    frame_id: Name = ""


class LiveScan(Message, tag="live_scan"):
    """Apply a scan: its marks are in the file ``marks`` of the marks directory, ``bytes`` long.

    ``mapper`` is the number from `LiveOpened`; ``scan`` increases with each scan.  ``sensor`` is the sensor's
    position, which the window of chunks in memory follows.
    """

    map: Name
    mapper: int
    scan: int
    marks: Name
    bytes: int
    sensor: Point


class LiveMove(Message, tag="live_move"):
    """Set the client's position: chunks around it stay in memory."""

    map: Name
    position: Point


class LiveSave(Message, tag="live_save"):
    """Save all chunks now; answered when all previously applied scans are durable."""

    map: Name


class LiveChunks(Message, tag="live_chunks"):
    """List the chunks in memory, with ``saved`` also the chunks that are only on disk.

    ``since`` is a `LiveChunkPage.change`: only later changes are listed.  ``after`` is the last key of the
    previous page.
    """

    map: Name
    area: LiveArea | None = None
    since: int = 0
    saved: bool = False
    after: Key | None = None


class LiveVoxels(Message, tag="live_voxels"):
    """List the ``occupied`` or ``free`` voxels of an area, in a separate segment.

    ``scope`` is ``memory``, ``disk`` or ``all``; ``since`` as in `LiveChunks`: only voxels of chunks that
    changed after it.
    """

    map: Name
    kind: Name = "occupied"
    area: LiveArea | None = None
    scope: Name = "memory"
    since: int = 0


class LiveRelease(Message, tag="live_release"):
    """Release the segment of a `LiveVoxelsReply`, which the client has read or does not need."""

    map: Name
    segment: str


LiveRequest: TypeAlias = (
    LiveList | LiveOpen | LiveScan | LiveMove | LiveSave | LiveChunks | LiveVoxels | LiveRelease
)
LIVE_REQUESTS: Final = (
    LiveList,
    LiveOpen,
    LiveScan,
    LiveMove,
    LiveSave,
    LiveChunks,
    LiveVoxels,
    LiveRelease,
)


class LiveListed(Message, tag="live_listed"):
    """Answer to `LiveList`."""

    maps: tuple[LiveMapRow, ...]


class LiveOpened(Message, tag="live_opened"):
    """Answer to `LiveOpen`.

    Attributes
    ----------
    map_id
        Permanent id of the map, 16 bytes.
    resolution, frame_id
        Edge of a voxel, metres; frame of the map.
    hit, miss, clamp_min, clamp_max, occupied_above, free_below
        Weights, bounds and thresholds of log-odds, thousandths.
    shm_dir, prefix
        Chunks are ``prefix`` + key + ``.`` + generation in this directory.
    marks_dir
        Directory for files of marks; empty for a session that does not map.
    mapper, next_scan
        The mapper's number, and the lowest number that its next scan may have.
    max_marks_bytes
        Largest size of a file of marks.
    probabilities
        The six configured probabilities from which the log-odds were computed.
    applied
        At least all scans of the mapper up to this number are in the map.
    """

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


class LiveApplied(Message, tag="live_applied"):
    """Answer to `LiveScan`: the scan is applied; the mapper's scans up to ``durable`` are on disk."""

    scan: int
    durable: int


class LiveMoved(Message, tag="live_moved"):
    """Answer to `LiveMove`; ``change`` as in `LiveChunkPage`."""

    change: int


class LiveDurable(Message, tag="live_durable"):
    """Answer to `LiveSave`; all scans of the session's mapper up to ``scan`` are on disk."""

    scan: int
    files: int


class LiveChunkRow(msgspec.Struct, array_like=True, frozen=True, gc=False):
    """A chunk: ``state`` is ``loading``, ``clean``, ``dirty``, ``saving`` or ``saved`` (only on disk).

    ``version`` increases with each scan applied to the chunk; ``bytes`` is the size of its memory, or of its
    file.
    """

    key: Key
    generation: int
    version: int
    state: str
    active: int
    occupied: int
    free: int
    bytes: int


class LackingChunk(msgspec.Struct, array_like=True, frozen=True, gc=False):
    """A chunk of which something that was saved is lost, and what."""

    key: Key
    reason: str


class LiveChunkPage(Message, tag="live_chunk_page"):
    """Answer to `LiveChunks`, in the order of keys; ``more`` is false on the last page.

    ``change`` is the number of the map's last change: send it as ``since`` to get later changes.  ``gone``
    lists chunks that left memory after ``since``.  ``since_known`` is false if the daemon no longer knew
    ``since``, and the reply lists everything instead.  The first page has ``lacking`` as `LiveVoxelsReply`.
    """

    change: int
    rows: tuple[LiveChunkRow, ...]
    more: bool = False
    gone: tuple[Key, ...] = ()
    since_known: bool = True
    lacking: tuple[LackingChunk, ...] = ()
    lacking_count: int = 0


class LiveVoxelsReply(Message, tag="live_voxels_reply"):
    """Answer to `LiveVoxels`: the segment with ``count`` voxels.

    The segment's columns are ``voxel`` (3 x int32, indices) and ``log_odds`` (int16).  ``lacking`` names
    chunks of the area, `MAX_LACKING` at most, of which something that was saved is lost, whether they were
    mapped again or not; ``lacking_count`` is the number of all.
    """

    change: int
    segment: str
    count: int
    bytes: int
    lacking: tuple[LackingChunk, ...] = ()
    lacking_count: int = 0


class LiveReleased(Message, tag="live_released"):
    """Answer to `LiveRelease`."""


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
