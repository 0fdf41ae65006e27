# SPDX-License-Identifier: Apache-2.0
"""PLY files made by hand, of any shape that the format allows, from a seed."""

from __future__ import annotations

import random
import struct

__all__ = ["TYPES", "random_ply"]

TYPES = {
    "char": "b", "int8": "b", "uchar": "B", "uint8": "B", "short": "h", "int16": "h", "ushort": "H",
    "uint16": "H", "int": "i", "int32": "i", "uint": "I", "uint32": "I", "float": "f", "float32": "f",
    "double": "d", "float64": "d",
}  # fmt: skip
COUNTERS = ("uchar", "uint8", "ushort", "int", "uint", "char", "short")
NAMES = (
    "nx", "ny", "nz", "red", "green", "blue", "alpha", "intensity", "ring", "gps_time", "confidence",
    "scalar_Intensity", "f_dc_0", "label",
)  # fmt: skip
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
