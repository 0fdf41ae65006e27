# SPDX-License-Identifier: Apache-2.0
"""PCD files byte by byte, from Python numbers and `struct`; independent of shmmap and of numpy.

Unlike `tests.support.pcd_files` it writes all encodings, every type, and headers that are wrong on
purpose.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass

Number = int | float

CODES = {
    ("F", 4): "f",
    ("F", 8): "d",
    ("U", 1): "B",
    ("U", 2): "H",
    ("U", 4): "I",
    ("U", 8): "Q",
    ("I", 1): "b",
    ("I", 2): "h",
    ("I", 4): "i",
    ("I", 8): "q",
}


@dataclass(frozen=True)
class Field:
    """One field: ``rows[i]`` holds point i's ``count`` values."""

    name: str
    kind: str
    size: int
    rows: tuple[tuple[Number, ...], ...]
    count: int = 1

    def pack(self, row: int) -> bytes:
        """Bytes of one point."""
        return struct.pack(f"<{self.count}{CODES[self.kind, self.size]}", *self.rows[row])


def column(name: str, type_name: str, values: Sequence[Number]) -> Field:
    """Return a field of one value per point; ``type_name`` like ``F4``."""
    return Field(name, type_name[0], int(type_name[1:]), tuple((value,) for value in values))


def header(
    fields: Sequence[Field],
    encoding: str,
    *,
    change: dict[str, str | None] | None = None,
    order: Sequence[str] | None = None,
    newline: str = "\n",
) -> bytes:
    """Return the header; ``change`` replaces a line's text after the key, None leaves the line out."""
    points = len(fields[0].rows)
    lines: dict[str, str | None] = {
        "VERSION": "0.7",
        "FIELDS": " ".join(field.name for field in fields),
        "SIZE": " ".join(str(field.size) for field in fields),
        "TYPE": " ".join(field.kind for field in fields),
        "COUNT": " ".join(str(field.count) for field in fields),
        "WIDTH": str(points),
        "HEIGHT": "1",
        "VIEWPOINT": "0 0 0 1 0 0 0",
        "POINTS": str(points),
    }
    lines.update(change or {})
    data = lines.pop("DATA", encoding)
    keys = list(order or lines)
    text = ["# .PCD v0.7 - Point Cloud Data file format"]
    text += [f"{key} {lines[key]}" for key in keys if lines[key] is not None]
    if data is not None:
        text.append(f"DATA {data}")
    return "".join(line + newline for line in text).encode("latin-1")


def body(fields: Sequence[Field], encoding: str, *, newline: str = "\n") -> bytes:
    """Return the points in one of the three encodings; ``binary_compressed`` leaves padding out."""
    points = range(len(fields[0].rows))
    if encoding == "binary":
        return b"".join(field.pack(row) for row in points for field in fields)
    if encoding == "ascii":
        return "".join(
            " ".join(repr(value) for field in fields for value in field.rows[row]) + newline for row in points
        ).encode()
    plain = b"".join(field.pack(row) for field in fields if field.name != "_" for row in points)
    packed = lzf_encode(plain)
    return struct.pack("<II", len(packed), len(plain)) + packed if plain else b""


def pcd(
    fields: Sequence[Field],
    encoding: str,
    *,
    change: dict[str, str | None] | None = None,
    order: Sequence[str] | None = None,
    newline: str = "\n",
) -> bytes:
    """Return a whole file."""
    return header(fields, encoding, change=change, order=order, newline=newline) + body(
        fields, encoding, newline=newline
    )


def lzf_encode(data: bytes) -> bytes:
    """Greedy LZF with back references of 3 bytes and more, straight from the format's description."""
    out = bytearray()
    literals = bytearray()
    seen: dict[bytes, int] = {}
    at = 0

    def flush() -> None:
        for start in range(0, len(literals), 32):
            run = literals[start : start + 32]
            out.append(len(run) - 1)
            out.extend(run)
        literals.clear()

    while at < len(data):
        back = seen.get(data[at : at + 3], -1)
        if len(data) - at >= 3 and back >= 0 and at - back <= 8192:
            length = 3
            while length < 264 and at + length < len(data) and data[back + length] == data[at + length]:
                length += 1
            flush()
            offset = at - back - 1
            if length < 9:
                out.append((length - 2) << 5 | offset >> 8)
            else:
                out.append(7 << 5 | offset >> 8)
                out.append(length - 9)
            out.append(offset & 255)
        else:
            length = 1
            literals.append(data[at])
        for step in range(length):
            seen[data[at + step : at + step + 3]] = at + step
        at += length
    flush()
    return bytes(out)


def lzf_decode(data: bytes) -> bytes:
    """Decode LZF one byte at a time; ValueError or IndexError for a bad stream."""
    out = bytearray()
    at = 0
    while at < len(data):
        control = data[at]
        at += 1
        if control < 32:
            run = data[at : at + control + 1]
            if len(run) != control + 1:
                raise ValueError("literal run cut off")
            out += run
            at += control + 1
            continue
        length = control >> 5
        if length == 7:
            length += data[at]
            at += 1
        back = len(out) - ((control & 31) << 8) - data[at] - 1
        at += 1
        if back < 0:
            raise ValueError("reference before the start")
        for step in range(length + 2):
            out.append(out[back + step])
    return bytes(out)
