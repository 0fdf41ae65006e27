# SPDX-License-Identifier: Apache-2.0
"""JSON output of ``shmmap live``; imported only for ``--json``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Final

import msgspec

from shmmap.cli.json_output import LiveMap, more_of

if TYPE_CHECKING:
    from shmmap.client.live.chunk_reader import ChunkInfo

TOTALS: Final = ("bytes", "active", "occupied", "free")


class LiveMaps(msgspec.Struct):
    """The live maps of a daemon."""

    maps: list[LiveMap]


class Chunk(msgspec.Struct):
    """A chunk of a live map."""

    key: tuple[int, int, int]
    state: str
    active: int
    occupied: int
    free: int
    bytes: int
    version: int
    generation: int
    box: Annotated[
        tuple[float, float, float, float, float, float],
        msgspec.Meta(description="min x, y, z, max x, y, z: metres"),
    ]

    @classmethod
    def of(cls, chunk: ChunkInfo, resolution: float) -> Chunk:
        """Return the JSON form of a chunk."""
        return cls(
            (chunk.key.x, chunk.key.y, chunk.key.z),
            chunk.state,
            chunk.active,
            chunk.occupied,
            chunk.free,
            chunk.bytes,
            chunk.version,
            chunk.generation,
            chunk.key.box(resolution),
        )


class ShownMap(msgspec.Struct):
    """A live map and its chunks."""

    map: LiveMap
    chunks: list[Chunk]


class Saved(msgspec.Struct):
    """The result of saving a live map."""

    map: str
    files: Annotated[int, msgspec.Meta(description="chunks on disk")]
    seconds: float


def checked_kind() -> object:
    """Return the struct that ``fsck --json`` prints; its totals count sound chunks only."""
    from shmmap.live_worker.disk.maintenance import CheckedMap

    kind = more_of(CheckedMap, good=bool, chunks=int, **dict.fromkeys(TOTALS, int))
    return msgspec.defstruct(
        "CheckedMap", [(f.name, f.type) for f in msgspec.structs.fields(kind) if f.name != "rows"]
    )


def exported_kind() -> object:
    """Return the struct that ``export --json`` prints."""
    from shmmap.live_worker.disk.exporting import ExportedVoxels

    return more_of(ExportedVoxels, seconds=float)


def reset_kind() -> object:
    """Return the struct that ``reset --json`` prints."""
    from shmmap.live_worker.disk.maintenance import ResetMap

    return ResetMap
