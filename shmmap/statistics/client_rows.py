# SPDX-License-Identifier: Apache-2.0
"""Rows about clients in the statistics segment: who is connected, holds how much, and is where."""

from __future__ import annotations

import struct
import zlib
from typing import Final, Literal, NamedTuple, TypeAlias

from shmmap.errors import SegmentCorrupt

__all__ = ["CLIENT_ROW_BYTES", "MAX_CLIENTS", "ClientRow", "Window", "pack_client", "unpack_client"]

CLIENT_ROW: Final = struct.Struct("<QIIQQQq3d4dBBHI48s16s76x")
CLIENT_ROW_BYTES: Final = CLIENT_ROW.size + 4
MAX_CLIENTS: Final = 256  # more clients than that are counted, not listed

Shape: TypeAlias = Literal["none", "circle", "square", "box"]

HAS_POSE: Final = 1
HAS_HEADING: Final = 2
SHAPES: Final[tuple[Shape, ...]] = ("none", "circle", "square", "box")
NO_USER: Final = 0xFFFFFFFF  # no process has this uid
CLIENT_BYTES: Final = 48
COMMAND_BYTES: Final = 16


class Window(NamedTuple):
    """The last area a client asked for: centre and half extents, metres, map frame.

    For a circle both half extents are its radius.
    """

    shape: Shape
    x: float
    y: float
    half_x: float
    half_y: float


class ClientRow(NamedTuple):
    """One client.

    Attributes
    ----------
    session
        Its number.
    pid, uid
        According to the kernel; pid 0 and uid -1 where it gives none.
    cells, bytes
        Versions it holds or was handed, and their memory.
    requests
        How many it sent.
    last_request_monotonic_ns
        When it sent the last one, CLOCK_MONOTONIC.
    client, command
        What it calls itself (cut after 48 bytes), what the kernel calls it.
    pose
        (x, y) in metres, map frame; None while it is not known.
    heading
        Radians, None while it is not known.
    window
        The last area it asked for.
    """

    session: int
    pid: int
    uid: int
    cells: int
    bytes: int
    requests: int
    last_request_monotonic_ns: int
    client: str
    command: str
    pose: tuple[float, float] | None = None
    heading: float | None = None
    window: Window | None = None


def _cut(text: str, limit: int) -> bytes:
    data = text.encode("utf-8", "replace")
    return data if len(data) <= limit else data[:limit].decode("utf-8", "ignore").encode()


def pack_client(row: ClientRow | None) -> bytes:
    """Return the 256 bytes of one row; of a free one for None."""
    if row is None:
        return _sealed(bytes(CLIENT_ROW.size))
    window = row.window
    body = CLIENT_ROW.pack(
        row.session, row.pid, row.uid & NO_USER,
        row.cells, row.bytes, row.requests, row.last_request_monotonic_ns,
        *(row.pose or (0.0, 0.0)), row.heading or 0.0,
        *(window[1:] if window is not None else (0.0, 0.0, 0.0, 0.0)),
        SHAPES.index(window.shape) if window is not None else 0,
        (row.pose is not None) * HAS_POSE + (row.heading is not None) * HAS_HEADING,
        0, 0, _cut(row.client, CLIENT_BYTES), _cut(row.command, COMMAND_BYTES),
    )  # fmt: skip
    return _sealed(body)


def _sealed(body: bytes) -> bytes:
    return body + struct.pack("<I", zlib.crc32(body))


def unpack_client(data: bytes | memoryview) -> ClientRow | None:
    """Return one row; None if it is free.

    Raises
    ------
    SegmentCorrupt
        If it is torn: the writer was changing it.
    """
    end = CLIENT_ROW.size
    if zlib.crc32(data[:end]) != int.from_bytes(data[end : end + 4], "little"):
        raise SegmentCorrupt("a client's row of the statistics is torn")
    (
        session, pid, uid, cells, nbytes, requests, last, x, y, heading, *area, shape, flags, _, _,
        client, command,
    ) = CLIENT_ROW.unpack_from(data)  # fmt: skip
    if not session:
        return None
    return ClientRow(
        session, pid, -1 if uid == NO_USER else uid, cells, nbytes, requests, last,
        client.rstrip(b"\0").decode("utf-8", "replace"),
        command.rstrip(b"\0").decode("utf-8", "replace"),
        (x, y) if flags & HAS_POSE else None,
        heading if flags & HAS_HEADING else None,
        Window(SHAPES[shape], *area) if 0 < shape < len(SHAPES) else None,
    )  # fmt: skip
