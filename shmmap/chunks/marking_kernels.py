# SPDX-License-Identifier: Apache-2.0
"""Compiled: which voxels a scan hits and passes through.

Voxels are counted from the corner of a window of chunks around the sensor.  ``table`` says which slot of the
bit sets each chunk of the window has, -1 for none yet.  Both bit sets, (slots * 4096,), have a bit for each
voxel of each slot, by its place in the chunk.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numba import float32, float64, int32, int64, types, uint16, uint64

from shmmap.chunks.voxels import CHUNK_SHIFT, CHUNK_SIDE, PLACE_X, PLACE_Y, PLACE_Z, WORDS
from shmmap.compiling import compiled, inlined, read_only

__all__ = ["NO_SLOTS", "clear", "count_words", "mark_ends", "mark_rays", "write_words"]

NO_SLOTS: Final = -1
_ONE: Final = np.uint64(1)
_LOW: Final = CHUNK_SIDE - 1
_SHIFT: Final = CHUNK_SHIFT


@inlined
def _slot(table: Any, used: Any, chunk: Any, most: Any) -> Any:
    """The slot of a chunk, a new one if it has none; -1 if there is none left."""
    slot = table[chunk]
    if slot < 0 and used[0] < most:
        slot = used[0]
        used[slot + 1] = chunk
        used[0] = slot + 1
        table[chunk] = slot
    return slot


@inlined
def _place(x: Any, y: Any, z: Any) -> Any:
    return PLACE_X[x & _LOW] + PLACE_Y[y & _LOW] + PLACE_Z[z & _LOW]


@compiled(
    *(
        types.int64(
            read_only(real, 2), read_only(float64, 2), read_only(float64, 1), read_only(int64, 1), int64,
            int32[::1], int32[::1], int64, uint64[::1], uint64[::1], int32[:, ::1], int64[::1],
        )
        for real in (float32, float64)
    )
)  # fmt: skip
def mark_ends(
    points: Any, pose: Any, limits: Any, corner: Any, side: Any, table: Any, used: Any, most: Any, hits: Any,
    misses: Any, ends: Any, counts: Any,
) -> Any:  # fmt: skip
    """Mark where rays end, those in range before those that are cut short; each voxel once.

    Parameters
    ----------
    points, pose
        (N, 3) in the sensor's frame, and (3, 4): how they lie in the map's.
    limits
        ``1 / resolution``, least and greatest range, least and greatest z (of the sensor's frame).
    corner, side
        Index of the window's first voxel along x, y, z; its chunks along each axis.
    table, used, most
        Slots; ``used[0]`` is how many are, then which chunk each is for.
    ends
        (N, 3): receives the voxels to which rays are to be cast.
    counts
        Receives how many points are in range, too far, too near, too high or low, not finite.

    Returns
    -------
    int
        How many ``ends`` there are, `NO_SLOTS` if there are too few slots.
    """
    inverse, low_z, high_z = limits[0], limits[3], limits[4]
    nearest, furthest = limits[1] * limits[1], limits[2] * limits[2]
    from_x, from_y, from_z = pose[0, 3], pose[1, 3], pose[2, 3]
    rays = 0
    for far in (False, True):
        for n in range(points.shape[0]):
            # without this a float32 stays one, and points on a voxel's border fall elsewhere
            px, py, pz = np.float64(points[n, 0]), np.float64(points[n, 1]), np.float64(points[n, 2])
            if not (np.isfinite(px) and np.isfinite(py) and np.isfinite(pz)):
                if not far:
                    counts[4] += 1
                continue
            if not (low_z <= pz <= high_z):
                if not far:
                    counts[3] += 1
                continue
            if px * px + py * py + pz * pz < nearest:
                if not far:
                    counts[2] += 1
                continue
            x = pose[0, 0] * px + pose[0, 1] * py + pose[0, 2] * pz + from_x
            y = pose[1, 0] * px + pose[1, 1] * py + pose[1, 2] * pz + from_y
            z = pose[2, 0] * px + pose[2, 1] * py + pose[2, 2] * pz + from_z
            dx, dy, dz = x - from_x, y - from_y, z - from_z
            squared = dx * dx + dy * dy + dz * dz
            if (squared >= furthest) != far:
                continue
            if far:
                length = np.sqrt(squared)
                x = from_x + dx / length * limits[2]
                y = from_y + dy / length * limits[2]
                z = from_z + dz / length * limits[2]
                counts[1] += 1
            else:
                counts[0] += 1
            i = np.int64(np.floor(x * inverse)) - corner[0]
            j = np.int64(np.floor(y * inverse)) - corner[1]
            k = np.int64(np.floor(z * inverse)) - corner[2]
            slot = _slot(table, used, ((k >> _SHIFT) * side + (j >> _SHIFT)) * side + (i >> _SHIFT), most)
            if slot < 0:
                return NO_SLOTS
            place = _place(i, j, k)
            word = slot * WORDS + (place >> 6)
            bit = _ONE << np.uint64(place & 63)
            if (hits[word] | misses[word]) & bit:
                continue
            if far:
                misses[word] |= bit
            else:
                hits[word] |= bit
            ends[rays, 0], ends[rays, 1], ends[rays, 2] = i, j, k
            rays += 1
    return rays


@compiled(
    types.boolean(
        read_only(int32, 2), int64, int64, int64, int64, int64, int32[::1], int32[::1], int64, uint64[::1]
    )
)
def mark_rays(
    ends: Any, count: Any, from_x: Any, from_y: Any, from_z: Any, side: Any, table: Any, used: Any, most: Any,
    misses: Any,
) -> Any:  # fmt: skip
    """Mark the voxels between the sensor's, included, and the ends, excluded.

    The walk is Bonxai's ``RayIterator``: as many voxels as the longest axis has steps.  Returns whether there
    were slots enough.
    """
    for n in range(count):
        x, y, z = from_x, from_y, from_z
        dx, dy, dz = ends[n, 0] - x, ends[n, 1] - y, ends[n, 2] - z
        step_x, step_y, step_z = (-1 if dx < 0 else 1), (-1 if dy < 0 else 1), (-1 if dz < 0 else 1)
        dx, dy, dz = abs(dx), abs(dy), abs(dz)
        longest = max(dx, dy, dz)
        error_x, error_y, error_z = 0, 0, 0
        before = -1
        base = 0
        for _ in range(longest):
            chunk = ((z >> _SHIFT) * side + (y >> _SHIFT)) * side + (x >> _SHIFT)
            if chunk != before:
                slot = _slot(table, used, chunk, most)
                if slot < 0:
                    return False
                base = slot * WORDS
                before = chunk
            place = _place(x, y, z)
            misses[base + (place >> 6)] |= _ONE << np.uint64(place & 63)
            error_x += dx
            error_y += dy
            error_z += dz
            if 2 * error_x >= longest:
                x += step_x
                error_x -= longest
            if 2 * error_y >= longest:
                y += step_y
                error_y -= longest
            if 2 * error_z >= longest:
                z += step_z
                error_z -= longest
    return True


@compiled(types.int64(int64, uint64[::1], uint64[::1], int32[:, ::1]))
def count_words(slots: Any, hits: Any, misses: Any, counts: Any) -> Any:
    """Take hits out of the misses, and count the words of both that have bits.

    ``counts``, (slots, 2), receives them by slot.  Returns how many there are in all.
    """
    words = 0
    for slot in range(slots):
        hit, miss = 0, 0
        for word in range(slot * WORDS, (slot + 1) * WORDS):
            if hits[word]:
                misses[word] &= ~hits[word]
                hit += 1
            if misses[word]:
                miss += 1
        counts[slot, 0], counts[slot, 1] = hit, miss
        words += hit + miss
    return words


@compiled(types.void(read_only(int64, 1), uint64[::1], uint64[::1], uint64[::1], uint16[::1]))
def write_words(order: Any, hits: Any, misses: Any, bits: Any, words: Any) -> None:
    """Write the words that have bits: slot by slot in ``order``, hits before misses; and clear the sets."""
    at = 0
    for slot in order:
        for which in (hits, misses):
            for word in range(WORDS):
                one = which[slot * WORDS + word]
                if one:
                    bits[at] = one
                    words[at] = word
                    which[slot * WORDS + word] = 0
                    at += 1


@compiled(types.void(int64, uint64[::1], uint64[::1]))
def clear(slots: Any, hits: Any, misses: Any) -> None:
    """Forget what was marked."""
    hits[: slots * WORDS] = 0
    misses[: slots * WORDS] = 0
