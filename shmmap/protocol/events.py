# SPDX-License-Identifier: Apache-2.0
"""The events that the daemon publishes.  ``PROTOCOL.md`` is the byte-exact specification.

An event is one MessagePack array: kind, number, epoch, time, and the fields of the kind.  Events of one epoch
are numbered from 1 without gaps, so that a lost event is noticed.  `UNNUMBERED` events repeat the number of
the last numbered one.
"""

from __future__ import annotations

from functools import cache
from typing import Final, TypeAlias

import msgspec

from shmmap.errors import ProtocolMismatch


class _Numbered(msgspec.Struct, array_like=True, frozen=True):
    """Fields of every event: its number in its epoch, its epoch, and the wall-clock time."""

    seq: int
    epoch: int
    unix_ns: int


class Epoch(_Numbered, tag="epoch", frozen=True):
    """A daemon run: ``what`` is started or stopping; counts segments taken over from the previous run."""

    what: str
    map_version: int
    cells: int
    adopted: int = 0


class Loaded(_Numbered, tag="loaded", frozen=True):
    """A segment is available; ``load_ns`` is 0 for an intact retired segment that was requested again.

    ``again``: this version had been evicted to make room.  ``replaces``: the version that it supersedes, 0
    for none.  ``ahead``: it was prefetched.
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
    """A cell's source changed: ``how`` is changed, added, removed or moved; version 0 if removed."""

    id: str
    version: int
    how: str


class Evicted(_Numbered, tag="evicted", frozen=True):
    """A segment left service: ``why`` is room, request, map (its cell left the map) or damaged."""

    id: str
    layer: str
    version: int
    bytes: int
    why: str


class Failed(_Numbered, tag="failed", frozen=True):
    """A cell could not be loaded; the next try is after ``retry_s`` seconds, or when its file changes."""

    id: str
    layer: str
    code: str
    message: str
    retry_s: float


class Retried(_Numbered, tag="retried", frozen=True):
    """A failed cell is loaded again because of a request; ``code`` is that of the failure."""

    id: str
    layer: str
    code: str


class Pressure(_Numbered, tag="pressure", frozen=True):
    """Cells were refused because memory is full: their number since the last such event, and an example.

    ``code`` is over_budget, no_space, or quota (one client alone would hold too much).  At most one such
    event per second.
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
    """A moving client had to wait for cells: their number since the last such event, and an example.

    At most one such event per second and client.
    """

    session: int
    pid: int
    client: str
    cells: int
    id: str
    layer: str


class Reloaded(_Numbered, tag="reload", frozen=True):
    """The map's catalogue was read again; ``error`` is the reason if that failed.

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

    ``kind`` is the work that took most of it, see `shmmap.statistics.counters.TURN_KINDS`; at most one such
    event per second.
    """

    kind: str
    cpu_ns: int


class Joined(_Numbered, tag="joined", frozen=True):
    """A client opened a session; pid is 0 if the kernel does not report it."""

    session: int
    pid: int
    uid: int
    client: str


class Left(_Numbered, tag="left", frozen=True):
    """A session ended; ``bytes`` is the memory that it held."""

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
    """Chunks of a live map cannot be loaded or saved; an empty reason means that the problem is over."""

    map: str
    problem: str


class LiveDamaged(_Numbered, tag="live_damaged", frozen=True):
    """A chunk of a live map is lost, or its database was damaged; with its name and the reason."""

    map: str
    what: str


class LiveChanged(_Numbered, tag="live_changed", frozen=True):
    """A live map has changed; ``change`` is the number of its last change, as in `LiveChunkPage`.

    Sent at most twice per second and map.  The daemon does not remember these events.
    """

    map: str
    change: int


class Beat(_Numbered, tag="beat", frozen=True):
    """Heartbeat: ``seq`` is the last event's number.

    Sent at a subscription and once per second, so that the loss of the last event is noticed, too.
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
"""Kinds without their own number, which the daemon does not remember; ``seq`` is the last event's."""


class Recent(msgspec.Struct, array_like=True, tag="recent"):
    """Request remembered events: those numbered above ``after``, and not older than ``since_unix_ns``."""

    request: int
    after: int = 0
    since_unix_ns: int = 0
    limit: int = 500


class EventPage(msgspec.Struct, array_like=True, tag="events"):
    """Answer to `Recent`, oldest first.

    ``first`` is the number of the oldest remembered event, ``next`` that of the next event.  Repeat the
    request with ``after`` = number of the last event of the page until a page is empty.
    """

    request: int
    epoch: int
    first: int
    next: int
    events: tuple[msgspec.Raw, ...] = ()


_encoder: Final = msgspec.msgpack.Encoder()
encode_event: Final = _encoder.encode


@cache  # created at first use: most clients subscribe to no events
def _events() -> msgspec.msgpack.Decoder[Event]:
    return msgspec.msgpack.Decoder(Event)


def decode_event(data: bytes | memoryview | msgspec.Raw) -> Event | None:
    """Return the event; None if this version does not know its kind.

    Raises
    ------
    ProtocolMismatch
        The data is no event.
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
