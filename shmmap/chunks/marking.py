# SPDX-License-Identifier: Apache-2.0
"""Turn a scan into marks: voxels in which its rays end are hit, voxels along the rays are passed through.

Each voxel counts once per scan, and as hit if any ray ends in it, whatever the order of the points.  A ray
that is longer than the maximum range is cut there, and hits nothing.  One ray is cast from the sensor's voxel
to each end voxel; the traversal is Bonxai's.  (If a voxel is both a hit and the end of a cut ray, in Bonxai
the first of them in the scan decides; here the hit does.)
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from shmmap.chunks import marking_kernels as kernels
from shmmap.chunks.marks import MAX_CHUNKS, Marks
from shmmap.chunks.occupancy import ScanCounts, ScanFilter
from shmmap.chunks.voxels import CHUNK_SHIFT, CHUNK_SIDE, FURTHEST_SENSOR, WORDS, voxel_indices
from shmmap.errors import BadRequest, ConfigError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

FIRST_SLOTS: Final = 64
MAX_REACH: Final = 64
"""Most chunks from the sensor to the end of the longest ray; the window's table then has 9 MB."""


class Marker:
    """Marks scans, and reuses the memory needed for that.

    Parameters
    ----------
    resolution
        Edge of a voxel, metres.
    scan_filter
        Selects the points to use.

    Raises
    ------
    ConfigError
        The maximum range is more than 64 chunks of 64 voxels.
    """

    def __init__(self, resolution: float, scan_filter: ScanFilter | None = None) -> None:
        self.resolution = resolution
        self.filter = scan_filter if scan_filter is not None else ScanFilter()
        voxels = self.filter.max_range / resolution
        self._reach = math.ceil(voxels / CHUNK_SIDE) + 1 if math.isfinite(voxels) else MAX_REACH + 1
        if self._reach > MAX_REACH:
            most = (MAX_REACH - 1) * CHUNK_SIDE * resolution
            raise ConfigError(
                f"max_range = {self.filter.max_range!r}: with voxels of {resolution} m at most {most:g} m",
                key="max_range",
            )
        self._side = 2 * self._reach + 1
        self._codes = kernels.window_codes(self._side)
        self._table = np.full(self._side**3, -1, np.int32)
        self._ends = np.empty((0, 3), np.int32)
        self._make_slots(FIRST_SLOTS)

    def _make_slots(self, count: int) -> None:
        self._slots = count
        self._hits = np.zeros(count * WORDS, np.uint64)
        self._misses = np.zeros(count * WORDS, np.uint64)
        self._used = np.zeros(count + 1, np.int32)

    def mark(self, points: ArrayLike, pose: ArrayLike) -> tuple[Marks, ScanCounts]:
        """Mark a scan.

        Parameters
        ----------
        points
            (N, 3) float32 or float64, metres in the sensor's frame; masked and non-finite points are left
            out.
        pose
            (3, 4) or (4, 4): rotation and position of the sensor in the map's frame.

        Raises
        ------
        BadRequest
            A shape is wrong, the pose is not a rotation with a finite position, the sensor is outside the
            range of voxel indices, or the scan touches more than 4096 chunks.
        """
        points = _numbers("points", points)
        if points.ndim != 2 or points.shape[1] != 3:
            raise BadRequest(f"points: need the shape (N, 3), not {points.shape}")
        rigid = _rigid(pose)
        reach_m = FURTHEST_SENSOR * self.resolution
        if not (np.abs(rigid[:, 3]) < reach_m).all():
            raise BadRequest(
                f"pose: sensor at {rigid[:, 3].tolist()}, further than {reach_m:.4g} m from the map's origin",
                hint="map in a frame whose origin is nearer, or make the map with larger voxels",
            )
        sensor = voxel_indices(rigid[None, :, 3], self.resolution)[0].astype(np.int64)
        reach = self._reach * CHUNK_SIDE
        voxel_indices(rigid[None, :, 3] + self.resolution * 2 * reach, self.resolution)
        voxel_indices(rigid[None, :, 3] - self.resolution * 2 * reach, self.resolution)
        corner = ((sensor >> CHUNK_SHIFT) - self._reach) << CHUNK_SHIFT
        if len(self._ends) < len(points):
            self._ends = np.empty((len(points), 3), np.int32)
        while (counts := self._try(points, rigid, corner, sensor - corner)) is None:
            self._forget()
            if self._slots == MAX_CHUNKS:
                raise BadRequest(
                    f"the scan touches more than {MAX_CHUNKS} chunks",
                    hint="lower max_range, or make the map with larger voxels",
                )
            self._make_slots(min(2 * self._slots, MAX_CHUNKS))
        return self._collect(corner), counts

    def _try(
        self,
        points: NDArray[np.floating],
        pose: NDArray[np.float64],
        corner: NDArray[np.int64],
        sensor: NDArray[np.int64],
    ) -> ScanCounts | None:
        """Mark a scan; return None if there are too few slots."""
        wanted, counts = self.filter, np.zeros(5, np.int64)
        limits = np.array(
            [1.0 / self.resolution, wanted.min_range, wanted.max_range, wanted.min_z, wanted.max_z]
        )
        ends, slots = self._ends[: len(points)], (self._codes, self._table, self._used, self._slots)
        rays = kernels.mark_ends(points, pose, limits, corner, *slots, self._hits, self._misses, ends, counts)
        if rays == kernels.NO_SLOTS:
            return None
        x, y, z = sensor.tolist()
        if not kernels.mark_rays(ends, rays, x, y, z, *slots, self._misses):
            return None
        return ScanCounts(*counts.tolist())

    def _forget(self) -> None:
        used = int(self._used[0])
        self._hits[: used * WORDS] = 0
        self._misses[: used * WORDS] = 0
        self._table[self._used[1 : used + 1]] = -1
        self._used[0] = 0

    def _collect(self, corner: NDArray[np.int64]) -> Marks:
        """Return the marks as lists, chunks in the order of their keys, and clear them."""
        used = int(self._used[0])
        counts = np.zeros((used, 2), np.int32)
        total = kernels.count_words(used, self._hits, self._misses, counts)
        chunks = self._used[1 : used + 1].astype(np.int64)
        side = self._side
        keys = np.stack([chunks % side, chunks // side % side, chunks // side**2], axis=1)
        keys += corner >> CHUNK_SHIFT
        order = np.lexsort(keys.T[::-1])
        bits, words = np.empty(total, np.uint64), np.empty(total, np.uint16)
        kernels.write_words(order, self._hits, self._misses, bits, words)
        self._table[chunks] = -1
        self._used[0] = 0
        counts = counts[order].astype(np.uint32)
        return Marks(keys[order].astype(np.int32), counts[:, 0].copy(), counts[:, 1].copy(), bits, words)


def _numbers(what: str, values: ArrayLike) -> NDArray[np.floating]:
    """Return real numbers as float32 if they are float32, else as float64; masked elements become NaN."""
    try:
        array = np.asanyarray(values)
        if array.dtype.kind not in "fiu":
            raise TypeError(f"{type(values).__name__} of {array.dtype}")
        kind = np.float32 if array.dtype == np.float32 else np.float64
        if isinstance(array, np.ma.MaskedArray):
            return np.ascontiguousarray(np.ma.filled(array.astype(kind), np.nan), kind)
        return np.ascontiguousarray(array, kind)
    except (TypeError, ValueError) as error:  # rows of several lengths, texts, None
        raise BadRequest(f"{what}: need an array of numbers: {error}") from None


def _rigid(pose: ArrayLike) -> NDArray[np.float64]:
    """Check a pose and return it as (3, 4)."""
    whole = _numbers("pose", pose).astype(np.float64)
    if whole.shape not in ((3, 4), (4, 4)):
        raise BadRequest(f"pose: need the shape (3, 4) or (4, 4), not {whole.shape}")
    rigid = np.ascontiguousarray(whole[:3])
    rotation = rigid[:, :3]
    if not np.isfinite(rigid).all() or np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3:
        raise BadRequest("pose: need a rotation and a finite position")
    if np.linalg.det(rotation) < 0:
        raise BadRequest("pose: it mirrors what it should turn")
    if len(whole) == 4 and not np.allclose(whole[3], (0.0, 0.0, 0.0, 1.0), rtol=0.0, atol=1e-6):
        raise BadRequest(f"pose: its last row is {whole[3].tolist()}, not 0 0 0 1: is it transposed?")
    return rigid
