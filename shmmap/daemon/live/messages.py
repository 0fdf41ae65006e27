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
    "Failed",
    "FromLive",
    "Left",
    "Status",
    "ToLive",
    "decode_from_live",
    "decode_to_live",
    "encode",
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
    """All maps are served; so many chunks were found in memory."""

    adopted: int


class Failed(msgspec.Struct, array_like=True, tag="failed"):
    """Maps cannot be served: an error as it stands on the wire."""

    code: str
    message: str
    hint: str


class Answer(msgspec.Struct, array_like=True, tag="answer"):
    """The reply to a request."""

    ticket: int
    body: bytes


class Status(msgspec.Struct, array_like=True, tag="status"):
    """How the maps are."""

    maps: tuple[LiveMapRow, ...]


class Ended(msgspec.Struct, array_like=True, tag="ended"):
    """The worker ends now; so many chunks could not be saved and stay in memory."""

    unsaved: int


ToLive: TypeAlias = Begin | Ask | Left | End
FromLive: TypeAlias = Begun | Failed | Answer | Status | Ended

MOST_OF_A_SESSION: Final = 64
"""Requests that are passed on before they are answered."""

encode: Final = msgspec.msgpack.Encoder().encode


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
