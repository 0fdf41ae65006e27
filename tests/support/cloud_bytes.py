# SPDX-License-Identifier: Apache-2.0
"""PCD and PLY files byte by byte, from Python numbers and `struct`, without shmmap; LAS files by laspy."""

from __future__ import annotations

import random
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import laspy
import numpy as np
from numpy.typing import NDArray

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


# PLY files made by hand, of any shape that the format allows, from a seed


TYPES = {
    "char": "b",
    "int8": "b",
    "uchar": "B",
    "uint8": "B",
    "short": "h",
    "int16": "h",
    "ushort": "H",
    "uint16": "H",
    "int": "i",
    "int32": "i",
    "uint": "I",
    "uint32": "I",
    "float": "f",
    "float32": "f",
    "double": "d",
    "float64": "d",
}
COUNTERS = ("uchar", "uint8", "ushort", "int", "uint", "char", "short")
NAMES = (
    "nx",
    "ny",
    "nz",
    "red",
    "green",
    "blue",
    "alpha",
    "intensity",
    "ring",
    "gps_time",
    "confidence",
    "scalar_Intensity",
    "f_dc_0",
    "label",
)
COMMENTS = ("comment made by hand", "comment", "comment end_header is not here")

Property = tuple[str, str, str]  # name, type, type of a list's counter or ""


def random_ply(rng: random.Random, *, rows: int | None = None) -> bytes:
    """Return a PLY file: any types, order, encoding, extra elements, lists, comments and line ends."""
    encoding = rng.choice(("ascii", "binary_little_endian", "binary_big_endian"))
    newline = rng.choice(("\n", "\n", "\r\n"))
    count = rng.choice((0, 1, 2, 7, 40)) if rows is None else rows
    elements = [
        (name, rng.choice((0, 1, 5)), _properties(rng, rng.randint(1, 4), lists=0.5))
        for name in rng.sample(("camera", "face", "range_grid", "material"), rng.choice((0, 0, 1, 2)))
    ]
    elements.insert(rng.randint(0, len(elements)), ("vertex", count, _vertex(rng)))
    lines = [
        "ply",
        f"format {encoding} 1.0",
        *rng.sample(("obj_info num_cols 12", "comment x"), rng.choice((0, 1))),
    ]
    body = b""
    for name, number, properties in elements:
        lines += rng.sample(COMMENTS, rng.choice((0, 0, 1, 2)))
        lines.append(f"element {name} {number}")
        for word, kind, counter in properties:
            lines.append(f"property list {counter} {kind} {word}" if counter else f"property {kind} {word}")
            lines += rng.sample(COMMENTS, rng.choice((0, 0, 0, 1)))
        for _ in range(number):
            body += _row(rng, properties, encoding, newline)
    return newline.join([*lines, "end_header", ""]).encode() + body


def _properties(rng: random.Random, number: int, lists: float) -> list[Property]:
    return [
        (name, rng.choice(list(TYPES)), rng.choice(COUNTERS) if rng.random() < lists else "")
        for name in rng.sample(NAMES, number)
    ]


def _vertex(rng: random.Random) -> list[Property]:
    """Axes of one type, or of three; other properties before, between and after them."""
    kinds = list(TYPES)
    if rng.random() < 0.5:
        kinds = [rng.choice(kinds)]
    properties = [(axis, rng.choice(kinds), "") for axis in "xyz"]
    if rng.random() < 0.3:
        rng.shuffle(properties)
    for extra in _properties(rng, rng.randint(0, 6), lists=rng.choice((0.0, 0.0, 0.3))):
        properties.insert(rng.randint(0, len(properties)), extra)
    return properties


def _row(rng: random.Random, properties: list[Property], encoding: str, newline: str) -> bytes:
    values: list[tuple[str, float]] = []
    for _, kind, counter in properties:
        items = rng.choice((0, 1, 3, 4)) if counter else 1
        if counter:
            values.append((counter, items))
        values += [(kind, _value(rng, kind)) for _ in range(items)]
    if encoding == "ascii":
        return " ".join(repr(value) for _, value in values).encode() + newline.encode()
    order = "<" if "little" in encoding else ">"
    return b"".join(struct.pack(order + TYPES[kind], value) for kind, value in values)


def _value(rng: random.Random, kind: str) -> float:
    code = TYPES[kind]
    if code in "fd":
        value = rng.choice((0.0, -0.0, rng.uniform(-1e3, 1e3), rng.uniform(4e6, 6e6), 1e-30))
        return struct.unpack("<f", struct.pack("<f", value))[0] if code == "f" else value
    bits = 8 * struct.calcsize(code)
    low, high = (-(1 << bits - 1), (1 << bits - 1) - 1) if code.islower() else (0, (1 << bits) - 1)
    return rng.choice((low, high, 0, rng.randint(low, high)))


# LAS and LAZ files made by laspy


POINTS = 1000


def write_las(
    path: Path,
    columns: dict[str, NDArray[Any]],
    *,
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0),
    point_format: int = 6,
) -> laspy.LasData:
    """Write x, y, z at a millimetre and intensity; other columns become extra dimensions."""
    header = laspy.LasHeader(point_format=point_format, version="1.4" if point_format >= 6 else "1.2")
    header.scales, header.offsets = np.full(3, 0.001), np.array(offset)
    extra = [name for name in columns if name not in ("x", "y", "z", "intensity")]
    header.add_extra_dims([laspy.ExtraBytesParams(name, columns[name].dtype) for name in extra])
    las = laspy.LasData(header)
    las.x, las.y, las.z = (columns[axis].astype(np.float64) for axis in "xyz")
    las.intensity = columns["intensity"].astype(np.uint16)
    for name in extra:
        las[name] = columns[name]
    las.write(str(path))
    return las


def las_file(path: Path, *, version: str = "1.4", form: int = 6, points: int = POINTS) -> Path:
    """Write points on a line, 0.1 m apart."""
    header = laspy.LasHeader(point_format=form, version=version)
    header.scales = np.full(3, 0.01)
    las = laspy.LasData(header)
    las.x = las.y = las.z = np.arange(points) * 0.1
    las.write(str(path))
    return path


def patched(path: Path, at: int, code: str, *values: float) -> Path:
    """Write values over a file's bytes."""
    data = bytearray(path.read_bytes())
    struct.pack_into("<" + code, data, at, *values)
    path.write_bytes(bytes(data))
    return path
