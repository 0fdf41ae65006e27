# SPDX-License-Identifier: Apache-2.0
"""What the daemon answers, one declaration per reply."""

from __future__ import annotations

from typing import TypeAlias

import msgspec

from shmmap.protocol.events import EventPage
from shmmap.protocol.live import LiveReply
from shmmap.protocol.rows import CellRow, ClientRow, Holder

__all__ = [
    "Cells",
    "ErrorReply",
    "Evicted",
    "FailedCell",
    "Handle",
    "MetadataPage",
    "MetadataRow",
    "PendingCell",
    "Pinned",
    "PinnedCell",
    "Released",
    "Reloaded",
    "Reply",
    "ShownCell",
    "StatsReply",
    "Stopping",
    "Welcome",
]


class Welcome(msgspec.Struct, array_like=True, tag="welcome"):
    """Answer to `Hello`.

    ``session`` is the slot the client locks in every segment it opens.  Cell ids in replies are
    relative to ``id_prefix`` and segment names to ``segment_prefix``.  ``events`` is the path of the
    socket that events leave by; empty where there is none.  ``(point + origin) / unit_m`` is a point
    in the coordinate system ``crs`` of the files that the map was made of.
    """

    request: int
    major: int
    minor: int
    daemon: str
    instance: str
    epoch: int
    session: int
    map_version: int
    map_path: str
    frame_id: str
    shm_dir: str
    id_prefix: str
    segment_prefix: str
    cells: int
    bounds: tuple[float, float, float, float] | None
    layers: tuple[str, ...]
    budget_bytes: int
    pid: int = 0
    events: str = ""
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    crs: str = ""
    unit_m: tuple[float, float] = (1.0, 1.0)


class Handle(msgspec.Struct, array_like=True, frozen=True, gc=False):
    """Where one layer of one cell lies in shared memory.

    ``id`` and ``segment`` lack the prefixes that `Welcome` gives.  ``stale`` marks a version whose
    successor exists but could not be loaded yet.
    """

    id: str
    version: int
    layer: str
    segment: str
    offset: int
    bytes: int
    points: int
    min_x: float
    min_y: float
    max_x: float
    max_y: float
    stale: bool = False


class PendingCell(msgspec.Struct, array_like=True, frozen=True):
    """A cell still being loaded when the reply had to leave; ``id`` lacks the prefix."""

    id: str
    layer: str


class FailedCell(msgspec.Struct, array_like=True, frozen=True):
    """A cell that could not be loaded; ``id`` as the client asked for it, else without the prefix.

    ``box`` says where it lies, ``min_x, min_y, max_x, max_y`` in metres; None where that is not known.
    """

    id: str
    layer: str
    code: str
    message: str
    holders: tuple[Holder, ...] = ()
    box: tuple[float, float, float, float] | None = None


class Cells(msgspec.Struct, array_like=True, tag="cells"):
    """Answer to `Area`, `Differential` and `Selected`.

    ``removed`` repeats held ids that the client should drop, in the order it gave them;
    ``removed_packed`` the same for packed versions, in any order.  ``layers`` are those of the request,
    one for each that it named, in their canonical form.  ``covered`` is false where part of what was asked
    about is not known yet; nothing lying there is removed.  ``reason`` says why that is not waited for:
    ``offline``, where it cannot be reached at present; empty where it is about to become known.
    """

    request: int
    epoch: int
    map_version: int
    cells: tuple[Handle, ...] = ()
    removed: tuple[str, ...] = ()
    removed_packed: bytes = b""
    pending: tuple[PendingCell, ...] = ()
    failed: tuple[FailedCell, ...] = ()
    layers: tuple[str, ...] = ()
    covered: bool = True
    reason: str = ""


class MetadataRow(msgspec.Struct, array_like=True, frozen=True, gc=False):
    """One cell of the catalogue; ``id`` lacks the prefix, z bounds are nil until first loaded."""

    id: str
    version: int
    min_x: float
    min_y: float
    max_x: float
    max_y: float
    source_bytes: int
    z_min: float | None = None
    z_max: float | None = None


class MetadataPage(msgspec.Struct, array_like=True, tag="metadata_page"):
    """Answer to `Metadata`; ``next`` is nil on the last page.

    ``since_known`` is false when ``since`` was not known any more and the whole list is answered
    instead.  ``removed`` lists ids (without the prefix) that vanished after ``since``; it comes
    with the first page.
    """

    request: int
    epoch: int
    map_version: int
    rows: tuple[MetadataRow, ...]
    next: int | None = None
    since_known: bool = True
    removed: tuple[str, ...] = ()


class Released(msgspec.Struct, array_like=True, tag="released"):
    """Answer to `Release`."""

    request: int


class StatsReply(msgspec.Struct, array_like=True, tag="stats_reply"):
    """Answer to `Stats`: counters by name, sessions, segments in use by processes without a session."""

    request: int
    epoch: int
    map_version: int
    counters: dict[str, int]
    sessions: tuple[ClientRow, ...]
    unknown_holders: int = 0
    unknown_bytes: int = 0


class ShownCell(msgspec.Struct, array_like=True, tag="shown_cell"):
    """Answer to `Show`; ``id`` is whole, ``failure`` the last one that still stands.

    ``pinned`` names the layers that an operator keeps resident.
    """

    request: int
    id: str
    version: int
    min_x: float
    min_y: float
    max_x: float
    max_y: float
    source_bytes: int
    segments: tuple[CellRow, ...]
    loading: tuple[str, ...] = ()
    failure: str = ""
    z_min: float | None = None
    z_max: float | None = None
    pinned: tuple[str, ...] = ()


class Reloaded(msgspec.Struct, array_like=True, tag="reloaded"):
    """Answer to `Reload`: how many cells changed, appeared, vanished; what looked odd."""

    request: int
    map_version: int
    changed: int
    added: int
    removed: int
    problems: tuple[str, ...] = ()


class Evicted(msgspec.Struct, array_like=True, tag="evicted"):
    """Answer to `Evict`: segments freed at once, segments still mapped, unknown ids.

    ``kept`` counts the segments left alone because an operator pinned them.
    """

    request: int
    freed: int
    pinned: int
    unknown: tuple[str, ...] = ()
    kept: int = 0


class PinnedCell(msgspec.Struct, array_like=True, frozen=True):
    """A cell an operator keeps: ``state`` resident, stale, loading, absent, or why it cannot be loaded."""

    id: str
    layer: str
    state: str
    bytes: int


class Pinned(msgspec.Struct, array_like=True, tag="pinned"):
    """Answer to `Pin` and `Unpin`: the cells asked for, else all that are pinned; ids the map lacks."""

    request: int
    cells: tuple[PinnedCell, ...]
    unknown: tuple[str, ...] = ()


class Stopping(msgspec.Struct, array_like=True, tag="stopping"):
    """Answer to `Shutdown`: the daemon ends now."""

    request: int


class ErrorReply(msgspec.Struct, array_like=True, tag="error"):
    """The request as a whole was refused; code ``no_session`` asks for a new `Hello`."""

    request: int
    code: str
    message: str
    hint: str = ""


Reply: TypeAlias = (
    Welcome
    | Cells
    | MetadataPage
    | Released
    | StatsReply
    | ShownCell
    | Reloaded
    | Evicted
    | Pinned
    | Stopping
    | EventPage
    | LiveReply
    | ErrorReply
)
