# SPDX-License-Identifier: Apache-2.0
"""Messages to bytes and back; whatever does not decode is a `BadRequest` or a `ProtocolMismatch`."""

from __future__ import annotations

from typing import Final

import msgspec

from shmmap.errors import BadRequest, ProtocolMismatch
from shmmap.protocol.messages import Handle, Reply, Request

__all__ = ["MAX_REQUEST_BYTES", "decode_reply", "decode_request", "encode", "encode_handle"]

MAX_REQUEST_BYTES: Final = 4 << 20
"""Larger requests are refused by the socket itself: 10^5 packed held cells fit 800 kB."""

_encoder: Final = msgspec.msgpack.Encoder()
_requests: Final[msgspec.msgpack.Decoder[Request]] = msgspec.msgpack.Decoder(Request)
_replies: Final[msgspec.msgpack.Decoder[Reply]] = msgspec.msgpack.Decoder(Reply)

encode: Final = _encoder.encode


def encode_handle(handle: Handle) -> bytes:
    """Return a handle's bytes, to be reused in every reply that carries it."""
    return _encoder.encode(handle)


def decode_request(data: bytes | memoryview) -> Request:
    """Return the request; `BadRequest` says at which element it is wrong."""
    try:
        return _requests.decode(data)
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError) as error:
        raise BadRequest(f"the request does not decode: {error}") from error


def decode_reply(data: bytes | memoryview) -> Reply:
    """Return the reply; `ProtocolMismatch` if it is none of this protocol version."""
    try:
        return _replies.decode(data)
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError) as error:
        raise ProtocolMismatch(
            f"the daemon's reply does not decode: {error}", hint="update the older of client and daemon"
        ) from error
