# SPDX-License-Identifier: Apache-2.0
"""What the preparing process and its workers say to each other: one packet, one message.

Publishing gives its workers the same tasks.
"""

from __future__ import annotations

from typing import Final, TypeAlias

import msgspec

from shmmap.layers.derive import Neighbour
from shmmap.segment.source import Source

__all__ = ["CellDone", "CellTask", "FromWorker", "LayerDone", "Ready", "decode_done", "decode_task", "encode"]


class CellTask(msgspec.Struct, array_like=True, tag="cell"):
    """Make these layers of a cell; ``around`` are, for each layer, the cells it looks into."""

    number: int
    cell_id: str
    source: Source
    box: tuple[float, float, float, float]
    frame_id: str
    layers: tuple[str, ...]
    around: tuple[tuple[Neighbour, ...], ...]


class LayerDone(msgspec.Struct, array_like=True):
    """One layer: ``how`` is kept (it was there), recognised, built or failed."""

    layer: str
    how: str
    bytes: int = 0
    message: str = ""


class CellDone(msgspec.Struct, array_like=True, tag="done"):
    """A cell is done, layer by layer."""

    number: int
    layers: tuple[LayerDone, ...]


class Ready(msgspec.Struct, array_like=True, tag="ready"):
    """The worker has started."""


FromWorker: TypeAlias = CellDone | Ready

encode: Final = msgspec.msgpack.Encoder().encode
_task: Final[msgspec.msgpack.Decoder[CellTask]] = msgspec.msgpack.Decoder(CellTask)
_done: Final[msgspec.msgpack.Decoder[FromWorker]] = msgspec.msgpack.Decoder(FromWorker)


def decode_task(data: bytes) -> CellTask:
    """Return the message for a worker."""
    return _task.decode(data)


def decode_done(data: bytes) -> FromWorker:
    """Return a worker's message."""
    return _done.decode(data)
