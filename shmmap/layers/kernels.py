# SPDX-License-Identifier: Apache-2.0
"""Kernels of layers: voxel of a global lattice for each point, and sums over the points of each voxel.

The index along an axis is ``floor(x * (1 / leaf))``, computed in the points' own precision: in
float32 for float32 points, as in PCL's VoxelGrid and VoxelGridCovariance, so that points on a voxel's
face are in the same voxel as there.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from numba import float32, float64, int32, int64, types

from shmmap.compiling import compiled, inlined, read_only

_POINTS: Final = tuple((read_only(real, 2), real) for real in (float32, float64))
"""Numba types of a point array, and of one coordinate."""
_INDICES: Final = read_only(int32, 1)
_HEIGHTS: Final = float64[::1]
_TABLE: Final = float64[:, ::1]


@compiled(*(types.int64(xyz, real, real, real, float64[::1]) for xyz, real in _POINTS))
def bounds(xyz: Any, inverse_x: Any, inverse_y: Any, inverse_z: Any, result: Any) -> Any:
    """Find the extent of finite points on the lattice, and return the number of finite points.

    ``result`` (6,) receives the least and then the greatest index along x, y, z.
    """
    kept = 0
    low_x, low_y, low_z = np.inf, np.inf, np.inf
    high_x, high_y, high_z = -np.inf, -np.inf, -np.inf
    for n in range(xyz.shape[0]):
        x, y, z = xyz[n, 0], xyz[n, 1], xyz[n, 2]
        if not (np.isfinite(x) and np.isfinite(y) and np.isfinite(z)):
            continue
        kept += 1
        # floor is monotonic, so it is applied to the extremes only
        a, b, c = x * inverse_x, y * inverse_y, z * inverse_z
        low_x = min(low_x, a)
        low_y = min(low_y, b)
        low_z = min(low_z, c)
        high_x = max(high_x, a)
        high_y = max(high_y, b)
        high_z = max(high_z, c)
    result[0], result[1], result[2] = np.floor(low_x), np.floor(low_y), np.floor(low_z)
    result[3], result[4], result[5] = np.floor(high_x), np.floor(high_y), np.floor(high_z)
    return kept


@compiled(
    *(
        types.int64(xyz, real, real, real, read_only(int64, 1), read_only(int64, 1), int32[::1], int32[::1])
        for xyz, real in _POINTS
    )
)
def count_points(
    xyz: Any, inverse_x: Any, inverse_y: Any, inverse_z: Any, first: Any, shape: Any, place: Any, table: Any
) -> Any:
    """Count the points of each voxel of a table, and return the number of voxels with points.

    ``table`` (voxels,) is zero on entry, x fastest; ``place`` (N,) receives each point's position in
    ``table``, -1 for a point that is not finite.
    """
    occupied = 0
    first_x, first_y, first_z = first[0], first[1], first[2]
    step_y = shape[0]
    step_z = shape[0] * shape[1]
    for n in range(xyz.shape[0]):
        x, y, z = xyz[n, 0], xyz[n, 1], xyz[n, 2]
        if not (np.isfinite(x) and np.isfinite(y) and np.isfinite(z)):
            place[n] = -1
            continue
        at = (
            (int(np.floor(x * inverse_x)) - first_x)
            + (int(np.floor(y * inverse_y)) - first_y) * step_y
            + (int(np.floor(z * inverse_z)) - first_z) * step_z
        )
        place[n] = at
        if table[at] == 0:
            occupied += 1
        table[at] += 1
    return occupied


@compiled(types.int64(int32[::1], int32, int32[::1], int32[::1]))
def number_voxels(table: Any, least: Any, counts: Any, places: Any) -> Any:
    """Assign rows to the voxels with at least ``least`` points, and return the number of rows.

    Rows are in the order of the table.  ``table`` contains counts on entry, row numbers or -1 afterwards;
    ``counts`` and ``places`` (with room for all occupied voxels) receive each row's count and position.
    """
    rows = 0
    for at in range(table.shape[0]):
        count = table[at]
        if count >= least and count > 0:
            counts[rows] = count
            places[rows] = at
            table[at] = rows
            rows += 1
        else:
            table[at] = -1
    return rows


@compiled(*(types.void(xyz, _INDICES, _INDICES, _HEIGHTS, _HEIGHTS, _HEIGHTS) for xyz, _ in _POINTS))
def heights(xyz: Any, rows: Any, counts: Any, low: Any, high: Any, mean: Any) -> None:
    """Compute lowest, highest and mean z of each row; the mean is summed relative to the row's first z."""
    first = np.empty(low.shape[0])
    low[:] = np.inf
    high[:] = -np.inf
    mean[:] = 0.0
    for n in range(xyz.shape[0]):
        row = rows[n]
        if row < 0:
            continue
        z = float(xyz[n, 2])
        if high[row] == -np.inf:
            first[row] = z
        low[row] = min(low[row], z)
        high[row] = max(high[row], z)
        mean[row] += z - first[row]
    for row in range(low.shape[0]):
        mean[row] = first[row] + mean[row] / counts[row]


@compiled(*(types.void(xyz, _INDICES, _INDICES, _TABLE, _TABLE) for xyz, _ in _POINTS))
def moments(xyz: Any, rows: Any, counts: Any, mean: Any, scatter: Any) -> None:
    """Compute mean and scatter about the mean of each voxel's points.

    All sums are in float64 relative to the voxel's first point: large coordinates lose no digits, and
    identical points have a scatter of exactly 0.

    ``mean`` (V, 3) receives the mean, ``scatter`` (V, 6) the sums xx, xy, xz, yy, yz, zz of products of
    differences to the mean.
    """
    sums = np.zeros((counts.shape[0], 12))  # origin, sums, sums of products
    seen = np.zeros(counts.shape[0], np.uint8)
    for n in range(xyz.shape[0]):
        row = rows[n]
        if row < 0:
            continue
        s = sums[row]
        x, y, z = float(xyz[n, 0]), float(xyz[n, 1]), float(xyz[n, 2])
        if seen[row] == 0:
            seen[row] = 1
            s[0], s[1], s[2] = x, y, z
            continue
        x -= s[0]
        y -= s[1]
        z -= s[2]
        s[3] += x
        s[4] += y
        s[5] += z
        s[6] += x * x
        s[7] += x * y
        s[8] += x * z
        s[9] += y * y
        s[10] += y * z
        s[11] += z * z
    for row in range(counts.shape[0]):
        s = sums[row]
        n = counts[row]
        x, y, z = s[3] / n, s[4] / n, s[5] / n
        mean[row, 0], mean[row, 1], mean[row, 2] = s[0] + x, s[1] + y, s[2] + z
        scatter[row, 0] = s[6] - s[3] * x
        scatter[row, 1] = s[7] - s[3] * y
        scatter[row, 2] = s[8] - s[3] * z
        scatter[row, 3] = s[9] - s[4] * y
        scatter[row, 4] = s[10] - s[4] * z
        scatter[row, 5] = s[11] - s[5] * z


@inlined
def _jacobi(a: Any, v: Any) -> None:
    """Compute eigenvalues (diagonal of ``a``) and eigenvectors (columns of ``v``) by cyclic Jacobi."""
    for i in range(3):
        for j in range(3):
            v[i, j] = 1.0 if i == j else 0.0
    for _ in range(30):
        off = abs(a[0, 1]) + abs(a[0, 2]) + abs(a[1, 2])
        if off <= 1e-300 or off <= 1e-17 * (abs(a[0, 0]) + abs(a[1, 1]) + abs(a[2, 2])):
            break
        for p in range(2):
            for q in range(p + 1, 3):
                if a[p, q] == 0.0:
                    continue
                theta = (a[q, q] - a[p, p]) / (2.0 * a[p, q])
                t = 1.0 / (abs(theta) + math.sqrt(theta * theta + 1.0))
                if theta < 0.0:
                    t = -t
                c = 1.0 / math.sqrt(t * t + 1.0)
                s = t * c
                d = t * a[p, q]
                a[p, p] -= d
                a[q, q] += d
                a[p, q] = 0.0
                a[q, p] = 0.0
                r = 3 - p - q
                g, h = a[r, p], a[r, q]
                a[r, p] = c * g - s * h
                a[p, r] = a[r, p]
                a[r, q] = s * g + c * h
                a[q, r] = a[r, q]
                for k in range(3):
                    g, h = v[k, p], v[k, q]
                    v[k, p] = c * g - s * h
                    v[k, q] = s * g + c * h


@inlined
def _least_and_greatest(c: Any) -> Any:
    """Return least and greatest eigenvalue of (xx, xy, xz, yy, yz, zz), accurate to 1e-8 of the greatest."""
    q = (c[0] + c[3] + c[5]) / 3.0
    x, y, z = c[0] - q, c[3] - q, c[5] - q
    off = c[1] * c[1] + c[2] * c[2] + c[4] * c[4]
    p = math.sqrt((x * x + y * y + z * z + 2.0 * off) / 6.0)
    if p == 0.0:
        return q, q
    det = x * (y * z - c[4] * c[4]) - c[1] * (c[1] * z - c[4] * c[2]) + c[2] * (c[1] * c[4] - y * c[2])
    r = min(1.0, max(-1.0, det / (2.0 * p * p * p)))
    angle = math.acos(r) / 3.0
    return q + 2.0 * p * math.cos(angle + 2.0 * math.pi / 3.0), q + 2.0 * p * math.cos(angle)


@inlined
def _raise_eigenvalues(c: Any, least_ratio: Any, a: Any, v: Any) -> None:
    """Raise eigenvalues of (xx, xy, xz, yy, yz, zz) to at least ``least_ratio`` times the greatest.

    ``a`` and ``v``, (3, 3), are scratch.
    """
    a[0, 0], a[1, 1], a[2, 2] = c[0], c[3], c[5]
    a[0, 1] = a[1, 0] = c[1]
    a[0, 2] = a[2, 0] = c[2]
    a[1, 2] = a[2, 1] = c[4]
    _jacobi(a, v)
    low, middle, high = 0, 1, 2
    if a[low, low] > a[middle, middle]:
        low, middle = middle, low
    if a[middle, middle] > a[high, high]:
        middle, high = high, middle
    if a[low, low] > a[middle, middle]:
        low, middle = middle, low
    floor = least_ratio * a[high, high]
    if a[low, low] < floor:
        a[low, low] = floor
        if a[middle, middle] < floor:
            a[middle, middle] = floor
        at = 0
        for i in range(3):
            for j in range(i, 3):
                c[at] = (
                    a[0, 0] * v[i, 0] * v[j, 0] + a[1, 1] * v[i, 1] * v[j, 1] + a[2, 2] * v[i, 2] * v[j, 2]
                )
                at += 1


@compiled(types.int64(_INDICES, read_only(float64, 2), int64, float64, _TABLE, _TABLE))
def inverse_covariances(
    counts: Any, scatter: Any, convention: Any, least_ratio: Any, covariance: Any, inverse: Any
) -> Any:
    """Compute covariances with raised smallest eigenvalues, and their inverses.

    ``convention`` 0: Autoware, (S + I) / (n - 1); 1: ndt_omp, (S + I) / n (n - 1) / n; 2: PCL,
    S / (n - 1).  A least eigenvalue below ``least_ratio`` times the greatest is raised to that limit; only
    in this case, the middle one is raised likewise.  ``covariance`` may have no rows: then only inverses
    are written.  Rows that cannot be inverted are zero in both; returns the number of these rows.
    """
    refused = 0
    keep = covariance.shape[0] > 0
    a = np.empty((3, 3))
    v = np.empty((3, 3))
    c = np.empty(6)
    for row in range(counts.shape[0]):
        n = float(counts[row])
        added = 0.0 if convention == 2 else 1.0
        factor = (n - 1.0) / (n * n) if convention == 1 else 1.0 / (n - 1.0)
        for k in range(6):
            c[k] = scatter[row, k] * factor
        c[0] += added * factor
        c[3] += added * factor
        c[5] += added * factor
        least, greatest = _least_and_greatest(c)
        good = n > 1.0 and greatest > 0.0 and least >= -1e-7 * greatest and math.isfinite(greatest)
        if good and least < (least_ratio + 1e-6) * greatest:
            _raise_eigenvalues(c, least_ratio, a, v)
        xx = c[3] * c[5] - c[4] * c[4]
        xy = c[2] * c[4] - c[1] * c[5]
        xz = c[1] * c[4] - c[2] * c[3]
        det = c[0] * xx + c[1] * xy + c[2] * xz
        good = good and det > 0.0 and math.isfinite(1.0 / det)
        if not good:
            refused += 1
            for k in range(6):
                inverse[row, k] = 0.0
                if keep:
                    covariance[row, k] = 0.0
            continue
        scale = 1.0 / det
        inverse[row, 0] = xx * scale
        inverse[row, 1] = xy * scale
        inverse[row, 2] = xz * scale
        inverse[row, 3] = (c[0] * c[5] - c[2] * c[2]) * scale
        inverse[row, 4] = (c[1] * c[2] - c[0] * c[4]) * scale
        inverse[row, 5] = (c[0] * c[3] - c[1] * c[1]) * scale
        if keep:
            for k in range(6):
                covariance[row, k] = c[k]
    return refused
