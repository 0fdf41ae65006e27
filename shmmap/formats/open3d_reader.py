# SPDX-License-Identifier: Apache-2.0
"""PLY, PTS and the XYZ family through Open3D.

Open3D answers a file that it cannot read with an empty cloud, and a file that ends early with
memory that nothing was written to.  So what the file announces is checked here, before and after.
Open3D's own PCD reader is never used: it drops fields and aborts on ordinary files.
"""

from __future__ import annotations

import os
import re
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap.columns import column_names
from shmmap.formats.causes import refusal
from shmmap.formats.open3d_package import load_open3d
from shmmap.formats.source_file import open_regular

__all__ = ["OPEN3D_SUFFIXES", "read_with_open3d"]

OPEN3D_SUFFIXES: Final = (".ply", ".pts", ".xyz", ".xyzn", ".xyzrgb")
_HEADER_LIMIT_BYTES: Final = 1 << 16
_READ_BYTES: Final = 1 << 20
_NUMBER_CODES: Final = np.isin(np.arange(256), np.frombuffer(b"0123456789+-.eEnaifNAIFty \t\r\n", np.uint8))
_PLY_BYTES: Final = {
    **dict.fromkeys((b"char", b"uchar", b"int8", b"uint8"), 1),
    **dict.fromkeys((b"short", b"ushort", b"int16", b"uint16"), 2),
    **dict.fromkeys((b"int", b"uint", b"int32", b"uint32", b"float", b"float32"), 4),
    **dict.fromkeys((b"double", b"float64"), 8),
}
_POSITIONS: Final = "positions"
_NAMES: Final = {"intensities": "intensity"}


def read_with_open3d(path: str, suffix: str) -> tuple[dict[str, NDArray[Any]], tuple[str, ...]]:
    """Read a cloud; ``suffix`` is one of `OPEN3D_SUFFIXES`.

    Returns
    -------
    Columns, ``xyz`` first (float64 from text files, the file's type from PLY), and warnings.

    Raises
    ------
    MapDataError
        If the file is missing, cut off or not of its format.
    ShmmapError
        If Open3D cannot be loaded.
    """
    try:
        with open(open_regular(path), "rb") as file:
            expected = _ply_points(file.read(_HEADER_LIMIT_BYTES), path) if suffix == ".ply" else None
        if suffix != ".ply":
            expected = _text_points(path, counted=suffix == ".pts")
    except OSError as error:
        raise refusal("unreadable", f"cannot be read: {error.strerror}", path=path) from error
    if expected == 0:
        return {"xyz": np.empty((0, 3), np.float32)}, ()
    columns = _load(path, suffix)
    found = len(columns.get("xyz", ()))
    if found != expected:
        raise refusal("bad_cloud", f"{expected} points expected, Open3D reads {found}", path=path)
    dropped = [name for name, values in columns.items() if len(values) != found]
    for name in dropped:
        del columns[name]
    return columns, tuple(f"{name!r} is not one value per point: left out" for name in dropped)


def _load(path: str, suffix: str) -> dict[str, NDArray[Any]]:
    o3d = load_open3d(f"{path}: {suffix[1:].upper()}", instead="or convert the file to PCD or LAS")
    # Open3D 0.18 takes no Path, and a str only where it is UTF-8; the stubs of 0.20 know nothing of bytes
    encoded: Any = os.fsencode(path)
    try:
        with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
            tensors = o3d.t.io.read_point_cloud(encoded).point
            given = sorted(set(tensors) - {_POSITIONS})
            names = column_names(_NAMES.get(name, name) for name in given)
            columns = {name: np.array(tensors[one].numpy()) for name, one in zip(names, given, strict=True)}
            if suffix != ".ply":  # the tensor reader rounds text to float32
                columns["xyz"] = np.array(o3d.io.read_point_cloud(encoded).points)
            elif _POSITIONS in tensors:
                columns["xyz"] = np.array(tensors[_POSITIONS].numpy())
    except RuntimeError as error:
        raise refusal(
            "bad_cloud", f"Open3D refuses it: {str(error).splitlines()[0][:200]}", path=path
        ) from error
    xyz = {"xyz": columns.pop("xyz")} if "xyz" in columns else {}
    return xyz | {
        name: values[:, 0] if values.ndim == 2 and values.shape[1] == 1 else values
        for name, values in columns.items()
        if values.ndim in (1, 2) and values.dtype.kind in "fiu"
    }


def _ply_points(head: bytes, path: str) -> int:
    """Check a PLY header against the file's size; returns the number of vertices."""
    end = re.search(rb"^end_header[ \t]*\r?\n", head, re.MULTILINE)
    if not head.startswith((b"ply\n", b"ply\r")) or end is None:
        raise refusal("bad_cloud", "no PLY header", path=path, offset=0)
    form, points, row_bytes, element = b"", -1, 0, b""
    for line in head[: end.start()].splitlines():
        words = line.split()
        if words[:1] == [b"format"] and len(words) > 1:
            form = words[1]
        elif words[:1] == [b"element"] and len(words) == 3 and words[2].isdigit() and len(words[2]) < 13:
            if element not in (b"", b"vertex") and words[1] == b"vertex":
                raise refusal("bad_cloud", "another element lies before the vertices", path=path)
            element = words[1]
            points = int(words[2]) if element == b"vertex" else points
        elif words[:1] == [b"property"] and element == b"vertex":
            if len(words) != 3 or words[1] not in _PLY_BYTES:
                raise refusal("bad_cloud", f"vertex property {line[:60]!r} cannot be read", path=path)
            row_bytes += _PLY_BYTES[words[1]]
    if points < 0 or not row_bytes:
        raise refusal("bad_cloud", "the PLY header announces no vertices", path=path, offset=0)
    if form.startswith(b"binary_"):
        left = os.stat(path).st_size - end.end()
        if points * row_bytes > left:
            raise refusal(
                "truncated", f"{points} vertices need {points * row_bytes} bytes, {left} are there", path=path
            )
    elif _count_lines(path, end.end()) < points:
        raise refusal("truncated", f"fewer than {points} lines of vertices", path=path)
    return points


def _text_points(path: str, *, counted: bool) -> int:
    """Number of points in a text file: its lines, or what its first line says."""
    lines = _count_lines(path, 0)
    if not counted:
        return lines
    with open(path, "rb") as file:
        first = file.readline(64).strip()
    if not first.isdigit():
        raise refusal("bad_cloud", "the first line is not the number of points", path=path, offset=0)
    if int(first) != lines - 1:
        raise refusal("truncated", f"{int(first)} points announced, {lines - 1} lines follow", path=path)
    return int(first)


def _count_lines(path: str, offset: int) -> int:
    """Count lines that are not blank; refuse what cannot be a table of numbers."""
    lines = 0
    blank = True
    with open(path, "rb") as file:
        file.seek(offset)
        while chunk := file.read(_READ_BYTES):
            codes = np.frombuffer(chunk, np.uint8)
            odd = np.flatnonzero(~_NUMBER_CODES[codes])
            if len(odd):
                at = file.tell() - len(chunk) + int(odd[0])
                raise refusal("bad_row", "not a table of numbers", path=path, offset=at)
            parts = chunk.split(b"\n")
            for part in parts[:-1]:
                lines += not (blank and not part.strip())
                blank = True
            blank = blank and not parts[-1].strip()
    return lines + (not blank)
