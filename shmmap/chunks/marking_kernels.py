# SPDX-License-Identifier: Apache-2.0
"""Compiled: which voxels a scan hits and passes through.

Voxels are counted from the corner of a window of chunks around the sensor.  The sum of a voxel's three
``codes``, one an axis, is its place in its chunk in the lower 18 bits, and above them which of the window's
chunks that is.  ``table`` says which slot of the bit sets each chunk of the window has, -1 for none yet.
Both bit sets, (slots * 4096,), have a bit for each voxel of each slot, by its place in the chunk.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numba import float32, float64, int32, int64, types, uint16, uint64

from shmmap.chunks.voxels import CHUNK_SHIFT, CHUNK_SIDE, PLACE_X, PLACE_Y, PLACE_Z, WORDS
from shmmap.compiling import compiled, inlined, read_only

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["NO_SLOTS", "clear", "count_words", "mark_ends", "mark_rays", "window_codes", "write_words"]

NO_SLOTS: Final = -1
_ZERO: Final = np.uint64(0)
_ONE: Final = np.uint64(1)
_SIX: Final = np.uint64(6)
_LOW_BIT: Final = np.uint64(63)
_LOW_WORD: Final = np.uint64(WORDS - 1)
_WORDS: Final = np.uint64(WORDS)
_CHUNK_BITS: Final = np.uint64(18)
_NO_CHUNK: Final = np.uint64(2**40)
_POINT: Final = np.uint64(32)
_HALF: Final = 2**31


def window_codes(side: int) -> NDArray[np.uint64]:
    """Codes, (3, side * 64), of the voxels along each axis of a window of so many chunks a side."""
    voxels = np.arange(side * CHUNK_SIDE)
    chunks, within = voxels >> CHUNK_SHIFT, voxels & (CHUNK_SIDE - 1)
    places = (PLACE_X, PLACE_Y, PLACE_Z)
    codes = [chunks * side**axis << 18 | place[within].astype(np.int64) for axis, place in enumerate(places)]
    return np.array(codes, np.uint64)


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
def _mark_end(
    i: Any, j: Any, k: Any, codes: Any, table: Any, used: Any, most: Any, which: Any, other: Any
) -> Any:  # fmt: skip
    """Mark where a ray ends, if neither set has it; 0 if one has, -1 if there is no slot left."""
    code = codes[0, i] + codes[1, j] + codes[2, k]
    slot = _slot(table, used, np.int64(code >> _CHUNK_BITS), most)
    if slot < 0:
        return -1
    word = np.uint64(slot) * _WORDS + (code >> _SIX & _LOW_WORD)
    bit = _ONE << (code & _LOW_BIT)
    if (which[word] | other[word]) & bit:
        return 0
    which[word] |= bit
    return 1


@inlined
def _walk(
    steps: Any, u: Any, step_u: Any, code_u: Any, v: Any, step_v: Any, code_v: Any, delta_v: Any, w: Any,
    step_w: Any, code_w: Any, delta_w: Any, table: Any, used: Any, most: Any, misses: Any,
) -> Any:  # fmt: skip
    """Mark a ray whose longest axis is u.

    Along v and w the place has 32 bits behind the point, and half a step is added at the start: that is
    Bonxai's walk with its errors as long as there are less than 2^15 steps, and no step waits for the one
    before.  A step back is cut upwards where one forth is cut downwards.
    """
    by_v = ((delta_v << 32) + steps - 1) // max(steps, 1) * step_v
    by_w = ((delta_w << 32) + steps - 1) // max(steps, 1) * step_w
    at_u, by_u = np.uint64(u), np.uint64(step_u)
    at_v, by_v = np.uint64((v << 32) + _HALF - np.int64(step_v < 0)), np.uint64(by_v)
    at_w, by_w = np.uint64((w << 32) + _HALF - np.int64(step_w < 0)), np.uint64(by_w)
    before, base = _NO_CHUNK, _ZERO
    for _ in range(steps):
        code = code_u[at_u] + code_v[at_v >> _POINT] + code_w[at_w >> _POINT]
        chunk = code >> _CHUNK_BITS
        if chunk != before:
            slot = _slot(table, used, np.int64(chunk), most)
            if slot < 0:
                return False
            base, before = np.uint64(slot) * _WORDS, chunk
        misses[base + (code >> _SIX & _LOW_WORD)] |= _ONE << (code & _LOW_BIT)
        at_u += by_u
        at_v += by_v
        at_w += by_w
    return True


@compiled(
    *(
        types.int64(
            read_only(real, 2), read_only(float64, 2), read_only(float64, 1), read_only(int64, 1),
            read_only(uint64, 2), int32[::1], int32[::1], int64, uint64[::1], uint64[::1], int32[:, ::1],
            int64[::1],
        )
        for real in (float32, float64)
    )
)  # fmt: skip
def mark_ends(
    points: Any, pose: Any, limits: Any, corner: Any, codes: Any, table: Any, used: Any, most: Any, hits: Any,
    misses: Any, ends: Any, counts: Any,
) -> Any:  # fmt: skip
    """Mark where rays end, those in range before those that are cut short; each voxel once.

    Parameters
    ----------
    points, pose
        (N, 3) in the sensor's frame, and (3, 4): how they lie in the map's.
    limits
        ``1 / resolution``, least and greatest range, least and greatest z (of the sensor's frame).
    corner
        Index of the window's first voxel along x, y, z.
    table, used, most
        Slots; ``used[0]`` is how many are, then which chunk each is for.
    ends
        (N, 3), as long as ``points``: receives the voxels to which rays are to be cast.
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
    rays, cut = 0, ends.shape[0]
    for n in range(points.shape[0]):
        # without this a float32 stays one, and points on a voxel's border fall elsewhere
        px, py, pz = np.float64(points[n, 0]), np.float64(points[n, 1]), np.float64(points[n, 2])
        if not (np.isfinite(px) and np.isfinite(py) and np.isfinite(pz)):
            counts[4] += 1
            continue
        if not (low_z <= pz <= high_z):
            counts[3] += 1
            continue
        if px * px + py * py + pz * pz < nearest:
            counts[2] += 1
            continue
        x = pose[0, 0] * px + pose[0, 1] * py + pose[0, 2] * pz + from_x
        y = pose[1, 0] * px + pose[1, 1] * py + pose[1, 2] * pz + from_y
        z = pose[2, 0] * px + pose[2, 1] * py + pose[2, 2] * pz + from_z
        dx, dy, dz = x - from_x, y - from_y, z - from_z
        squared = dx * dx + dy * dy + dz * dz
        far = squared >= furthest
        if far:
            length = np.sqrt(squared)
            x = from_x + dx / length * limits[2]
            y = from_y + dy / length * limits[2]
            z = from_z + dz / length * limits[2]
        i = np.int64(np.floor(x * inverse)) - corner[0]
        j = np.int64(np.floor(y * inverse)) - corner[1]
        k = np.int64(np.floor(z * inverse)) - corner[2]
        if far:  # what the others hit is not known yet: at the end of the array they wait for that
            cut -= 1
            ends[cut, 0], ends[cut, 1], ends[cut, 2] = i, j, k
            counts[1] += 1
            continue
        counts[0] += 1
        new = _mark_end(i, j, k, codes, table, used, most, hits, hits)
        if new < 0:
            return NO_SLOTS
        if new:
            ends[rays, 0], ends[rays, 1], ends[rays, 2] = i, j, k
            rays += 1
    for n in range(cut, ends.shape[0]):
        i, j, k = ends[n, 0], ends[n, 1], ends[n, 2]
        new = _mark_end(i, j, k, codes, table, used, most, misses, hits)
        if new < 0:
            return NO_SLOTS
        if new:
            ends[rays, 0], ends[rays, 1], ends[rays, 2] = i, j, k
            rays += 1
    return rays


@compiled(
    types.boolean(
        read_only(int32, 2), int64, int64, int64, int64, read_only(uint64, 2), int32[::1], int32[::1], int64,
        uint64[::1],
    )
)  # fmt: skip
def mark_rays(
    ends: Any, count: Any, from_x: Any, from_y: Any, from_z: Any, codes: Any, table: Any, used: Any,
    most: Any, misses: Any,
) -> Any:  # fmt: skip
    """Mark the voxels between the sensor's, included, and the ends, excluded.

    The walk is Bonxai's ``RayIterator``: as many voxels as the longest axis has steps.  Returns whether there
    were slots enough.
    """
    code_x, code_y, code_z = codes[0], codes[1], codes[2]
    for n in range(count):
        dx, dy, dz = ends[n, 0] - from_x, ends[n, 1] - from_y, ends[n, 2] - from_z
        step_x, step_y, step_z = (-1 if dx < 0 else 1), (-1 if dy < 0 else 1), (-1 if dz < 0 else 1)
        dx, dy, dz = abs(dx), abs(dy), abs(dz)
        if dx >= dy and dx >= dz:
            enough = _walk(
                dx, from_x, step_x, code_x, from_y, step_y, code_y, dy, from_z, step_z, code_z, dz, table,
                used, most, misses,
            )  # fmt: skip
        elif dy >= dz:
            enough = _walk(
                dy, from_y, step_y, code_y, from_x, step_x, code_x, dx, from_z, step_z, code_z, dz, table,
                used, most, misses,
            )  # fmt: skip
        else:
            enough = _walk(
                dz, from_z, step_z, code_z, from_x, step_x, code_x, dx, from_y, step_y, code_y, dy, table,
                used, most, misses,
            )  # fmt: skip
        if not enough:
            return False
    return True


@compiled(types.int64(int64, uint64[::1], uint64[::1], int32[:, ::1]))
def count_words(slots: Any, hits: Any, misses: Any, counts: Any) -> Any:
    """Take hits out of the misses, and count the words of both that have bits.

    ``counts``, (slots, 2), receives them by slot.  Returns how many there are in all.
    """
    words = 0
    for slot in range(slots):
        hit, miss = 0, 0
        begin, end = slot * WORDS, (slot + 1) * WORDS
        of_hits, of_misses = hits[begin:end], misses[begin:end]
        for word in range(WORDS):  # nothing branches: so it takes a thirtieth of the time
            of_misses[word] &= ~of_hits[word]
            hit += of_hits[word] != 0
            miss += of_misses[word] != 0
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
