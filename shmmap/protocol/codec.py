# SPDX-License-Identifier: Apache-2.0
"""Encode and decode messages; invalid bytes raise `BadRequest` or `ProtocolMismatch`."""

from __future__ import annotations

import struct
import threading
from collections.abc import Iterable, Sequence
from functools import cache
from typing import Final

import msgspec

from shmmap.errors import BadRequest, ProtocolMismatch
from shmmap.protocol.messages import FailedCell, Handle, PendingCell, Reply, Request

MAX_REQUEST_BYTES: Final = 4 << 20
"""Largest request; the socket itself refuses larger ones.  10^5 packed held cells need 800 kB."""


def _plain(value: object) -> object:
    """Convert numpy numbers (a pose, a radius) to plain numbers for encoding."""
    item = getattr(value, "item", None)
    if item is None or getattr(value, "shape", None) != ():
        raise TypeError(f"a message cannot carry {type(value).__name__}")
    return item()


_encoder: Final = msgspec.msgpack.Encoder(enc_hook=_plain)
encode: Final = _encoder.encode


def encode_request(message: Request) -> bytes:
    """Return a request's bytes; raise `BadRequest` if it is too large, which would end the connection."""
    data = encode(message)
    if len(data) > MAX_REQUEST_BYTES:
        raise BadRequest(
            f"the request has {len(data):,} bytes; {MAX_REQUEST_BYTES:,} are the most",
            hint="ask for an area, or for some ids at a time",
        )
    return data


@cache  # created at first use: a client never decodes requests, and imports should be cheap
def _requests() -> msgspec.msgpack.Decoder[Request]:
    return msgspec.msgpack.Decoder(Request)


_making: Final = threading.Lock()
"""Taken to make the decoder of replies: threads that connect at once decode their first ones at once."""


@cache
def _replies() -> msgspec.msgpack.Decoder[Reply]:
    with _making:
        return msgspec.msgpack.Decoder(Reply)


def encode_handle(handle: Handle) -> bytes:
    """Return a handle's bytes, to be reused in every reply that contains it."""
    return _encoder.encode(handle)


def _head(count: int) -> bytes:
    """Encode the head of an array of ``count`` elements."""
    if count < 16:
        return bytes((0x90 | count,))
    if count < 1 << 16:
        return b"\xdc" + count.to_bytes(2, "big")
    return b"\xdd" + count.to_bytes(4, "big")


def encode_cells(
    request: int,
    epoch: int,
    map_version: int,
    handles: Sequence[bytes],
    removed: tuple[str, ...],
    removed_packed: bytes,
    layers: tuple[str, ...],
    *,
    covered: bool = True,
    pending: Sequence[PendingCell] = (),
    failed: Sequence[FailedCell] = (),
    reason: str = "",
    next_id: str = "",
) -> bytes:
    """Return a `Cells` reply whose handles are encoded already."""
    start = encode(("cells", request, epoch, map_version))
    end = encode((removed, removed_packed, pending, failed, layers, covered, reason, next_id))
    # one array of thirteen elements instead of two: replace their one-byte heads
    return b"".join((b"\x9d", start[1:], _head(len(handles)), *handles, end[1:]))


def decode_request(data: bytes | memoryview) -> Request:
    """Return the request; raise `BadRequest` that names the invalid element."""
    try:
        return _requests().decode(data)
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError) as error:
        raise BadRequest(f"the request does not decode: {error}") from error


def request_number(data: bytes | memoryview) -> int:
    """Return the request id of a message that does not decode as a whole; 0 if it has none."""
    try:
        start = msgspec.msgpack.decode(data)
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError):
        return 0
    if isinstance(start, list) and len(start) > 1 and isinstance(start[1], int):
        return start[1] if 0 <= start[1] < 1 << 64 else 0
    return 0


def pack_versions(versions: Iterable[int]) -> bytes:
    """Return cell versions as 8 bytes little-endian each."""
    whole = tuple(versions)
    return struct.pack(f"<{len(whole)}Q", *whole)


def unpack_versions(packed: bytes) -> tuple[int, ...]:
    """Return packed cell versions; errors as of `check_packed`."""
    check_packed(packed)
    return struct.unpack(f"<{len(packed) // 8}Q", packed)


def check_packed(packed: bytes) -> None:
    """Raise `BadRequest` if the size of packed cell versions is no multiple of 8 bytes."""
    if len(packed) % 8:
        raise BadRequest(f"packed versions of {len(packed)} bytes are no multiple of 8")


def decode_reply(data: bytes | memoryview) -> Reply:
    """Return the reply; raise `ProtocolMismatch` if it is not one of this protocol version."""
    try:
        return _replies().decode(data)
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError) as error:
        raise ProtocolMismatch(
            f"the daemon's reply does not decode: {error}", hint="update the older of client and daemon"
        ) from None
