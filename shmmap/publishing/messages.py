# SPDX-License-Identifier: Apache-2.0
"""What a run and its publishing workers exchange: settings, messages, and a table of known objects.

Their tasks are `shmmap.prepare.task_pool.CellTask`.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from typing import Any, Final, TypeAlias

import msgspec
import numpy as np
from numpy.typing import NDArray

from shmmap.origin.remote.published_index import LayerObjects
from shmmap.origin.remote.published_object import ObjectName
from shmmap.prepare.task_pool import Ready

__all__ = [
    "TASKS_AHEAD",
    "CellSent",
    "KnownObjects",
    "LayerSent",
    "NotSent",
    "PublishSettings",
    "SliceSettings",
    "decode_sent",
    "write_known_objects",
]


TASKS_AHEAD: Final = 8
"""Cells that a worker has at a time: as many are sent while the next is made."""


class PublishSettings(msgspec.Struct, array_like=True):
    """What all workers of a run need.

    Attributes
    ----------
    known
        File with the objects of the version before, see `shmmap.publishing.messages`; empty: none.
    is_first
        Nothing was ever sent there: no object is looked for.
    cache_dir
        Where prepared layers may lie; empty: nowhere.
    encoding
        One of `shmmap.origin.remote.published_index.ENCODINGS`; empty: that of the version before, at first
        ``exact``.
    """

    url: str
    insecure_http: bool = False
    instance_credentials: bool = False
    cache_dir: str = ""
    known: str = ""
    is_first: bool = False
    encoding: str = ""


class SliceSettings(msgspec.Struct, array_like=True):
    """What all workers of a slice need.

    Attributes
    ----------
    cache_dir, cache_bytes
        Where computed layers are kept, and at most how many bytes; 0: none are.
    keep_points
        Keep fetched points there, too: several cells need them.
    """

    url: str
    insecure_http: bool = False
    instance_credentials: bool = False
    cache_dir: str = ""
    cache_bytes: int = 0
    keep_points: bool = False


class LayerSent(msgspec.Struct, array_like=True):
    """One layer: its object, and how many bytes of it were sent; 0: it was there."""

    sha256: bytes
    size: int
    raw: int
    content: bytes
    sent: int


class CellSent(msgspec.Struct, array_like=True, tag="sent"):
    """All layers of a cell are there, in the order of the task."""

    number: int
    points: int
    z_min: float
    z_max: float
    layers: tuple[LayerSent, ...]


class NotSent(msgspec.Struct, array_like=True, tag="not_sent"):
    """A cell is not: a layer cannot be made (``layer`` is its spec), or the store refuses (empty)."""

    number: int
    layer: str
    code: str
    message: str
    hint: str


FromWorker: TypeAlias = CellSent | NotSent | Ready

_sent: Final[msgspec.msgpack.Decoder[FromWorker]] = msgspec.msgpack.Decoder(FromWorker)
decode_sent: Final = _sent.decode
"""Reads a worker's message."""


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
