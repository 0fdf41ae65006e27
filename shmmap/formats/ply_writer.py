# SPDX-License-Identifier: Apache-2.0
"""The header of a PLY file whose vertices follow as packed little-endian rows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from shmmap.errors import BadRequest

__all__ = ["ply_header"]

_TYPES: Final = {
    "i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint", "f4": "float",
    "f8": "double",
}  # fmt: skip


def ply_header(
    fields: Sequence[tuple[str, np.dtype[Any]]], points: int, *, comment: str = "", header_bytes: int = 0
) -> bytes:
    """Return the header of a binary file with ``fields`` (name, dtype of one value).

    ``header_bytes`` asks for that length, got by spaces at the end of a comment: so a header can be written
    last, before points whose number was not known.

    Raises
    ------
    BadRequest
        PLY has no such type, or the header is longer than asked for.
    """
    types = [_TYPES.get(dtype.str.lstrip("<|")) for _, dtype in fields]
    if None in types:
        raise BadRequest(f"a PLY file cannot hold {', '.join(dtype.str for _, dtype in fields)}")
    first = "ply\nformat binary_little_endian 1.0\n" + f"comment {comment}"
    properties = (f"property {kind} {name}\n" for (name, _), kind in zip(fields, types, strict=True))
    rest = f"\nelement vertex {points}\n" + "".join(properties) + "end_header\n"
    if header_bytes and len(first) + len(rest) > header_bytes:
        raise BadRequest(f"the header needs {len(first) + len(rest)} bytes, more than {header_bytes}")
    return (first.ljust(header_bytes - len(rest)) + rest).encode("ascii")
