# SPDX-License-Identifier: Apache-2.0
"""Every reason for which a cloud file is refused, in one place.

`MapDataError.cause` of whatever this package raises is a key of `CAUSES`; programs may rely on the
names, people read the messages.
"""

from __future__ import annotations

from typing import Final

from shmmap.errors import MapDataError

__all__ = ["CAUSES", "refusal"]

CAUSES: Final[dict[str, str]] = {
    "missing": "there is no such file",
    "unreadable": "the operating system refuses to open or read it",
    "not_regular": "a directory, pipe or device, not a file",
    "empty_file": "no bytes at all",
    "zero_filled": "nothing but zero bytes, as after a power loss",
    "lfs_pointer": "a git-lfs pointer: the data was never fetched",
    "not_pcd": "something else than PCD",
    "bad_header": "the header contradicts itself or lacks a line",
    "bad_type": "a type of values that the format does not have",
    "no_xyz": "no usable x, y and z",
    "unknown_encoding": "an encoding that the format does not have",
    "too_many_points": "more points than the format can mean",
    "too_large": "more points than a layer is computed of",
    "changed": "the file changed while it was being read",
    "truncated": "the file ends before its data does",
    "bad_lzf": "the compressed block contradicts its sizes or cannot be decompressed",
    "bad_row": "a row has too few or many values, or one that is not a number of its type",
    "coordinate_range": "a 64-bit integer coordinate that float64 cannot hold exactly",
    "unsupported_format": "a file format that is not read",
    "not_metres": "coordinates in feet or another unit, and nothing that says to convert them",
    "bad_las": "a LAS or LAZ file that contradicts itself or cannot be decompressed",
}


def refusal(
    cause: str, message: str, *, path: str, offset: int | None = None, hint: str = ""
) -> MapDataError:
    """Return the error for ``cause`` (a key of `CAUSES`); the caller raises it."""
    if cause not in CAUSES:
        raise KeyError(cause)
    return MapDataError(message, path=path, offset=offset, cause=cause, hint=hint)
