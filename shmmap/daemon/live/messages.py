# SPDX-License-Identifier: Apache-2.0
"""What the daemon and its live worker say to each other.

One packet of a SEQPACKET socket pair is one message.  Both ends are always the same version of shmmap.
"""

from __future__ import annotations

from functools import cache
from typing import Final, TypeAlias

import msgspec

from shmmap.daemon.config_live import LiveSettings
from shmmap.protocol.live import LiveMapRow

__all__ = [
    "MOST_OF_A_SESSION",
    "Answer",
    "Ask",
    "Begin",
    "Begun",
    "End",
    "Ended",
    "FromLive",
    "Left",
    "Status",
    "ToLive",
    "Unsaved",
    "decode_from_live",
    "decode_to_live",
    "encode",
    "not_served",
]


class Begin(msgspec.Struct, array_like=True, tag="begin"):
    """Bring these maps into memory, and serve them.

    Attributes
    ----------
    shm_dir, marks_dir
        Where chunks are, and where mappers put marks.
    budget_bytes
        Memory of all maps together.
    gid, marks_gid
        Groups that may read chunks, and that may map; -1: none.
    """

    instance: str
    maps: tuple[LiveSettings, ...]
    shm_dir: str
    marks_dir: str
    budget_bytes: int
    gid: int
    marks_gid: int


class Ask(msgspec.Struct, array_like=True, tag="ask"):
    """A client's request, as it came; ``maps`` says whether this client may change live maps."""

    ticket: int
    session: int
    uid: int
    maps: bool
    body: bytes


class Left(msgspec.Struct, array_like=True, tag="left"):
    """A session has ended."""

    session: int


class End(msgspec.Struct, array_like=True, tag="end"):
    """Save everything and take all names away; or, with ``keep``, leave memory to the next life."""

    keep: bool


class Begun(msgspec.Struct, array_like=True, tag="begun"):
    """Each map is served, or has a problem: how many are served, how many chunks were found in memory.

    The error is why none can be, as long as the settings stay and another daemon runs.
    """

    maps: int
    adopted: int
    code: str = ""
    message: str = ""
    hint: str = ""


class Answer(msgspec.Struct, array_like=True, tag="answer"):
    """The reply to a request."""

    ticket: int
    body: bytes


class Status(msgspec.Struct, array_like=True, tag="status"):
    """How the maps are."""

    maps: tuple[LiveMapRow, ...]


class Unsaved(msgspec.Struct, array_like=True, frozen=True):
    """So many chunks of a map could not be saved, and stay in memory; and why."""

    map: str
    chunks: int
    problem: str


class Ended(msgspec.Struct, array_like=True, tag="ended"):
    """The worker ends now."""

    unsaved: tuple[Unsaved, ...]


ToLive: TypeAlias = Begin | Ask | Left | End
FromLive: TypeAlias = Begun | Answer | Status | Ended

MOST_OF_A_SESSION: Final = 64
"""Requests that are passed on before they are answered."""

encode: Final = msgspec.msgpack.Encoder().encode


def not_served(one: LiveSettings, budget_bytes: int, problem: str) -> LiveMapRow:
    """How a map is of which nothing is in memory, and why."""
    return LiveMapRow(
        one.name, one.path, one.resolution, one.frame_id, chunks=0, active=0, bytes=0, loading=0, dirty=0,
        saving=0, waiting_bytes=0, files=0, file_bytes=0, scans=0, durable=0,
        budget_bytes=budget_bytes, problem=problem,
    )  # fmt: skip


@cache
def _to_live() -> msgspec.msgpack.Decoder[ToLive]:
    return msgspec.msgpack.Decoder(ToLive)


@cache
def _from_live() -> msgspec.msgpack.Decoder[FromLive]:
    return msgspec.msgpack.Decoder(FromLive)


def decode_to_live(data: bytes | memoryview) -> ToLive:
    """Read what the daemon says."""
    return _to_live().decode(data)


def decode_from_live(data: bytes | memoryview) -> FromLive:
    """Read what the worker says."""
    return _from_live().decode(data)
