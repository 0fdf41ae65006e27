# SPDX-License-Identifier: Apache-2.0
"""What the publishing process and its workers send each other: one packet, one message."""

from __future__ import annotations

from typing import Final, TypeAlias

import msgspec

from shmmap.layers.derive import Neighbour
from shmmap.prepare.work import Ready
from shmmap.segment.source import Source

__all__ = [
    "CellSent",
    "CellToSend",
    "LayerSent",
    "NotSent",
    "PublishSettings",
    "decode_sent",
    "decode_settings",
    "decode_task",
    "encode",
]


class PublishSettings(msgspec.Struct, array_like=True):
    """What all workers of a run need.

    Attributes
    ----------
    known
        File with the objects of the version before, see `shmmap.publishing.known_objects`; empty: none.
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


class CellToSend(msgspec.Struct, array_like=True, tag="cell"):
    """Publish these layers of a cell; ``around`` are, for each layer, the cells it looks into."""

    number: int
    cell_id: str
    source: Source
    box: tuple[float, float, float, float]
    frame_id: str
    layers: tuple[str, ...]
    around: tuple[tuple[Neighbour, ...], ...]


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

encode: Final = msgspec.msgpack.Encoder().encode
_settings: Final[msgspec.json.Decoder[PublishSettings]] = msgspec.json.Decoder(PublishSettings)
_task: Final[msgspec.msgpack.Decoder[CellToSend]] = msgspec.msgpack.Decoder(CellToSend)
_sent: Final[msgspec.msgpack.Decoder[FromWorker]] = msgspec.msgpack.Decoder(FromWorker)


def decode_settings(text: str) -> PublishSettings:
    """Read a worker's argument."""
    return _settings.decode(text)


def decode_task(data: bytes) -> CellToSend:
    """Read the message for a worker."""
    return _task.decode(data)


def decode_sent(data: bytes) -> FromWorker:
    """Read a worker's message."""
    return _sent.decode(data)
