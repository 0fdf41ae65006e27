# SPDX-License-Identifier: Apache-2.0
"""Write columns as a PCD file that the Point Cloud Library and all common readers accept."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from typing import IO, Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap.errors import BadRequest
from shmmap.formats.durable_file import appearing_file
from shmmap.formats.pcd import lzf
from shmmap.formats.pcd.fields import PADDING
from shmmap.formats.pcd.header import ENCODINGS, IDENTITY_VIEWPOINT

_BLOCK_POINTS: Final = 1 << 16
_LZF_LIMIT_BYTES: Final = (1 << 31) - 1  # limit of liblzf's int sizes; the file's own size words are uint32
_FORMATS: Final = {4: "%.9g", 8: "%.17g"}  # digits that restore the same bits


def write_pcd(
    target: str | os.PathLike[str] | IO[bytes],
    columns: Mapping[str, NDArray[Any]] | NDArray[Any],
    *,
    encoding: str = "binary",
    viewpoint: Sequence[float] = IDENTITY_VIEWPOINT,
) -> None:
    """Write ``columns`` as one unorganised cloud, PCD version 0.7.

    Parameters
    ----------
    target
        A path, or a binary file to write into.  A path is replaced atomically: the data goes to a
        temporary name beside it, is flushed to the disk, and then renamed.
    columns
        Arrays of equal length by name.  ``xyz`` of shape (N, 3) becomes the fields x, y and z; (N, k)
        becomes one field of COUNT k.  An array alone is ``xyz``.  The types are those of PCD: 8 to 64-bit
        integers, float32 and float64.
    encoding
        ``ascii``, ``binary`` or ``binary_compressed`` (at most 2 GiB of data).  All three keep every bit,
        except the payload of NaNs in ``ascii``.
    viewpoint
        Translation x y z (metres), then quaternion w x y z.

    Raises
    ------
    BadRequest
        If names, shapes or types cannot be expressed in PCD.
    OSError
        If the file cannot be written.
    """
    if encoding not in ENCODINGS:
        raise BadRequest(f"encoding {encoding!r} is not one of {', '.join(ENCODINGS)}")
    fields = _fields(columns if isinstance(columns, Mapping) else {"xyz": columns})
    points = len(fields[0][1]) if fields else 0
    described = [(name, array.dtype, _count(array)) for name, array in fields]
    header = pcd_header(described, points, encoding, viewpoint)
    body = {"ascii": _ascii, "binary": _binary, "binary_compressed": _compressed}[encoding]
    if isinstance(target, str | os.PathLike):
        with appearing_file(target) as file:
            _write(file, header, body(fields, points))
    else:
        _write(target, header, body(fields, points))


def _fields(columns: Mapping[str, NDArray[Any]]) -> list[tuple[str, NDArray[Any]]]:
    """Return (name, array) of every PCD field, checked: little-endian, row-major."""
    fields: list[tuple[str, NDArray[Any]]] = []
    for name, values in columns.items():
        array = np.asarray(values)
        if name == "xyz":
            if array.ndim != 2 or array.shape[1] != 3:
                raise BadRequest(f"column 'xyz' has shape {array.shape}, (N, 3) is needed")
            fields += [(axis, array[:, index]) for index, axis in enumerate("xyz")]
        else:
            if array.ndim not in (1, 2) or (array.ndim == 2 and not array.shape[1]):
                raise BadRequest(f"column {name!r} has shape {array.shape}, (N,) or (N, k) is needed")
            fields.append((name, array[:, 0] if array.ndim == 2 and array.shape[1] == 1 else array))
    names = [name for name, _ in fields]
    if not {"x", "y", "z"} <= set(names):
        raise BadRequest("a cloud needs a column 'xyz', or x, y and z")
    lengths = {name: len(array) for name, array in fields}
    if len(set(lengths.values())) != 1:
        raise BadRequest(f"columns of different lengths: {lengths}")
    for name, array in fields:
        if not name.isprintable() or not name or name == PADDING or len(name.split()) != 1 or " " in name:
            raise BadRequest(f"{name!r} cannot be the name of a PCD field")
        if names.count(name) != 1:
            raise BadRequest(f"two columns are called {name!r}")
        if array.dtype.kind not in "fiu" or array.dtype.itemsize not in (
            (4, 8) if array.dtype.kind == "f" else (1, 2, 4, 8)
        ):
            raise BadRequest(f"column {name!r} has type {array.dtype}, which PCD does not have")
    return [(name, array.astype(array.dtype.newbyteorder("<"), copy=False)) for name, array in fields]


def pcd_header(
    fields: Sequence[tuple[str, np.dtype[Any], int]],
    points: int,
    encoding: str,
    viewpoint: Sequence[float] = IDENTITY_VIEWPOINT,
    *,
    header_bytes: int = 0,
) -> bytes:
    """Return the header of a file with ``fields`` (name, dtype of one value, values per point).

    ``header_bytes`` pads the header to that length with spaces at the end of the comment line.  So it can be
    written in front of the points once their number is known.

    Raises
    ------
    BadRequest
        The viewpoint is invalid, there are too many points, or the header exceeds ``header_bytes``.
    """
    numbers = [float(number) for number in viewpoint]
    if len(numbers) != 7 or not np.isfinite(numbers).all():
        raise BadRequest(f"a viewpoint is 7 finite numbers, not {list(viewpoint)!r}")
    if points >= 1 << 32:
        raise BadRequest(f"{points} points do not fit a PCD file")
    comment = "# .PCD v0.7 - Point Cloud Data file format"
    lines = [
        "VERSION 0.7",
        "FIELDS " + " ".join(name for name, _, _ in fields),
        "SIZE " + " ".join(str(dtype.itemsize) for _, dtype, _ in fields),
        "TYPE " + " ".join(dtype.kind.upper() for _, dtype, _ in fields),
        "COUNT " + " ".join(str(count) for _, _, count in fields),
        f"WIDTH {points}",
        "HEIGHT 1",
        "VIEWPOINT " + " ".join(f"{number:.17g}" for number in numbers),
        f"POINTS {points}",
        f"DATA {encoding}",
    ]
    text = ("\n".join(lines) + "\n").encode()
    first = comment.ljust(header_bytes - len(text) - 1).encode() + b"\n"
    if header_bytes and len(first) + len(text) > header_bytes:
        raise BadRequest(f"the header needs {len(first) + len(text)} bytes, more than {header_bytes}")
    return first + text


def pcd_rows(rows: NDArray[np.void], encoding: str) -> bytes | memoryview:
    """Return packed ``rows`` (N,), one field per PCD field, as ``binary`` or ``ascii`` data."""
    if encoding == "binary":
        return rows.view(np.uint8).data
    return b"".join(_ascii([(name, rows[name]) for name in rows.dtype.names or ()], len(rows)))


def _count(array: NDArray[Any]) -> int:
    return 1 if array.ndim == 1 else int(array.shape[1])


def _binary(fields: list[tuple[str, NDArray[Any]]], points: int) -> Iterator[bytes]:
    record = np.dtype([(f"f{i}", array.dtype, array.shape[1:]) for i, (_, array) in enumerate(fields)])
    for start in range(0, points, _BLOCK_POINTS):
        block = np.empty(min(_BLOCK_POINTS, points - start), record)
        for i, (_, array) in enumerate(fields):
            block[f"f{i}"] = array[start : start + _BLOCK_POINTS]
        yield block.tobytes()


def _compressed(fields: list[tuple[str, NDArray[Any]]], points: int) -> Iterator[bytes]:
    size = sum(array.nbytes for _, array in fields)
    if size + size // lzf.LITERAL_RUN + 1 > _LZF_LIMIT_BYTES:
        raise BadRequest(f"{size} bytes do not fit one compressed block; write binary or divide the cloud")
    if points:
        packed = lzf.compress(b"".join(array.tobytes() for _, array in fields))
        yield np.array([len(packed), size], "<u4").tobytes()
        yield packed


def _ascii(fields: list[tuple[str, NDArray[Any]]], points: int) -> Iterator[bytes]:
    flat = [array if array.ndim == 2 else array[:, None] for _, array in fields]
    row = " ".join(
        "%d" if array.dtype.kind in "iu" else _FORMATS[array.dtype.itemsize]
        for array in flat
        for _ in range(array.shape[1])
    )
    for start in range(0, points, _BLOCK_POINTS):
        parts = [
            array[start : start + _BLOCK_POINTS, k].tolist() for array in flat for k in range(array.shape[1])
        ]
        yield "".join([row % values + "\n" for values in zip(*parts, strict=True)]).encode()


def _write(file: IO[bytes], header: bytes, body: Iterator[bytes]) -> None:
    file.write(header)
    for part in body:
        file.write(part)
