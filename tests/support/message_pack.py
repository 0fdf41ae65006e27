# SPDX-License-Identifier: Apache-2.0
"""MessagePack as the protocol document needs it, written from https://msgpack.org's specification."""

from __future__ import annotations

import struct
from typing import Any

_SIZED = {0xC4: ">B", 0xC5: ">H", 0xC6: ">I", 0xD9: ">B", 0xDA: ">H", 0xDB: ">I"}
_NUMBERS = {
    0xCA: ">f",
    0xCB: ">d",
    0xCC: ">B",
    0xCD: ">H",
    0xCE: ">I",
    0xCF: ">Q",
    0xD0: ">b",
    0xD1: ">h",
    0xD2: ">i",
    0xD3: ">q",
}


def unpack(data: bytes) -> Any:
    """Return the one value ``data`` holds."""
    value, end = _value(data, 0)
    if end != len(data):
        raise ValueError(f"{len(data) - end} bytes after the value")
    return value


def _value(data: bytes, at: int) -> tuple[Any, int]:
    tag = data[at]
    at += 1
    if tag < 0x80:
        return tag, at
    if tag >= 0xE0:
        return tag - 256, at
    if tag < 0x90:
        return _map(data, at, tag & 15)
    if tag < 0xA0:
        return _array(data, at, tag & 15)
    if tag < 0xC0:
        end = at + (tag & 31)
        return data[at:end].decode(), end
    if tag in (0xC0, 0xC2, 0xC3):
        return {0xC0: None, 0xC2: False, 0xC3: True}[tag], at
    if tag in _NUMBERS:
        (number,) = struct.unpack_from(_NUMBERS[tag], data, at)
        return number, at + struct.calcsize(_NUMBERS[tag])
    if tag in _SIZED:
        (length,) = struct.unpack_from(_SIZED[tag], data, at)
        at += struct.calcsize(_SIZED[tag])
        raw = data[at : at + length]
        if len(raw) != length:
            raise ValueError("text or bytes end early")
        return (raw if tag < 0xD9 else raw.decode()), at + length
    if tag in (0xDC, 0xDD, 0xDE, 0xDF):
        form = ">H" if tag in (0xDC, 0xDE) else ">I"
        (length,) = struct.unpack_from(form, data, at)
        at += struct.calcsize(form)
        return _array(data, at, length) if tag < 0xDE else _map(data, at, length)
    raise ValueError(f"tag {tag:#x} is not used by the protocol")


def _array(data: bytes, at: int, length: int) -> tuple[list[Any], int]:
    items = []
    for _ in range(length):
        item, at = _value(data, at)
        items.append(item)
    return items, at


def _map(data: bytes, at: int, length: int) -> tuple[dict[Any, Any], int]:
    items = {}
    for _ in range(length):
        key, at = _value(data, at)
        items[key], at = _value(data, at)
    return items, at


def _head(length: int, forms: tuple[tuple[int, int, str], ...], fix: tuple[int, int] | None) -> bytes:
    if fix is not None and length <= fix[1]:
        return bytes([fix[0] | length])
    for limit, tag, form in forms:
        if length <= limit:
            return bytes([tag]) + struct.pack(form, length)
    raise ValueError("too long")


def pack(value: Any) -> bytes:
    """Return ``value`` (None, bool, int, float, str, bytes, sequence, dict) in its shortest form."""
    if value is None or value is True or value is False:
        return {None: b"\xc0", False: b"\xc2", True: b"\xc3"}[value]
    if isinstance(value, int):
        if value >= 0:
            unsigned = (
                (255, 0xCC, ">B"),
                (65535, 0xCD, ">H"),
                (2**32 - 1, 0xCE, ">I"),
                (2**64 - 1, 0xCF, ">Q"),
            )
            return _head(value, unsigned, (0, 127))
        if value >= -32:
            return bytes([value + 256])
        for limit, tag, form in ((-128, 0xD0, ">b"), (-32768, 0xD1, ">h"), (-(2**31), 0xD2, ">i")):
            if value >= limit:
                return bytes([tag]) + struct.pack(form, value)
        return b"\xd3" + struct.pack(">q", value)
    if isinstance(value, float):
        return b"\xcb" + struct.pack(">d", value)
    if isinstance(value, str):
        raw = value.encode()
        return (
            _head(len(raw), ((255, 0xD9, ">B"), (65535, 0xDA, ">H"), (2**32 - 1, 0xDB, ">I")), (0xA0, 31))
            + raw
        )
    if isinstance(value, bytes):
        return (
            _head(len(value), ((255, 0xC4, ">B"), (65535, 0xC5, ">H"), (2**32 - 1, 0xC6, ">I")), None) + value
        )
    if isinstance(value, (list, tuple)):
        head = _head(len(value), ((65535, 0xDC, ">H"), (2**32 - 1, 0xDD, ">I")), (0x90, 15))
        return head + b"".join(map(pack, value))
    if isinstance(value, dict):
        head = _head(len(value), ((65535, 0xDE, ">H"), (2**32 - 1, 0xDF, ">I")), (0x80, 15))
        return head + b"".join(pack(k) + pack(v) for k, v in value.items())
    raise TypeError(f"{type(value).__name__} has no MessagePack form here")
