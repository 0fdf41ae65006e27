# SPDX-License-Identifier: Apache-2.0
"""All messages between client and daemon.  ``PROTOCOL.md`` is the byte-exact specification.

A message is one MessagePack array whose first element is its kind and whose second is the request id that the
client chose and the reply repeats.  Arrays may grow at the end: a receiver ignores elements it does not know
and assumes the default for those it misses.  Lists in a request have a maximum length, so that longer ones
are refused before they are decoded.
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
    Message,
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
    "Cancel",
    "CellRow",
    "Cells",
    "CellsPage",
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
    "ListCells",
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

PROTOCOL_VERSION: Final = (3, 0)

MAX_NAMES: Final = 20_000
"""Most cells that an operator's request may name one by one."""
MAX_NAMED: Final = 2048
"""Most held cells that a request may name one by one."""
MAX_SELECTED: Final = 128
"""Most layers of cells that one `Selected` may ask for: its ids times its layers."""
MAX_LAYERS: Final = 64

Ids: TypeAlias = Annotated[tuple[str, ...], msgspec.Meta(max_length=MAX_NAMES)]
Layers: TypeAlias = Annotated[tuple[str, ...], msgspec.Meta(max_length=MAX_LAYERS)]
Held: TypeAlias = Annotated[tuple[HeldCell, ...], msgspec.Meta(max_length=MAX_NAMED)]


class Hello(Message, tag="hello"):
    """First message of a session.

    ``session`` is the number of the client's session with a previous run of the daemon, 0 for none.  The new
    session gets the same number, so that the client's locks on segments stay valid.
    """

    major: int
    minor: int
    client: str = ""
    session: int = 0


class Metadata(Message, tag="metadata"):
    """Request one page of the catalogue.

    ``since`` is a map version: the reply lists only later changes, if the daemon still knows that version
    (`MetadataPage.since_known`).  ``start`` is `MetadataPage.next` of the previous page.
    """

    area: AreaMessage | None = None
    since: int | None = None
    start: int = 0
    limit: int = 1000


class Area(Message, tag="area"):
    """Request cells that touch an area.

    ``wait`` is how many seconds the reply may wait for loads; with nil the daemon answers at once with the
    resident cells, and lists the others as pending.  ``start`` is `Cells.next` of the previous reply.
    """

    area: AreaMessage
    layers: Layers = ("points",)
    wait: float | None = None
    intent: Intent | None = None
    start: str = ""


class Differential(Message, tag="differential"):
    """Request cells that touch an area, minus those that the client holds.

    ``held`` names cells one by one; ``packed`` is the same as versions alone, 8 bytes little-endian
    each: a version names one layer of one cell.  ``start`` is `Cells.next` of the previous reply.
    """

    area: AreaMessage
    layers: Layers = ("points",)
    held: Held = ()
    packed: bytes = b""
    wait: float | None = None
    intent: Intent | None = None
    start: str = ""


class Selected(Message, tag="selected"):
    """Request cells by id, at most `MAX_SELECTED`; the reply keeps order and duplicates.

    A ``spare`` request must cost other clients nothing: one of its loads begins at a time, while
    no other load waits and memory is free.  Its cells are evicted first, unless another request asks for
    them.  ``pending`` then promises no load.
    """

    ids: Ids
    layers: Layers = ("points",)
    wait: float | None = None
    intent: Intent | None = None
    spare: bool = False


class Release(Message, tag="release"):
    """Report that the client unmapped these versions (8 bytes little-endian each; nil: all)."""

    packed: bytes | None = None


class Stats(Message, tag="stats"):
    """Request counters, sessions, and the use of the budget."""


class ListCells(Message, tag="list_cells"):
    """Request a page of the segments in memory ; ``start`` is the last page's ``next``."""

    start: int = 0


class Show(Message, tag="show"):
    """Request all data about one cell: versions, segments, their holders, last failure."""

    id: str


class Reload(Message, tag="reload"):
    """Read the map's catalogue again (privileged)."""


class Evict(Message, tag="evict"):
    """Retire cells, all when ``ids`` is nil (privileged); those in use are freed when they are released."""

    ids: Ids | None = None


class Pin(Message, tag="pin"):
    """Keep cells resident until `Unpin` or the daemon's end (privileged); no ids: only list the pins."""

    ids: Ids = ()
    layers: Layers = ("points",)


class Unpin(Message, tag="unpin"):
    """Remove pins from cells, from all when ``ids`` is nil (privileged)."""

    ids: Ids | None = None


class Shutdown(Message, tag="shutdown"):
    """End the daemon and free its memory, as SIGTERM does (privileged)."""


class Cancel(Message, tag="cancel"):
    """End the wait of the session's request with this id; neither that nor this is answered."""


class Bye(Message, tag="bye"):
    """End the session; there is no reply.  Segments that the client still maps stay in use."""


Request: TypeAlias = (
    Hello
    | Metadata
    | Area
    | Differential
    | Selected
    | Release
    | Stats
    | ListCells
    | Show
    | Reload
    | Evict
    | Pin
    | Unpin
    | Shutdown
    | Recent
    | LiveRequest
    | Cancel
    | Bye
)


class Welcome(Message, tag="welcome"):
    """Answer to `Hello`.

    ``session`` is the slot the client locks in every segment it opens.  Cell ids in replies are relative to
    ``id_prefix`` and segment names to ``segment_prefix``.  ``events`` is the path of the events socket; empty
    if there is none.  ``(point + origin) / unit_m`` is a point in the coordinate system ``crs`` of the files
    that the map was made of.
    """

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

    def whole_id(self, cell_id: str) -> str:
        """Return the full id of a cell, given its id in a reply."""
        return cell_id if cell_id.startswith("/") else self.id_prefix + cell_id


class Handle(msgspec.Struct, array_like=True, frozen=True, gc=False):
    """Location of one layer of one cell in shared memory.

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
    """A cell still being loaded when the reply was sent; ``id`` lacks the prefix."""

    id: str
    layer: str


class FailedCell(msgspec.Struct, array_like=True, frozen=True):
    """A cell that could not be loaded; ``id`` is as the client requested it, else without the prefix.

    ``box`` is its ``min_x, min_y, max_x, max_y`` in metres; None if that is not known.
    """

    id: str
    layer: str
    code: str
    message: str
    holders: tuple[Holder, ...] = ()
    box: tuple[float, float, float, float] | None = None


class Cells(Message, tag="cells"):
    """Answer to `Area`, `Differential` and `Selected`.

    ``removed`` repeats held ids that the client should drop, in the client's order; ``removed_packed`` does
    the same for packed versions, in any order.  ``layers`` are the requested layers, in order, in canonical
    form. ``covered`` is false if the list of cells is not yet known for part of the request; no cell of that
    part is removed.  ``reason`` is ``offline`` if that list is unreachable at present, and empty if it is
    being fetched.  A reply is bounded: if there is more, ``next`` is the ``start`` to go on with, else it is
    empty.  Only the last reply has removals.
    """

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
    next: str = ""


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


class MetadataPage(Message, tag="metadata_page"):
    """Answer to `Metadata`; ``next`` is nil on the last page.

    ``since_known`` is false if the daemon no longer knew ``since``, and the reply contains the whole list
    instead.  ``removed`` lists ids (without the prefix) that left the map after ``since``; only the first
    page contains it.
    """

    epoch: int
    map_version: int
    rows: tuple[MetadataRow, ...]
    next: int | None = None
    since_known: bool = True
    removed: tuple[str, ...] = ()


class Released(Message, tag="released"):
    """Answer to `Release`."""


class StatsReply(Message, tag="stats_reply"):
    """Answer to `Stats`: counters by name, sessions, segments in use by processes without a session."""

    epoch: int
    map_version: int
    counters: dict[str, int]
    sessions: tuple[ClientRow, ...]
    unknown_holders: int = 0
    unknown_bytes: int = 0

    def __repr__(self) -> str:
        return (
            f"<StatsReply of daemon run {self.epoch:016x}: {len(self.counters)} counters,"
            f" {len(self.sessions)} sessions>"
        )


class CellsPage(Message, tag="cells_page"):
    """Answer to `ListCells`; ``next`` is nil on the last page.

    A segment that stays in memory is on at least one page.
    """

    epoch: int
    rows: tuple[CellRow, ...]
    next: int | None = None


class ShownCell(Message, tag="shown_cell"):
    """Answer to `Show`; ``id`` is complete, ``failure`` is the last failure if it still applies.

    ``pinned`` names the layers that an operator keeps resident.
    """

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


class Reloaded(Message, tag="reloaded"):
    """Answer to `Reload`: how many cells changed, were added and were removed; warnings."""

    map_version: int
    changed: int
    added: int
    removed: int
    problems: tuple[str, ...] = ()


class Evicted(Message, tag="evicted"):
    """Answer to `Evict`: segments freed at once, segments still mapped, unknown ids.

    ``kept`` counts the segments left alone because an operator pinned them.
    """

    freed: int
    pinned: int
    unknown: tuple[str, ...] = ()
    kept: int = 0


class PinnedCell(msgspec.Struct, array_like=True, frozen=True):
    """A pinned cell: ``state`` is resident, stale, loading, absent, or the reason why it cannot be loaded."""

    id: str
    layer: str
    state: str
    bytes: int


class Pinned(Message, tag="pinned"):
    """Answer to `Pin` and `Unpin`: the requested cells, else all pinned ones; and unknown ids."""

    cells: tuple[PinnedCell, ...]
    unknown: tuple[str, ...] = ()


class Stopping(Message, tag="stopping"):
    """Answer to `Shutdown`: the daemon ends now."""


class ErrorReply(Message, tag="error"):
    """The request as a whole was refused; code ``no_session`` requires a new `Hello`."""

    code: str
    message: str
    hint: str = ""


Reply: TypeAlias = (
    Welcome
    | Cells
    | MetadataPage
    | Released
    | StatsReply
    | CellsPage
    | ShownCell
    | Reloaded
    | Evicted
    | Pinned
    | Stopping
    | EventPage
    | LiveReply
    | ErrorReply
)
