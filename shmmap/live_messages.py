# SPDX-License-Identifier: Apache-2.0
"""Messages between the daemon and its live worker.

One packet of a SEQPACKET socket pair is one message.  Both ends are always the same version of shmmap.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, TypeAlias

import msgspec

from shmmap.live_settings import LiveSettings
from shmmap.protocol.live import LiveMapRow


class Begin(msgspec.Struct, array_like=True, tag="begin"):
    """Load these maps into memory, and serve them.

    Attributes
    ----------
    shm_dir, marks_dir
        Directories of chunks, and of mappers' marks.
    budget_bytes
        Memory budget of all maps together, bytes.
    gid, marks_gid
        Groups whose members may read chunks, and may map; -1: none.
    """

    instance: str
    maps: tuple[LiveSettings, ...]
    shm_dir: str
    marks_dir: str
    budget_bytes: int
    gid: int
    marks_gid: int


class Ask(msgspec.Struct, array_like=True, tag="ask"):
    """A client's request as received; ``maps`` is whether this client may change live maps."""

    ticket: int
    session: int
    uid: int
    maps: bool
    body: bytes


class Disconnected(msgspec.Struct, array_like=True, tag="disconnected"):
    """A session has ended."""

    session: int


class End(msgspec.Struct, array_like=True, tag="end"):
    """Save all chunks and remove them from memory; with ``keep``, leave them in memory to the next run."""

    keep: bool


class Begun(msgspec.Struct, array_like=True, tag="begun"):
    """Each map is served or has a problem; with the number of served maps and of chunks found in memory.

    The error is the reason if no map can be served until settings change or another daemon ends.
    """

    maps: int
    adopted: int
    code: str = ""
    message: str = ""
    hint: str = ""


class Reply(msgspec.Struct, array_like=True, tag="reply"):
    """The reply to a request."""

    ticket: int
    body: bytes


class Status(msgspec.Struct, array_like=True, tag="status"):
    """State of all maps."""

    maps: tuple[LiveMapRow, ...]


class Unsaved(msgspec.Struct, array_like=True, frozen=True):
    """Number of chunks of a map that could not be saved and stay in memory, and the reason."""

    map: str
    chunks: int
    problem: str


class Ended(msgspec.Struct, array_like=True, tag="ended"):
    """The last message of the worker."""

    unsaved: tuple[Unsaved, ...]


ToLive: TypeAlias = Begin | Ask | Disconnected | End
FromLive: TypeAlias = Begun | Reply | Status | Ended

MAX_PER_SESSION: Final = 64
"""Most requests of one session that are forwarded and not yet answered."""

encode: Final = msgspec.msgpack.Encoder().encode
decode_to_live: Final[Callable[[bytes | memoryview], ToLive]] = msgspec.msgpack.Decoder(ToLive).decode
decode_from_live: Final[Callable[[bytes | memoryview], FromLive]] = msgspec.msgpack.Decoder(FromLive).decode


def not_served(one: LiveSettings, budget_bytes: int, problem: str) -> LiveMapRow:
    """Return the state of a map that is not in memory, with the reason."""
    return LiveMapRow(
        one.name,
        one.path,
        one.resolution,
        one.frame_id,
        chunks=0,
        active=0,
        bytes=0,
        loading=0,
        dirty=0,
        saving=0,
        waiting_bytes=0,
        files=0,
        file_bytes=0,
        scans=0,
        durable=0,
        budget_bytes=budget_bytes,
        problem=problem,
    )
