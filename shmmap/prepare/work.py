# SPDX-License-Identifier: Apache-2.0
"""What the preparing process and its workers say to each other: one packet, one message."""

from __future__ import annotations

from typing import Final, TypeAlias

import msgspec

from shmmap.layers.derive import Neighbour
from shmmap.segment.source import Source

__all__ = ["CellDone", "CellWork", "FromWorker", "LayerDone", "Ready", "decode_done", "decode_work", "encode"]


class CellWork(msgspec.Struct, array_like=True, tag="cell"):
    """Prepare these layers of a cell; ``around`` are, for each layer, the cells it looks into.

    ``recognise``: the cache may hold them under other states of the same files.
    """

    number: int
    cell_id: str
    source: Source
    box: tuple[float, float, float, float]
    frame_id: str
    layers: tuple[str, ...]
    around: tuple[tuple[Neighbour, ...], ...]
    recognise: bool


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
_work: Final[msgspec.msgpack.Decoder[CellWork]] = msgspec.msgpack.Decoder(CellWork)
_done: Final[msgspec.msgpack.Decoder[FromWorker]] = msgspec.msgpack.Decoder(FromWorker)


def decode_work(data: bytes) -> CellWork:
    """Return the message for a worker."""
    return _work.decode(data)


def decode_done(data: bytes) -> FromWorker:
    """Return a worker's message."""
    return _done.decode(data)
