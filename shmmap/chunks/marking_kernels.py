# SPDX-License-Identifier: Apache-2.0
"""Compiled kernels that find the voxels that a scan hits and passes through.

Voxel indices are relative to the corner of a window of chunks around the sensor.  The sum of a voxel's three
``codes``, one per axis, has its place in its chunk in the lower 18 bits, and the chunk's number in the window
above them.  ``table`` maps each chunk of the window to its slot in the bit sets, -1 for none yet. Both bit
sets, (slots * 4096,), have a bit for each voxel of each slot, by its place in the chunk.

The work on each point or voxel is written directly in the loop.  For an inlined function, numba would count
references to the arrays at each call, which takes ten times as long as all other work.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numba import float32, float64, int32, int64, types, uint16, uint64

from shmmap.chunks.voxels import CHUNK_SHIFT, CHUNK_SIDE, PLACE_X, PLACE_Y, PLACE_Z, WORDS
from shmmap.compiling import compiled, inlined, read_only

if TYPE_CHECKING:
    from numpy.typing import NDArray

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
_BLOCK: Final = 1024
"""Points that are classified together, so that the compiler can use vector instructions."""
_NEAR, _FAR, _TOO_NEAR, _OUTSIDE_Z, _NOT_FINITE = range(5)
"""Classes of points, in the order of ``counts`` of `mark_ends`."""


def window_codes(side: int) -> NDArray[np.uint64]:
    """Return codes, (3, side * 64), of the voxels along each axis of a window of ``side`` chunks per axis."""
    voxels = np.arange(side * CHUNK_SIDE)
    chunks, within = voxels >> CHUNK_SHIFT, voxels & (CHUNK_SIDE - 1)
    places = (PLACE_X, PLACE_Y, PLACE_Z)
    codes = [chunks * side**axis << 18 | place[within].astype(np.int64) for axis, place in enumerate(places)]
    return np.array(codes, np.uint64)


@inlined
def _place_points(
    points: Any, begin: Any, size: Any, pose: Any, limits: Any, corner: Any, near: Any, place: Any
) -> None:
    """Classify a block of points, and find the voxels in which their rays end, without branches."""
    inverse, low_z, high_z = limits[0], limits[3], limits[4]
    nearest, furthest = limits[1] * limits[1], limits[2] * limits[2]
    from_x, from_y, from_z = pose[0, 3], pose[1, 3], pose[2, 3]
    for n in range(size):
        # otherwise a float32 stays one, and points on a voxel's border get other voxels
        px = np.float64(points[begin + n, 0])
        py = np.float64(points[begin + n, 1])
        pz = np.float64(points[begin + n, 2])
        x = pose[0, 0] * px + pose[0, 1] * py + pose[0, 2] * pz + from_x
        y = pose[1, 0] * px + pose[1, 1] * py + pose[1, 2] * pz + from_y
        z = pose[2, 0] * px + pose[2, 1] * py + pose[2, 2] * pz + from_z
        dx, dy, dz = x - from_x, y - from_y, z - from_z
        squared = dx * dx + dy * dy + dz * dz
        length = np.sqrt(squared)
        far = squared >= furthest
        x = from_x + dx / length * limits[2] if far else x
        y = from_y + dy / length * limits[2] if far else y
        z = from_z + dz / length * limits[2] if far else z
        what = np.uint8(_FAR) if far else np.uint8(_NEAR)
        what = np.uint8(_TOO_NEAR) if px * px + py * py + pz * pz < nearest else what
        what = what if low_z <= pz <= high_z else np.uint8(_OUTSIDE_Z)
        what = what if np.isfinite(px) & np.isfinite(py) & np.isfinite(pz) else np.uint8(_NOT_FINITE)
        near[n] = what
        counts = what <= np.uint8(_FAR)
        place[0, n] = np.int32(np.floor(x * inverse) - corner[0]) if counts else 0
        place[1, n] = np.int32(np.floor(y * inverse) - corner[1]) if counts else 0
        place[2, n] = np.int32(np.floor(z * inverse) - corner[2]) if counts else 0


@compiled(
    *(
        types.int64(
            read_only(real, 2),
            read_only(float64, 2),
            read_only(float64, 1),
            read_only(int64, 1),
            read_only(uint64, 2),
            int32[::1],
            int32[::1],
            int64,
            uint64[::1],
            uint64[::1],
            int32[:, ::1],
            int64[::1],
        )
        for real in (float32, float64)
    )
)
def mark_ends(
    points: Any,
    pose: Any,
    limits: Any,
    corner: Any,
    codes: Any,
    table: Any,
    used: Any,
    most: Any,
    hits: Any,
    misses: Any,
    ends: Any,
    counts: Any,
) -> Any:
    """Mark the ends of rays, first those in range, then those that are cut; each voxel once.

    Parameters
    ----------
    points, pose
        Points, (N, 3) in the sensor's frame, and the sensor's pose in the map's frame, (3, 4).
    limits
        ``1 / resolution``, minimum and maximum range, minimum and maximum z (in the sensor's frame).
    corner
        Index of the window's first voxel along x, y, z.
    table, used, most
        Slots of chunks; ``used[0]`` is the number of used slots, followed by the chunk of each.
    ends
        (N, 3), as long as ``points``: receives the voxels to which rays are cast.
    counts
        Receives the numbers of points in range, too far, too near, outside the heights, and not finite.

    Returns
    -------
    int
        Number of ``ends``; `NO_SLOTS` if there are too few slots.
    """
    rays, cut = 0, ends.shape[0]
    near, place = np.empty(_BLOCK, np.uint8), np.empty((3, _BLOCK), np.int32)
    for begin in range(0, points.shape[0], _BLOCK):
        size = min(_BLOCK, points.shape[0] - begin)
        _place_points(points, begin, size, pose, limits, corner, near, place)
        for n in range(size):
            what = near[n]
            counts[what] += 1
            if what == _NEAR:
                ends[rays, 0], ends[rays, 1], ends[rays, 2] = place[0, n], place[1, n], place[2, n]
                rays += 1
            elif what == _FAR:
                cut -= 1
                ends[cut, 0], ends[cut, 1], ends[cut, 2] = place[0, n], place[1, n], place[2, n]
    first, end, rays = 0, rays, 0
    for which in (hits, misses):  # the end of a cut ray is a miss, unless its voxel was hit
        for n in range(first, end):
            i, j, k = ends[n, 0], ends[n, 1], ends[n, 2]
            code = codes[0, i] + codes[1, j] + codes[2, k]
            chunk = code >> _CHUNK_BITS
            if table[chunk] < 0:
                if used[0] >= most:
                    return NO_SLOTS
                used[used[0] + 1], table[chunk] = chunk, used[0]
                used[0] += 1
            word = np.uint64(table[chunk]) * _WORDS + (code >> _SIX & _LOW_WORD)
            bit = _ONE << (code & _LOW_BIT)
            if not (which[word] | hits[word]) & bit:
                which[word] |= bit
                ends[rays, 0], ends[rays, 1], ends[rays, 2] = i, j, k
                rays += 1
        first, end = cut, ends.shape[0]
    return rays


@compiled(
    types.boolean(
        read_only(int32, 2),
        int64,
        int64,
        int64,
        int64,
        read_only(uint64, 2),
        int32[::1],
        int32[::1],
        int64,
        uint64[::1],
    )
)
def mark_rays(
    ends: Any,
    count: Any,
    from_x: Any,
    from_y: Any,
    from_z: Any,
    codes: Any,
    table: Any,
    used: Any,
    most: Any,
    misses: Any,
) -> Any:
    """Mark the voxels from the sensor's voxel, included, to the ends, excluded.

    The traversal is Bonxai's ``RayIterator``: one voxel per step along the longest axis, u.  Positions along
    v and w are fixed-point numbers with 32 fractional bits, starting with half a step added.  Up to 2^15
    steps that gives the same voxels as Bonxai, including its rounding errors, and no step depends on the
    previous one.  Negative steps are rounded up where positive steps are rounded down.  Returns whether there
    were enough slots.
    """
    flat, side = codes.reshape(-1), codes.shape[1]
    for n in range(count):
        dx, dy, dz = ends[n, 0] - from_x, ends[n, 1] - from_y, ends[n, 2] - from_z
        step_x, step_y, step_z = (-1 if dx < 0 else 1), (-1 if dy < 0 else 1), (-1 if dz < 0 else 1)
        dx, dy, dz = abs(dx), abs(dy), abs(dz)
        x, y, z = from_x, from_y + side, from_z + 2 * side  # in ``flat``
        if dx >= dy and dx >= dz:
            steps, u, step_u, v, step_v, delta_v, w, step_w, delta_w = (
                dx,
                x,
                step_x,
                y,
                step_y,
                dy,
                z,
                step_z,
                dz,
            )
        elif dy >= dz:
            steps, u, step_u, v, step_v, delta_v, w, step_w, delta_w = (
                dy,
                y,
                step_y,
                x,
                step_x,
                dx,
                z,
                step_z,
                dz,
            )
        else:
            steps, u, step_u, v, step_v, delta_v, w, step_w, delta_w = (
                dz,
                z,
                step_z,
                x,
                step_x,
                dx,
                y,
                step_y,
                dy,
            )
        by_v = np.uint64(((delta_v << 32) + steps - 1) // max(steps, 1) * step_v)
        by_w = np.uint64(((delta_w << 32) + steps - 1) // max(steps, 1) * step_w)
        at_u, by_u = np.uint64(u), np.uint64(step_u)
        at_v = np.uint64((v << 32) + _HALF - np.int64(step_v < 0))
        at_w = np.uint64((w << 32) + _HALF - np.int64(step_w < 0))
        before, base = _NO_CHUNK, _ZERO
        for _ in range(steps):
            code = flat[at_u] + flat[at_v >> _POINT] + flat[at_w >> _POINT]
            chunk = code >> _CHUNK_BITS
            if chunk != before:
                if table[chunk] < 0:
                    if used[0] >= most:
                        return False
                    used[used[0] + 1], table[chunk] = chunk, used[0]
                    used[0] += 1
                base, before = np.uint64(table[chunk]) * _WORDS, chunk
            misses[base + (code >> _SIX & _LOW_WORD)] |= _ONE << (code & _LOW_BIT)
            at_u += by_u
            at_v += by_v
            at_w += by_w
    return True


@compiled(types.int64(int64, uint64[::1], uint64[::1], int32[:, ::1]))
def count_words(slots: Any, hits: Any, misses: Any, counts: Any) -> Any:
    """Remove hits from the misses, and count the non-zero words of both.

    ``counts``, (slots, 2), receives the numbers by slot.  Returns the total.
    """
    words = 0
    for slot in range(slots):
        hit, miss = 0, 0
        begin, end = slot * WORDS, (slot + 1) * WORDS
        of_hits, of_misses = hits[begin:end], misses[begin:end]
        for word in range(WORDS):  # without branches this takes a thirtieth of the time
            of_misses[word] &= ~of_hits[word]
            hit += of_hits[word] != 0
            miss += of_misses[word] != 0
        counts[slot, 0], counts[slot, 1] = hit, miss
        words += hit + miss
    return words


@compiled(types.void(read_only(int64, 1), uint64[::1], uint64[::1], uint64[::1], uint16[::1]))
def write_words(order: Any, hits: Any, misses: Any, bits: Any, words: Any) -> None:
    """Write the non-zero words, slot by slot in ``order``, hits before misses; and clear the sets."""
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
