# SPDX-License-Identifier: Apache-2.0
"""Data that a run and its publishing workers exchange: settings, messages, and a table of known objects.

The workers' tasks are `shmmap.prepare.task_pool.CellTask`.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from typing import Any, Final, TypeAlias

import msgspec
import numpy as np
from numpy.typing import NDArray

from shmmap.origin.remote.opened_store import open_store
from shmmap.origin.remote.published_index import LayerObjects
from shmmap.origin.remote.published_object import ObjectName
from shmmap.origin.remote.store import Store
from shmmap.prepare.task_pool import Ready

TASKS_AHEAD: Final = 8
"""Cells assigned to a worker at a time, so that finished cells are sent while the next one is made."""


class WorkerSettings(msgspec.Struct, array_like=True):
    """Settings of all workers: where the store and the cache of layers are; empty: no cache."""

    url: str
    insecure_http: bool = False
    instance_credentials: bool = False
    cache_dir: str = ""

    def open_store(self) -> Store:
        """Return the store, see `shmmap.origin.remote.opened_store.open_store`."""
        return open_store(
            self.url, insecure_http=self.insecure_http, instance_credentials=self.instance_credentials
        )


class PublishSettings(WorkerSettings):
    """Settings of all workers of a run; their cache may contain prepared layers.

    Attributes
    ----------
    known
        File with the objects of the version before, see `KnownObjects`; empty: none.
    is_first
        Whether to send every object without first checking whether the store has it.
    encoding
        One of `shmmap.origin.remote.published_index.ENCODINGS`; empty: that of the version before, or
        ``exact`` for the first version.
    """

    known: str = ""
    is_first: bool = False
    encoding: str = ""


class SliceSettings(WorkerSettings):
    """Settings of all workers of a slice; computed layers are kept in the cache.

    Attributes
    ----------
    cache_bytes
        Size limit of the cache in bytes; 0: no layers are kept.
    keep_points
        Keep fetched points there, too, because several cells need them.
    """

    cache_bytes: int = 0
    keep_points: bool = False


class LayerSent(msgspec.Struct, array_like=True):
    """One layer: its object, and the number of bytes sent; 0: the store had the object already."""

    sha256: bytes
    size: int
    raw: int
    content: bytes
    sent: int


class CellSent(msgspec.Struct, array_like=True, tag="sent"):
    """Message that the store has all layers of a cell; layers are in the order of the task.

    ``outside`` is the number of points outside the cell's box.
    """

    number: int
    points: int
    z_min: float
    z_max: float
    layers: tuple[LayerSent, ...]
    outside: int = 0


class NotSent(msgspec.Struct, array_like=True, tag="not_sent"):
    """Message that a cell was not sent: a layer cannot be made (``layer``), or the store refuses (empty)."""

    number: int
    layer: str
    code: str
    message: str
    hint: str


FromWorker: TypeAlias = CellSent | NotSent | Ready

_sent: Final[msgspec.msgpack.Decoder[FromWorker]] = msgspec.msgpack.Decoder(FromWorker)
decode_sent: Final = _sent.decode
"""Decodes a worker's message."""


_ROW: Final = np.dtype([("content", "S32"), ("sha256", "V32"), ("size", "<u4"), ("raw", "<u4")])


def write_known_objects(path: str | os.PathLike[str], layers: Iterable[LayerObjects]) -> int:
    """Write the table of these objects, ascending by content digest, and return their number."""
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
    """Table of known objects in a file; with an empty path, an empty table."""

    def __init__(self, path: str) -> None:
        empty = not path or not os.path.getsize(path)
        self._table: NDArray[Any] = np.empty(0, _ROW) if empty else np.memmap(path, _ROW, mode="r")

    def find(self, content: bytes) -> ObjectName | None:
        """Return the object of a content digest; None if there is none."""
        at = int(np.searchsorted(self._table["content"], np.array(content, "S32")))
        if at == len(self._table):
            return None
        row = self._table[at]
        # numpy drops trailing zero bytes of a text
        if row["content"].ljust(32, b"\0") != content:
            return None
        return ObjectName(row["sha256"].tobytes(), int(row["size"]), int(row["raw"]), content)
