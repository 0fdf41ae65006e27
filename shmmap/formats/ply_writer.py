# SPDX-License-Identifier: Apache-2.0
"""Write a cloud's columns as a binary PLY file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import IO, Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap.errors import BadRequest
from shmmap.formats.ply_header import ply_header

_PARTS: Final[dict[str, tuple[str, ...]]] = {"xyz": ("x", "y", "z"), "normal": ("nx", "ny", "nz")}
"""Properties that other programs know by these names."""
_BLOCK_ROWS: Final = 1 << 16


def write_ply(file: IO[bytes], columns: Mapping[str, NDArray[Any]]) -> None:
    """Write columns of equal length into a file, ``xyz`` (N, 3) among them.

    A column of k values per point becomes k properties, ``name_0`` and so on.

    Raises
    ------
    BadRequest
        There is no ``xyz``, or PLY lacks a type.
    """
    if "xyz" not in columns:
        raise BadRequest("a PLY file needs a column xyz")
    fields: list[tuple[str, NDArray[Any]]] = []
    for name, values in columns.items():
        flat = values.reshape(len(values), -1)
        count = flat.shape[1]
        names = _PARTS.get(name, ()) if count == 3 else ()
        names = names or ((name,) if count == 1 else tuple(f"{name}_{i}" for i in range(count)))
        fields += [(part, flat[:, i]) for i, part in enumerate(names)]
    points = len(columns["xyz"])
    file.write(ply_header([(name, values.dtype) for name, values in fields], points, comment="by shmmap"))
    rows = np.empty(
        min(points, _BLOCK_ROWS),
        np.dtype([(name, values.dtype.newbyteorder("<")) for name, values in fields]),
    )
    for begin in range(0, points, _BLOCK_ROWS):
        block = rows[: min(_BLOCK_ROWS, points - begin)]
        for name, values in fields:
            block[name] = values[begin : begin + len(block)]
        file.write(block.view(np.uint8).data)
