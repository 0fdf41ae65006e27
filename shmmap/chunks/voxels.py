# SPDX-License-Identifier: Apache-2.0
"""Indexing of voxels: a point's voxel, a voxel's chunk, and its place in the chunk.

A voxel is identified by three integers, ``floor(x * (1 / resolution))`` along each axis, computed in double
precision (as Bonxai's ``VoxelGrid::posToCoord``).  A *chunk* is a cube of 64 voxels a side; its key is the
voxel's index shifted right by 6 bits, which is the same for negative indices.  A chunk consists of *bricks*
of 8 x 8 x 4 voxels, and a brick of four *words* of 8 x 8 x 1: the unit of marks.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

import numpy as np

from shmmap.errors import BadRequest

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Indices: TypeAlias = NDArray[np.int32]

CHUNK_SHIFT: Final = 6
CHUNK_SIDE: Final = 1 << CHUNK_SHIFT
"""Voxels along each edge of a chunk."""
BRICK_VOXELS: Final = 256
"""Voxels of a brick: 8 x 8 x 4, along x, y and z."""
BRICKS: Final = 1024
"""Bricks of a chunk: 8 x 8 x 16."""
CHUNK_VOXELS: Final = BRICKS * BRICK_VOXELS
WORDS: Final = CHUNK_VOXELS // 64
"""Words of a chunk: 64 voxels of equal z each, x fastest."""
FURTHEST_INDEX: Final = 1 << 30
"""Voxel indices are at least minus this and less than this: half of the range of chunk keys."""
FURTHEST_SENSOR: Final = FURTHEST_INDEX // 2
"""Bound of sensors' and readers' indices, so that the voxels that they see have indices, too."""


class ChunkKey(NamedTuple):
    """Key of a chunk: its voxels' indices shifted right by 6 bits."""

    x: int
    y: int
    z: int

    @property
    def text(self) -> str:
        """The key as in the names of segments and files: ``3_-1_0``."""
        return f"{self.x}_{self.y}_{self.z}"

    @classmethod
    def from_text(cls, text: str) -> ChunkKey:
        """Inverse of `text`.

        Raises
        ------
        BadRequest
            The text is not three integers in the form of `text`.
        """
        try:
            x, y, z = map(int, text.split("_"))
            key = cls(x, y, z)
            if key.text == text and key.possible:
                return key
        except ValueError:
            pass
        raise BadRequest(f"{text!r} is not the key of a chunk", hint="a key is three whole numbers: 3_-1_0")

    @property
    def possible(self) -> bool:
        """Whether the chunk lies within the range of voxel indices."""
        most = FURTHEST_INDEX >> CHUNK_SHIFT
        return all(-most <= part < most for part in self)

    @property
    def first_voxel(self) -> tuple[int, int, int]:
        """Index of the chunk's lowest voxel."""
        return self.x << CHUNK_SHIFT, self.y << CHUNK_SHIFT, self.z << CHUNK_SHIFT

    def box(self, resolution: float) -> tuple[float, float, float, float, float, float]:
        """Return the bounds (min_x, min_y, min_z, max_x, max_y, max_z), metres."""
        low = [part * CHUNK_SIDE * resolution for part in self]
        high = [(part + 1) * CHUNK_SIDE * resolution for part in self]
        return low[0], low[1], low[2], high[0], high[1], high[2]

    def distance(self, other: ChunkKey) -> int:
        """Return the distance to another chunk along the longest axis: 1 for each of the 26 neighbours."""
        return max(abs(a - b) for a, b in zip(self, other, strict=True))


def _table(values: list[int]) -> Indices:
    table = np.array(values, dtype=np.int32)
    table.flags.writeable = False
    return table


PLACE_X: Final = _table([(x >> 3) * BRICK_VOXELS + (x & 7) for x in range(CHUNK_SIDE)])
PLACE_Y: Final = _table([(y >> 3) * 8 * BRICK_VOXELS + (y & 7) * 8 for y in range(CHUNK_SIDE)])
PLACE_Z: Final = _table([(z >> 2) * 64 * BRICK_VOXELS + (z & 3) * 64 for z in range(CHUNK_SIDE)])
"""A voxel's place in its chunk is the sum of three entries: brick by brick, x fastest, then y, z."""


def voxel_indices(xyz: NDArray[np.floating], resolution: float) -> Indices:
    """Return the indices, (N, 3), of the voxels that contain points, (N, 3) metres.

    Raises
    ------
    BadRequest
        A coordinate is not finite, or outside the range of indices.
    """
    scaled = np.floor(np.asarray(xyz, dtype=np.float64) * (1.0 / resolution))
    if not (np.abs(scaled + 0.5) < FURTHEST_INDEX).all():  # also false for NaN
        reach = FURTHEST_INDEX * resolution
        raise BadRequest(f"a point is not finite, or further than {reach:.0f} m from the map's origin")
    return scaled.astype(np.int32)


def voxel_centers(indices: NDArray[np.integer], resolution: float) -> NDArray[np.float64]:
    """Return the centres of voxels, (N, 3) metres."""
    centers: NDArray[np.float64] = (np.asarray(indices, dtype=np.float64) + 0.5) * resolution
    return centers


def in_chunk(indices: Indices) -> tuple[Indices, Indices]:
    """Return the chunk keys of voxels, (N, 3), and their places in the chunks, (N,)."""
    low = indices & (CHUNK_SIDE - 1)
    places: Indices = PLACE_X[low[:, 0]] + PLACE_Y[low[:, 1]] + PLACE_Z[low[:, 2]]
    return indices >> CHUNK_SHIFT, places


def voxels_of(key: ChunkKey, places: NDArray[np.integer]) -> Indices:
    """Return the indices of voxels, (N, 3), at places in a chunk: the inverse of `in_chunk`."""
    brick, within = np.divmod(np.asarray(places, dtype=np.int64), BRICK_VOXELS)
    low = np.stack(
        [
            (brick & 7) * 8 + (within & 7),
            (brick >> 3 & 7) * 8 + (within >> 3 & 7),
            (brick >> 6) * 4 + (within >> 6),
        ],
        axis=-1,
    )
    indices: Indices = (low + np.array(key.first_voxel)).astype(np.int32)
    return indices
