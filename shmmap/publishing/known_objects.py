# SPDX-License-Identifier: Apache-2.0
"""The objects that the current version has, by what is in them: those are not sent again.

A table in a file, which all workers map: of a million cells it has some 100 MB.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap.origin.remote.published_index import LayerObjects
from shmmap.origin.remote.published_object import ObjectName

__all__ = ["KnownObjects", "write_known_objects"]

_ROW: Final = np.dtype([("content", "S32"), ("sha256", "V32"), ("size", "<u4"), ("raw", "<u4")])


def write_known_objects(path: str | os.PathLike[str], layers: Iterable[LayerObjects]) -> int:
    """Write the table of these objects, ascending by their content; returns how many they are."""
    parts: list[NDArray[Any]] = []
    for layer in layers:
        rows = np.empty(len(layer.sizes), _ROW)
        rows["content"] = np.ascontiguousarray(layer.contents).view("S32")[:, 0]
        rows["sha256"] = np.ascontiguousarray(layer.hashes).view("V32")[:, 0]
        rows["size"], rows["raw"] = layer.sizes, layer.raws
        parts.append(rows)
    table = np.concatenate(parts) if parts else np.empty(0, _ROW)
    table = table[np.argsort(table["content"], kind="stable")]
    table.tofile(path)
    return len(table)


class KnownObjects:
    """The table in a file; an empty path has none."""

    def __init__(self, path: str) -> None:
        empty = not path or not os.path.getsize(path)
        self._table: NDArray[Any] = np.empty(0, _ROW) if empty else np.memmap(path, _ROW, mode="r")

    def find(self, content: bytes) -> ObjectName | None:
        """Return the object of a content digest; None if there is none."""
        at = int(np.searchsorted(self._table["content"], np.array(content, "S32")))
        if at == len(self._table):
            return None
        row = self._table[at]
        # numpy leaves out zero bytes at the end of a text
        if row["content"].ljust(32, b"\0") != content:
            return None
        return ObjectName(row["sha256"].tobytes(), int(row["size"]), int(row["raw"]), content)
