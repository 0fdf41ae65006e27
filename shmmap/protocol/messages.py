# SPDX-License-Identifier: Apache-2.0
"""Every message between client and daemon.  ``PROTOCOL.md`` is the byte-exact document.

A message is one MessagePack array whose first element is its kind and whose second is the request
id that the client chose and the reply repeats.  Arrays may grow at the end: a receiver ignores
elements it does not know and assumes the default for those it misses.
"""

from __future__ import annotations

from typing import Final, TypeAlias

import msgspec

from shmmap import geometry
from shmmap.protocol.events import EventPage, Recent

__all__ = [
    "PROTOCOL_VERSION",
    "Area",
    "AreaMessage",
    "Bye",
    "Cells",
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
    "SessionRow",
    "Show",
    "ShownCell",
    "ShownSegment",
    "Shutdown",
    "Stats",
    "StatsReply",
    "Stopping",
    "Unpin",
    "Welcome",
    "area_from_message",
    "area_to_message",
]

PROTOCOL_VERSION: Final = (1, 2)


class CircleMessage(msgspec.Struct, array_like=True, tag="circle", frozen=True):
    """True circle; z range absent when either bound is nil."""

    x: float
    y: float
    radius: float
    z_min: float | None = None
    z_max: float | None = None


class SquareMessage(msgspec.Struct, array_like=True, tag="square", frozen=True):
    """Autoware's square of half-side ``radius``."""

    x: float
    y: float
    radius: float
    z_min: float | None = None
    z_max: float | None = None


class BoxMessage(msgspec.Struct, array_like=True, tag="box", frozen=True):
    """Axis-aligned rectangle."""

    min_x: float
    min_y: float
    max_x: float
    max_y: float
    z_min: float | None = None
    z_max: float | None = None


AreaMessage: TypeAlias = CircleMessage | SquareMessage | BoxMessage


def area_from_message(message: AreaMessage) -> geometry.Area:
    """Return the area a message describes; `BadRequest` if it makes no sense."""
    z = None
    if message.z_min is not None and message.z_max is not None:
        z = geometry.ZRange(message.z_min, message.z_max)
    if isinstance(message, CircleMessage):
        return geometry.Circle(message.x, message.y, message.radius, z)
    if isinstance(message, SquareMessage):
        return geometry.AutowareSquare(message.x, message.y, message.radius, z)
    return geometry.Box(message.min_x, message.min_y, message.max_x, message.max_y, z)


def area_to_message(area: geometry.Area) -> AreaMessage:
    """Return the message that describes an area."""
    z = (area.z.min, area.z.max) if area.z is not None else (None, None)
    if isinstance(area, geometry.Circle):
        return CircleMessage(area.x, area.y, area.radius, *z)
    if isinstance(area, geometry.AutowareSquare):
        return SquareMessage(area.x, area.y, area.radius, *z)
    return BoxMessage(area.min_x, area.min_y, area.max_x, area.max_y, *z)


class Intent(msgspec.Struct, array_like=True, frozen=True):
    """Where a client is and where it goes: metres and metres per second, map frame.

    ``route`` is the polyline ahead, (x, y) each.
    """

    x: float
    y: float
    vx: float = 0.0
    vy: float = 0.0
    heading: float | None = None
    route: tuple[tuple[float, float], ...] = ()


class HeldCell(msgspec.Struct, array_like=True, frozen=True, gc=False):
    """A cell the client says it has: version nil means "the current one", layers nil "all asked for"."""

    id: str
    version: int | None = None
    layers: tuple[str, ...] | None = None


# --- requests -----------------------------------------------------------------------------------


class Hello(msgspec.Struct, array_like=True, tag="hello"):
    """First message of a session.

    ``session`` is the slot of the client's session with an earlier life of the daemon, 0 for none: it
    keeps it, so that the locks it holds go on naming it.
    """

    request: int
    major: int
    minor: int
    client: str = ""
    session: int = 0


class Metadata(msgspec.Struct, array_like=True, tag="metadata"):
    """One page of the catalogue.

    ``since`` is a map version: only what changed after it is answered, if the daemon still knows it
    (`MetadataPage.since_known` tells).  ``start`` is `MetadataPage.next` of the page before.
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
    layers: tuple[str, ...] = ("points",)
    wait: float | None = None
    intent: Intent | None = None


class Differential(msgspec.Struct, array_like=True, tag="differential"):
    """Cells that touch an area, minus those the client holds.

    ``held`` names cells one by one; ``packed`` is the same as versions alone, 8 bytes little-endian
    each, and stands for cells held in every layer asked for.
    """

    request: int
    area: AreaMessage
    layers: tuple[str, ...] = ("points",)
    held: tuple[HeldCell, ...] = ()
    packed: bytes = b""
    wait: float | None = None
    intent: Intent | None = None


class Selected(msgspec.Struct, array_like=True, tag="selected"):
    """Cells by id, in the order asked for, duplicates preserved."""

    request: int
    ids: tuple[str, ...]
    layers: tuple[str, ...] = ("points",)
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
    """Everything about one cell: versions, segments, who holds them, last failure."""

    request: int
    id: str


class Reload(msgspec.Struct, array_like=True, tag="reload"):
    """Read the map's catalogue again (privileged)."""

    request: int


class Evict(msgspec.Struct, array_like=True, tag="evict"):
    """Retire cells, all when ``ids`` is nil (privileged); pinned ones are freed when let go."""

    request: int
    ids: tuple[str, ...] | None = None


class Pin(msgspec.Struct, array_like=True, tag="pin"):
    """Keep cells resident until `Unpin` or the daemon's end (privileged); no ids: only list the pins."""

    request: int
    ids: tuple[str, ...] = ()
    layers: tuple[str, ...] = ("points",)


class Unpin(msgspec.Struct, array_like=True, tag="unpin"):
    """Keep cells, all when ``ids`` is nil, no longer than others (privileged)."""

    request: int
    ids: tuple[str, ...] | None = None


class Shutdown(msgspec.Struct, array_like=True, tag="shutdown"):
    """End the daemon and free its memory, as SIGTERM does (privileged)."""

    request: int


class Bye(msgspec.Struct, array_like=True, tag="bye"):
    """The session ends; there is no reply.  What it still maps stays pinned by the kernel's word."""

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
    | Bye
)


# --- replies ------------------------------------------------------------------------------------


class Welcome(msgspec.Struct, array_like=True, tag="welcome"):
    """Answer to `Hello`.

    ``session`` is the slot the client locks in every segment it opens.  Cell ids in replies are
    relative to ``id_prefix`` and segment names to ``segment_prefix``.  ``events`` is the path of the
    socket that events leave by; empty where there is none.
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


class Holder(msgspec.Struct, array_like=True, frozen=True):
    """Who keeps memory in use; session and pid 0 mean "unknown"."""

    session: int
    pid: int
    uid: int
    client: str
    bytes: int
    cells: int = 0
    command: str = ""


class FailedCell(msgspec.Struct, array_like=True, frozen=True):
    """A cell that could not be had; ``id`` as the client asked for it, else without the prefix."""

    id: str
    layer: str
    code: str
    message: str
    holders: tuple[Holder, ...] = ()


class Cells(msgspec.Struct, array_like=True, tag="cells"):
    """Answer to `Area`, `Differential` and `Selected`.

    ``removed`` repeats held ids that the client should drop, in the order it gave them;
    ``removed_packed`` the same for packed versions, in any order.
    """

    request: int
    epoch: int
    map_version: int
    cells: tuple[Handle, ...] = ()
    removed: tuple[str, ...] = ()
    removed_packed: bytes = b""
    pending: tuple[PendingCell, ...] = ()
    failed: tuple[FailedCell, ...] = ()


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


class SessionRow(msgspec.Struct, array_like=True, frozen=True):
    """One client as the daemon sees it; ``pid`` is the kernel's word, 0 where it gives none.

    ``cells`` and ``bytes`` are what it was handed and did not say it dropped; ``mapped_bytes`` what
    it maps by the kernel's word, ``superseded`` the segments among them that have left service or have a
    successor.
    """

    session: int
    pid: int
    uid: int
    gid: int
    client: str
    command: str
    cells: int
    bytes: int
    requests: int
    idle_s: float
    pose: tuple[float, float] | None = None
    mapped_bytes: int = 0
    superseded: int = 0
    superseded_bytes: int = 0


class StatsReply(msgspec.Struct, array_like=True, tag="stats_reply"):
    """Answer to `Stats`: counters by name, sessions, and pins nobody known holds."""

    request: int
    epoch: int
    map_version: int
    counters: dict[str, int]
    sessions: tuple[SessionRow, ...]
    unknown_holders: int = 0
    unknown_bytes: int = 0


class ShownSegment(msgspec.Struct, array_like=True, frozen=True):
    """One segment of a shown cell; ``state`` is resident, stale or zombie."""

    layer: str
    version: int
    segment: str
    state: str
    bytes: int
    points: int
    holders: tuple[Holder, ...] = ()


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
    segments: tuple[ShownSegment, ...]
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
    """Answer to `Evict`: segments freed at once, segments still mapped by somebody, unknown ids.

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
    | ErrorReply
)
