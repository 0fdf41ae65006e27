# SPDX-License-Identifier: Apache-2.0
"""Messages to and from publishing workers; their tasks are `shmmap.prepare.task_pool.CellTask`."""

from __future__ import annotations

from typing import Final, TypeAlias

import msgspec

from shmmap.prepare.task_pool import Ready

__all__ = [
    "CellSent",
    "LayerSent",
    "NotSent",
    "PublishSettings",
    "SliceSettings",
    "decode_sent",
    "decode_settings",
    "decode_slice_settings",
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

_settings: Final[msgspec.json.Decoder[PublishSettings]] = msgspec.json.Decoder(PublishSettings)
_slice_settings: Final[msgspec.json.Decoder[SliceSettings]] = msgspec.json.Decoder(SliceSettings)
_sent: Final[msgspec.msgpack.Decoder[FromWorker]] = msgspec.msgpack.Decoder(FromWorker)


def decode_settings(text: str) -> PublishSettings:
    """Read a worker's argument."""
    return _settings.decode(text)


def decode_slice_settings(text: str) -> SliceSettings:
    """Read the argument of a slice's worker."""
    return _slice_settings.decode(text)


def decode_sent(data: bytes) -> FromWorker:
    """Read a worker's message."""
    return _sent.decode(data)
