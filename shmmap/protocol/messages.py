# SPDX-License-Identifier: Apache-2.0
"""Every message between client and daemon, one declaration each.  ``PROTOCOL.md`` is the byte-exact document.

A message is one MessagePack array whose first element is its kind and whose second is the request
id that the client chose and the reply repeats.  Arrays may grow at the end: a receiver ignores
elements it does not know and assumes the default for those it misses.  Lists of a request have a greatest
length, so that what is too long is refused before anything of it is decoded.
"""

from __future__ import annotations

from typing import Annotated, Final, TypeAlias

import msgspec

from shmmap.protocol.areas import (
    AreaMessage,
    BoxMessage,
    CircleMessage,
    HeldCell,
    Intent,
    SquareMessage,
    area_from_message,
    area_to_message,
)
from shmmap.protocol.events import EventPage, Recent
from shmmap.protocol.live import LiveReply, LiveRequest
from shmmap.protocol.rows import CellRow, ClientRow, Holder, Window

__all__ = [
    "PROTOCOL_VERSION",
    "Area",
    "AreaMessage",
    "BoxMessage",
    "Bye",
    "CellRow",
    "Cells",
    "CircleMessage",
    "ClientRow",
    "Differential",
    "ErrorReply",
    "Evict",
    "Evicted",
    "FailedCell",
    "Handle",
    "HeldCell",
    "Hello",
    "Holder",
    "Intent",
    "Metadata",
    "MetadataPage",
    "MetadataRow",
    "PendingCell",
    "Pin",
    "Pinned",
    "PinnedCell",
    "Release",
    "Released",
    "Reload",
    "Reloaded",
    "Reply",
    "Request",
    "Selected",
    "Show",
    "ShownCell",
    "Shutdown",
    "SquareMessage",
    "Stats",
    "StatsReply",
    "Stopping",
    "Unpin",
    "Welcome",
    "Window",
    "area_from_message",
    "area_to_message",
]

PROTOCOL_VERSION: Final = (2, 0)

MAX_NAMES: Final = 20_000
"""Cells that a request names one by one."""
MAX_LAYERS: Final = 64

Ids: TypeAlias = Annotated[tuple[str, ...], msgspec.Meta(max_length=MAX_NAMES)]
Layers: TypeAlias = Annotated[tuple[str, ...], msgspec.Meta(max_length=MAX_LAYERS)]
Held: TypeAlias = Annotated[tuple[HeldCell, ...], msgspec.Meta(max_length=MAX_NAMES)]


class Hello(msgspec.Struct, array_like=True, tag="hello"):
    """First message of a session.

    ``session`` is the number that the client's session had with a previous run of the daemon, 0 for none.
    The session keeps this number, so that the locks that the client holds still name it.
    """

    request: int
    major: int
    minor: int
    client: str = ""
    session: int = 0


class Metadata(msgspec.Struct, array_like=True, tag="metadata"):
    """One page of the catalogue.

    ``since`` is a map version: only what changed after it is answered, if the daemon still knows it
    (`MetadataPage.since_known` says).  ``start`` is `MetadataPage.next` of the page before.
    """

    request: int
    area: AreaMessage | None = None
    since: int | None = None
    start: int = 0
    limit: int = 1000


class Area(msgspec.Struct, array_like=True, tag="area"):
    """Cells that touch an area.

    ``wait`` is how many seconds the reply may wait for loads; nil answers at once with what is
    resident, and lists the rest as pending.
    """

    request: int
    area: AreaMessage
    layers: Layers = ("points",)
    wait: float | None = None
    intent: Intent | None = None


class Differential(msgspec.Struct, array_like=True, tag="differential"):
    """Cells that touch an area, minus those the client holds.

    ``held`` names cells one by one; ``packed`` is the same as versions alone, 8 bytes little-endian
    each: a version names one layer of one cell.
    """

    request: int
    area: AreaMessage
    layers: Layers = ("points",)
    held: Held = ()
    packed: bytes = b""
    wait: float | None = None
    intent: Intent | None = None


class Selected(msgspec.Struct, array_like=True, tag="selected"):
    """Cells by id, in the order asked for, duplicates preserved."""

    request: int
    ids: Ids
    layers: Layers = ("points",)
    wait: float | None = None
    intent: Intent | None = None


class Release(msgspec.Struct, array_like=True, tag="release"):
    """The client dropped these versions (8 bytes little-endian each; nil: all) and unmapped them."""

    request: int
    packed: bytes | None = None


class Stats(msgspec.Struct, array_like=True, tag="stats"):
    """Counters, sessions and what fills the budget."""

    request: int


class Show(msgspec.Struct, array_like=True, tag="show"):
    """Everything about one cell: versions, segments, their holders, last failure."""

    request: int
    id: str


class Reload(msgspec.Struct, array_like=True, tag="reload"):
    """Read the map's catalogue again (privileged)."""

    request: int


class Evict(msgspec.Struct, array_like=True, tag="evict"):
    """Retire cells, all when ``ids`` is nil (privileged); those in use are freed when they are released."""

    request: int
    ids: Ids | None = None


class Pin(msgspec.Struct, array_like=True, tag="pin"):
    """Keep cells resident until `Unpin` or the daemon's end (privileged); no ids: only list the pins."""

    request: int
    ids: Ids = ()
    layers: Layers = ("points",)


class Unpin(msgspec.Struct, array_like=True, tag="unpin"):
    """Keep cells, all when ``ids`` is nil, no longer than others (privileged)."""

    request: int
    ids: Ids | None = None


class Shutdown(msgspec.Struct, array_like=True, tag="shutdown"):
    """End the daemon and free its memory, as SIGTERM does (privileged)."""

    request: int


class Bye(msgspec.Struct, array_like=True, tag="bye"):
    """The session ends; there is no reply.  What it still maps stays in use, according to the kernel."""

    request: int


Request: TypeAlias = (
    Hello
    | Metadata
    | Area
    | Differential
    | Selected
    | Release
    | Stats
    | Show
    | Reload
    | Evict
    | Pin
    | Unpin
    | Shutdown
    | Recent
    | LiveRequest
    | Bye
)


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
