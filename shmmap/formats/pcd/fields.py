# SPDX-License-Identifier: Apache-2.0
"""Parse the FIELDS, SIZE, TYPE and COUNT lines of a PCD header: the values of a point."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np

__all__ = ["MAX_FIELDS", "MAX_POINT_BYTES", "PADDING", "FieldProblem", "PcdField", "parse_fields"]

MAX_FIELDS: Final = 1024
MAX_POINT_BYTES: Final = 1 << 20
MAX_NAME_BYTES: Final = 40  # bytes of a column's name in a segment
PADDING: Final = "_"
AXES: Final = ("x", "y", "z")

_DTYPES: Final[dict[tuple[bytes, bytes], np.dtype[np.generic]]] = {
    (kind.upper().encode(), str(size).encode()): np.dtype(f"<{kind}{size}")
    for kind, sizes in (("f", (4, 8)), ("u", (1, 2, 4, 8)), ("i", (1, 2, 4, 8)))
    for size in sizes
}


@dataclass(frozen=True, slots=True)
class PcdField:
    """One field of the header.

    Attributes
    ----------
    name
        Unique name: duplicates get a number, ``x``, ``y`` and ``z`` are in lower case.
    dtype
        Little-endian type of one value.
    count
        Values per point; 0 only for padding.
    padding
        True for fields named ``_``, whose bytes mean nothing.
    file_name
        The name in the file.
    """

    name: str
    dtype: np.dtype[np.generic]
    count: int
    padding: bool
    file_name: str

    @property
    def row_bytes(self) -> int:
        """Bytes of one point's values."""
        return self.dtype.itemsize * self.count


class FieldProblem(Exception):
    """Contradictory or invalid field lines: which line, why, and the error's cause."""

    def __init__(self, key: bytes, message: str, cause: str = "bad_header") -> None:
        super().__init__(message)
        self.key = key
        self.message = message
        self.cause = cause


@lru_cache(maxsize=64)  # cells of a map share these lines
def parse_fields(
    names: tuple[bytes, ...],
    sizes: tuple[bytes, ...],
    types: tuple[bytes, ...],
    counts: tuple[bytes, ...] | None,
) -> tuple[tuple[PcdField, ...], tuple[str, ...]]:
    """Combine the words of FIELDS, SIZE, TYPE and COUNT (None if missing: all 1).

    Returns
    -------
    The fields in file order, and warnings.

    Raises
    ------
    FieldProblem
        If the lines contradict each other, or there is no usable x, y and z.
    """
    if not 0 < len(names) <= MAX_FIELDS:
        raise FieldProblem(b"FIELDS", f"{len(names)} fields; 1 to {MAX_FIELDS} can be read")
    counts = (b"1",) * len(names) if counts is None else counts
    for key, words in ((b"SIZE", sizes), (b"TYPE", types), (b"COUNT", counts)):
        if len(words) != len(names):
            raise FieldProblem(key, f"{len(names)} FIELDS, but {len(words)} values in {key.decode()}")
    decoded = [_decode(name) for name in names]
    unique, warnings = _unique_names(decoded)
    fields = []
    for file_name, name, size, kind, count in zip(decoded, unique, sizes, types, counts, strict=True):
        dtype = _DTYPES.get((kind.upper(), size))
        if dtype is None:
            text = (kind[:8] + size[:8]).decode("latin-1")
            raise FieldProblem(
                b"TYPE", f"field {file_name!r} is of type {text!r}, which PCD does not have", "bad_type"
            )
        padding = file_name == PADDING
        fields.append(PcdField(name, dtype, _count(count, 0 if padding else 1), padding, file_name))
    _check_xyz(fields)
    point_bytes = sum(field.row_bytes for field in fields)
    if point_bytes > MAX_POINT_BYTES:
        raise FieldProblem(b"COUNT", f"a point of {point_bytes} bytes; the limit is {MAX_POINT_BYTES}")
    return tuple(fields), tuple(warnings)


def _decode(name: bytes) -> str:
    try:
        text = name.decode()
    except UnicodeDecodeError:
        text = name.decode("latin-1")
    if not text.isprintable():
        raise FieldProblem(b"FIELDS", f"field name {text[:40]!r} has unprintable characters")
    return text


def _count(word: bytes, low: int) -> int:
    if not word.isdigit() or len(word) > 9:
        raise FieldProblem(b"COUNT", f"COUNT {word[:40].decode('latin-1')!r} is not a number of values")
    if int(word) < low:
        raise FieldProblem(b"COUNT", f"COUNT {int(word)} for a field that is not padding")
    return int(word)


def _unique_names(names: list[str]) -> tuple[list[str], list[str]]:
    """Lower-case x, y and z, number duplicates, and cut names to the length that a segment can store.

    Returns
    -------
    One name per field, unique but for padding, and a warning for each change.
    """
    renamed, warnings = list(names), []
    for axis in AXES:
        if axis not in names and axis.upper() in names:
            renamed[names.index(axis.upper())] = axis
            warnings.append(f"field {axis.upper()!r} is taken as {axis!r}")
    original = set(renamed)
    taken = {"xyz"}  # name of the column that x, y and z form
    for index, name in enumerate(renamed):
        if name == PADDING:
            continue
        new = short = _cut(name, MAX_NAME_BYTES)
        number = 1
        while new in taken or (new != name and new in original):
            number += 1
            suffix = f"_{number}"
            new = _cut(short, MAX_NAME_BYTES - len(suffix)) + suffix
        taken.add(new)
        renamed[index] = new
        if new != name:
            warnings.append(f"field {name[:80]!r} renamed {new!r}: the name is in use or too long")
    return renamed, warnings


def _cut(name: str, limit_bytes: int) -> str:
    return name.encode()[:limit_bytes].decode(errors="ignore")


def _check_xyz(fields: list[PcdField]) -> None:
    counts = {field.name: field.count for field in fields if field.name in AXES}
    missing = [axis for axis in AXES if axis not in counts]
    if missing:
        raise FieldProblem(
            b"FIELDS", f"no field {', '.join(missing)}: not a cloud of points in space", "no_xyz"
        )
    if any(count != 1 for count in counts.values()):
        raise FieldProblem(b"COUNT", "x, y and z need COUNT 1", "no_xyz")
