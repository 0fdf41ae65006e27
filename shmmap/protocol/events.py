# SPDX-License-Identifier: Apache-2.0
"""The events that the daemon publishes.  ``PROTOCOL.md`` is the byte-exact document.

An event is one MessagePack array: its kind, its number, the epoch it belongs to, when it happened, and
what happened.  Events of one epoch are numbered from 1 without gaps, so that a missed one is noticed;
`UNNUMBERED` ones have the number of the last that is.
"""

from __future__ import annotations

from functools import cache
from typing import Final, TypeAlias

import msgspec

from shmmap.errors import ProtocolMismatch

__all__ = [
    "UNNUMBERED",
    "Beat",
    "Changed",
    "Epoch",
    "Event",
    "EventPage",
    "Evicted",
    "Failed",
    "Joined",
    "Left",
    "LiveChanged",
    "LiveDamaged",
    "LiveEnded",
    "LiveProblem",
    "LiveStarted",
    "Loaded",
    "LongTurn",
    "PrefetchMiss",
    "Pressure",
    "Recent",
    "Reloaded",
    "Retried",
    "decode_event",
    "encode_event",
]


class _Numbered(msgspec.Struct, array_like=True, frozen=True):
    """Every event's number in its epoch, its epoch, and the wall clock when it happened."""

    seq: int
    epoch: int
    unix_ns: int


class Epoch(_Numbered, tag="epoch", frozen=True):
    """A run of the daemon: ``what`` is started or stopping; segments taken over from the previous run."""

    what: str
    map_version: int
    cells: int
    adopted: int = 0


class Loaded(_Numbered, tag="loaded", frozen=True):
    """A segment can be handed out; ``load_ns`` is 0 for one that was retired, still whole and wanted again.

    ``again`` says that this very version had been evicted to make room; ``replaces`` is the version
    that it supersedes, 0 for none; ``ahead`` that it was prefetched.
    """

    id: str
    layer: str
    version: int
    bytes: int
    points: int
    load_ns: int
    again: bool = False
    replaces: int = 0
    ahead: bool = False


class Changed(_Numbered, tag="changed", frozen=True):
    """A cell's source: ``how`` is changed, added, removed or moved; version 0 for a removed one."""

    id: str
    version: int
    how: str


class Evicted(_Numbered, tag="evicted", frozen=True):
    """A segment is handed out no more: ``why`` is room, request, map (its cell left) or damaged."""

    id: str
    layer: str
    version: int
    bytes: int
    why: str


class Failed(_Numbered, tag="failed", frozen=True):
    """A cell could not be loaded; it is not tried again for ``retry_s`` seconds, unless its file changes."""

    id: str
    layer: str
    code: str
    message: str
    retry_s: float


class Retried(_Numbered, tag="retried", frozen=True):
    """A cell that failed is loaded again because it was requested; ``code`` of the failure."""

    id: str
    layer: str
    code: str


class Pressure(_Numbered, tag="pressure", frozen=True):
    """Cells were refused because memory is full: how many since the last such event, and one of them.

    ``code`` is over_budget, no_space, or quota: the client would keep too much for itself alone.  At
    most one a second.
    """

    id: str
    layer: str
    code: str
    refused: int
    budget_bytes: int
    used_bytes: int
    pinned_bytes: int
    zombie_bytes: int


class PrefetchMiss(_Numbered, tag="prefetch_miss", frozen=True):
    """A moving client had to wait for cells: how many since the last such event, and one of them.

    At most one a second for each client.
    """

    session: int
    pid: int
    client: str
    cells: int
    id: str
    layer: str


class Reloaded(_Numbered, tag="reload", frozen=True):
    """The map's catalogue was read again; ``error`` says why that failed.

    The first ``listed`` of its changes follow as `Changed`.
    """

    map_version: int
    changed: int
    added: int
    removed: int
    listed: int
    error: str = ""


class LongTurn(_Numbered, tag="long_turn", frozen=True):
    """A turn of the daemon's loop took ``cpu_ns`` of processor time, more than it should.

    ``kind`` is what took most of it, see `shmmap.statistics.counters.TURN_KINDS`; at most one a second.
    """

    kind: str
    cpu_ns: int


class Joined(_Numbered, tag="joined", frozen=True):
    """A client opened a session; pid 0 where the kernel does not say."""

    session: int
    pid: int
    uid: int
    client: str


class Left(_Numbered, tag="left", frozen=True):
    """A session ended; ``bytes`` is what it held."""

    session: int
    pid: int
    client: str
    bytes: int


class LiveStarted(_Numbered, tag="live_started", frozen=True):
    """The process that keeps live maps serves them; ``chunks`` were found in memory."""

    maps: int
    chunks: int


class LiveEnded(_Numbered, tag="live_ended", frozen=True):
    """The process that keeps live maps ended, for the ``restarts``-th time, and restarts."""

    restarts: int


class LiveProblem(_Numbered, tag="live_problem", frozen=True):
    """Chunks of a live map cannot be loaded or saved, and why; an empty reason: the problem is over."""

    map: str
    problem: str


class LiveDamaged(_Numbered, tag="live_damaged", frozen=True):
    """A damaged file of a live map was quarantined, or a chunk is missing: which, and why."""

    map: str
    what: str


class LiveChanged(_Numbered, tag="live_changed", frozen=True):
    """A live map has changed; ``change`` is the number of its last change, as in `LiveChunkPage`.

    Sent at most twice a second for a map, and not remembered: the next one follows.
    """

    map: str
    change: int


class Beat(_Numbered, tag="beat", frozen=True):
    """Nothing happened: ``seq`` is the last event's number.

    Sent at a subscription, and once a second, so that a missed last event is noticed too.
    """


Event: TypeAlias = (
    Epoch
    | Loaded
    | Changed
    | Evicted
    | Failed
    | Retried
    | Pressure
    | PrefetchMiss
    | Reloaded
    | LongTurn
    | Joined
    | Left
    | LiveStarted
    | LiveEnded
    | LiveProblem
    | LiveDamaged
    | LiveChanged
    | Beat
)


UNNUMBERED: Final = (LiveChanged, Beat)
"""Kinds that take no number: ``seq`` is the last event's, and the daemon does not remember them."""


class Recent(msgspec.Struct, array_like=True, tag="recent"):
    """Events the daemon remembers: those numbered above ``after``, and not older than ``since_unix_ns``."""

    request: int
    after: int = 0
    since_unix_ns: int = 0
    limit: int = 500


class EventPage(msgspec.Struct, array_like=True, tag="events"):
    """Answer to `Recent`, oldest first.

    ``first`` is the number of the oldest event remembered, ``next`` the number the next one will
    get.  Ask again with ``after`` = number of the last one here until there are no more.
    """

    request: int
    epoch: int
    first: int
    next: int
    events: tuple[msgspec.Raw, ...] = ()


_encoder: Final = msgspec.msgpack.Encoder()
encode_event: Final = _encoder.encode


@cache  # made when it is first needed: most clients subscribe to no events
def _events() -> msgspec.msgpack.Decoder[Event]:
    return msgspec.msgpack.Decoder(Event)


def decode_event(data: bytes | memoryview | msgspec.Raw) -> Event | None:
    """Return the event; None for a kind that this version does not know.

    Raises
    ------
    ProtocolMismatch
        It is no event.
    """
    try:
        return _events().decode(data)
    except msgspec.ValidationError as error:
        try:
            head = msgspec.msgpack.decode(data)
        except msgspec.DecodeError:
            head = None
        if isinstance(head, list) and len(head) >= 4 and isinstance(head[0], str):
            return None
        raise ProtocolMismatch(f"what arrived is no event: {error}") from error
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ProtocolMismatch(f"what arrived is no event: {error}") from error
