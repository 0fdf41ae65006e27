# SPDX-License-Identifier: Apache-2.0
"""Rows of the statistics segment: length, checksum and MessagePack, in slots of fixed size."""

from __future__ import annotations

import struct
import zlib
from functools import cache
from typing import Final, TypeVar

import msgspec

from shmmap.errors import SegmentCorrupt
from shmmap.protocol.rows import CellRow, ClientRow, LiveMapRow

__all__ = ["FREE_ROW", "pack_row", "unpack_row"]

_Row = TypeVar("_Row", bound=msgspec.Struct)

HEAD: Final = struct.Struct("<II")
LENGTH_BYTES: Final = 4
FREE_ROW: Final = bytes(HEAD.size)

_SHORTENED: Final[dict[type[msgspec.Struct], dict[str, int]]] = {
    CellRow: {"id": 100, "layer": 0},
    ClientRow: {"client": 0, "command": 0},
    LiveMapRow: {"mappers": 0, "damaged": 0, "path": 200, "problem": 0},
}
"""Fields that are shortened in a row that is too long, in order, and the bytes that they keep."""
_KEEP_END: Final = {"id", "path"}
_MARK: Final = "…"

_encode: Final = msgspec.msgpack.Encoder().encode


def pack_row(row: msgspec.Struct, size: int) -> bytes:
    """Return the bytes of a row, at most ``size``; shortened texts contain an ellipsis."""
    try:
        data = _encode(row)
    except UnicodeEncodeError:  # file names need not be valid text
        row = msgspec.structs.replace(row, **{n: _text(v) for n, v in _texts(row).items()})
        data = _encode(row)
    for name, kept_bytes in _SHORTENED[type(row)].items() if len(data) > size - HEAD.size else ():
        excess = len(data) - (size - HEAD.size)
        if excess > 0:
            shorter = _shortened(getattr(row, name), excess, kept_bytes, keep_end=name in _KEEP_END)
            row = msgspec.structs.replace(row, **{name: shorter})
            data = _encode(row)
    return (
        HEAD.pack(len(data), zlib.crc32(data, zlib.crc32(len(data).to_bytes(LENGTH_BYTES, "little")))) + data
    )


def _texts(row: msgspec.Struct) -> dict[str, str]:
    return {name: value for name, value in msgspec.structs.asdict(row).items() if isinstance(value, str)}


def _text(value: str) -> str:
    return value.encode("utf-8", "backslashreplace").decode()


def _shortened(value: object, excess: int, kept_bytes: int, *, keep_end: bool) -> object:
    if not isinstance(value, str):
        return ()
    data = value.encode()
    kept = max(kept_bytes, len(data) - excess - len(_MARK.encode()), 0)
    if kept >= len(data):
        return value
    if keep_end:
        return _MARK + data[len(data) - kept :].decode("utf-8", "ignore")
    return data[:kept].decode("utf-8", "ignore") + _MARK


@cache
def _decoder(kind: type[_Row]) -> msgspec.msgpack.Decoder[_Row]:
    return msgspec.msgpack.Decoder(kind)


def unpack_row(kind: type[_Row], data: memoryview) -> _Row | None:
    """Return a row of the table's ``kind``; None for a free slot.

    Raises
    ------
    SegmentCorrupt
        The row is torn (the writer was changing it), or not of that kind.
    """
    length, crc = HEAD.unpack_from(data)
    if not length:
        return None
    body = data[HEAD.size : HEAD.size + length]
    if len(body) != length or crc != zlib.crc32(body, zlib.crc32(data[:LENGTH_BYTES])):
        raise SegmentCorrupt("a row of the statistics is torn")
    try:
        row: _Row = _decoder(kind).decode(body)
    except msgspec.DecodeError as error:
        raise SegmentCorrupt(f"a row of the statistics does not decode: {error}") from None
    return row
