# SPDX-License-Identifier: Apache-2.0
"""What a client may ask, one declaration per request.

Lists have a greatest length, so that what is too long is refused before anything of it is decoded.
"""

from __future__ import annotations

from typing import Annotated, Final, TypeAlias

import msgspec

from shmmap.protocol.areas import AreaMessage, HeldCell, Intent
from shmmap.protocol.events import Recent
from shmmap.protocol.live import LiveRequest

__all__ = [
    "Area",
    "Bye",
    "Differential",
    "Evict",
    "Hello",
    "Metadata",
    "Pin",
    "Release",
    "Reload",
    "Request",
    "Selected",
    "Show",
    "Shutdown",
    "Stats",
    "Unpin",
]

MAX_NAMES: Final = 20_000
"""Cells that a request names one by one."""
MAX_LAYERS: Final = 64

Ids: TypeAlias = Annotated[tuple[str, ...], msgspec.Meta(max_length=MAX_NAMES)]
Layers: TypeAlias = Annotated[tuple[str, ...], msgspec.Meta(max_length=MAX_LAYERS)]
Held: TypeAlias = Annotated[tuple[HeldCell, ...], msgspec.Meta(max_length=MAX_NAMES)]


class Hello(msgspec.Struct, array_like=True, tag="hello"):
    """First message of a session.

    ``session`` is the slot of the client's session with a previous run of the daemon, 0 for none: it
    keeps it, so that the locks it holds still name it.
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
