# SPDX-License-Identifier: Apache-2.0
"""Backend for any device with an OpenCL driver: GPUs, accelerators, and processors.

The map's Gaussians are copied to the device, or read in place from shared memory.  A batch of poses is one
launch.  All buffers are allocated once, as large as the limits allow; a map for which a device has no room is
cut and counted as by any other limit.

Without double precision (or with ``--precision float``) coordinates are relative to the vehicle, so that
floats are as good 90 km from the map's origin; segments hold doubles, so the map is always copied then.

The program is plain OpenCL C 1.2 with optional double precision, built where it runs: the driver needs a
compiler.  On RISC-V nothing was tried: pyopencl, numba and Open3D have no wheels there and have to be built
(the backends ``numpy`` and ``opencl`` work without numba).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from importlib import resources
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap_clients.ndt_scan_matcher.backends import opencl
from shmmap_clients.ndt_scan_matcher.backends.backend import (
    DeviceHung,
    DeviceMemory,
    DeviceOptions,
    KernelBuildFailed,
    ScanBuffer,
    UploadStatistics,
    check_batch,
    device_errors,
)
from shmmap_clients.ndt_scan_matcher.backends.opencl.devices import Device, Waiting, choose_device
from shmmap_clients.ndt_scan_matcher.backends.opencl.map_memory import MapBuffers, MapInPlace, PlacedMap
from shmmap_clients.ndt_scan_matcher.map.voxel_map import VoxelMap
from shmmap_clients.ndt_scan_matcher.matching.evaluation import (
    CHUNK_POINTS,
    SUMS,
    Evaluation,
    Neighbors,
    Scoring,
    gauss_for,
)
from shmmap_clients.ndt_scan_matcher.matching.pose_batch import (
    derivatives_of_poses,
    evaluations_of,
    matrices_from_poses,
    numpy_step,
)
from shmmap_clients.ndt_scan_matcher.matching.settings import Limits

_POSE: Final = 40  # numbers of a pose in the kernel
_LAUNCH_ROWS: Final = 4096  # chunks in a launch of many poses: 256 poses of 2048 points
_TABLES_BYTES: Final = 18 << 20  # upper bound for one map: its directory and the table of its cells
_SEARCH: Final = {"direct1": 1, "direct7": 7, "radius": 27}

_BUSY: Final[set[OpenclBackend]] = set()
"""Backends whose devices did not answer in time: the device may still read their memory."""


class OpenclBackend:
    """`Backend` on a device.

    Parameters
    ----------
    limits
        Limits that set the size of the buffers.
    threads
        Not used: a device has its own.
    options
        Choice of the device, its precision and its memory.

    Raises
    ------
    DeviceError
        There is no such device, or it does not meet the limits and options.
    """

    name = "opencl"
    on_device = True
    fault = None

    def __init__(self, limits: Limits, threads: int = 1, options: DeviceOptions | None = None) -> None:
        del threads
        self.device: Device = choose_device(options if options is not None else DeviceOptions())
        import pyopencl as cl

        self._cl = cl
        device = self.device
        self._limits = limits
        self._real = np.dtype(np.float64 if device.double else np.float32)
        self._source = ScanBuffer(limits.source_points, self._real)
        self._source_is_new = False
        self._map = VoxelMap({})
        chunks = -(-limits.source_points // CHUNK_POINTS)
        self._max_rows = max(chunks, _LAUNCH_ROWS)
        self._rows = np.empty((self._max_rows, SUMS), self._real)
        self._poses = np.zeros((limits.poses, _POSE), self._real)
        self._places = np.zeros((limits.poses, 3), np.int32)
        self._kernels: dict[Neighbors, Any] = {}
        self._arguments: dict[Neighbors, tuple[PlacedMap, int]] = {}
        self._running: Any = None
        self._closed = False
        self._waiting = Waiting(device.info.name)
        with device_errors(device.info.name, "start"):
            self._context = cl.Context([device.handle])
            self._queue = cl.CommandQueue(self._context, device.handle)
        self.max_map_bytes = self._room_for_maps()
        with device_errors(device.info.name, "allocate buffers for scans and results"):
            flags = cl.mem_flags
            size = self._real.itemsize
            self._source_buffer = cl.Buffer(self._context, flags.READ_ONLY, limits.source_points * 3 * size)
            self._poses_buffer = cl.Buffer(self._context, flags.READ_ONLY, self._poses.nbytes)
            # all zero, and never written again, where coordinates are doubles
            self._places_buffer = cl.Buffer(
                self._context, flags.READ_ONLY | flags.COPY_HOST_PTR, hostbuf=self._places
            )
            self._rows_buffer = cl.Buffer(self._context, flags.WRITE_ONLY, self._rows.nbytes)
        self.maps: MapBuffers | MapInPlace
        if device.in_place:
            self.maps = MapInPlace(self._context)
        else:
            # with space for a second kind of covariance
            self.maps = MapBuffers(self._context, device, 2 * (_TABLES_BYTES + self.max_map_bytes))

    @property
    def uploads(self) -> UploadStatistics:
        """Counts of writes of maps to the device."""
        return self.maps.statistics

    def _room_for_maps(self) -> int:
        """Return the largest size of a map, bytes: the limit, or what fits into two buffers."""
        wanted = self._limits.max_map_bytes
        if self.device.in_place:
            return wanted
        info = self.device.info
        room = min(info.max_bytes, info.memory_bytes // 2) // 2 - _TABLES_BYTES
        if room <= 0:
            raise DeviceMemory(
                f"device {info.name!r} allocates at most {info.max_bytes} bytes at once, and has"
                f" {info.memory_bytes}: too little for a map"
            )
        return min(wanted, room)

    def close(self) -> None:
        """Release the device's memory; keep memory that a hung device still uses until the process ends."""
        if self._closed or (self._running is not None and self._running.command_execution_status > 0):
            return
        self._closed = True
        _BUSY.discard(self)
        self._kernels.clear()
        self._arguments.clear()
        self.maps.close()
        for buffer in (
            self._source_buffer,
            self._poses_buffer,
            self._places_buffer,
            self._rows_buffer,
        ):
            buffer.release()

    def set_map(self, voxel_map: VoxelMap) -> None:
        """Match against this map from now on; `prepare` did the work, or the next evaluation does it."""
        self._map = voxel_map
        self._arguments.clear()

    def prepare(self, voxel_map: VoxelMap, scoring: Scoring) -> None:
        """Write the map to the device, next to the map in use, and build the program; from any thread."""
        self._kernel(scoring.neighbors)
        self.maps.prepare(voxel_map, scoring.covariance)

    def set_source(self, points: NDArray[np.floating]) -> int:
        """Store a scan; return the number of points above the limit."""
        self._check_idle()
        dropped = self._source.take(points)
        self._source_is_new = True
        return dropped

    def evaluate(self, poses: NDArray[np.float64], scoring: Scoring) -> list[Evaluation]:
        """Return the evaluations of (k, 6) poses, in one launch where memory allows."""
        check_batch(poses, self._limits.poses)
        found: list[Evaluation] = []
        each = max(self._max_rows // max(-(-len(self._source.points) // CHUNK_POINTS), 1), 1)
        for first in range(0, len(poses), each):
            found += self._evaluated(np.asarray(poses[first : first + each], np.float64), scoring)
        return found

    def step(self, at: Evaluation, steady: bool, /) -> NDArray[np.float64]:
        """Return the next step from an evaluation; this small computation runs on the host."""
        return numpy_step(at, steady)

    def _evaluated(self, poses: NDArray[np.float64], scoring: Scoring) -> list[Evaluation]:
        matrices, derivatives = matrices_from_poses(poses), derivatives_of_poses(poses, scoring.pitch_sign)
        points = len(self._source.points)
        chunks = -(-points // CHUNK_POINTS)
        if not points:
            return evaluations_of(np.empty((len(poses), 0, SUMS)), derivatives)
        self._check_idle()
        kernel = self._ready_kernel(scoring)
        number = len(poses)
        records, places = self._poses[:number], self._places[:number]
        translation = matrices[:, :3, 3]
        if not self.device.double:
            # floats hold coordinates relative to the vehicle's lattice place
            with np.errstate(invalid="ignore"):
                places[:] = np.floor(translation * (1.0 / self._map.leaf)).clip(-(2**30), 2**30)
            translation = translation - places * self._map.leaf
        records[:, :12] = np.concatenate([matrices[:, :3, :3], translation[:, :, None]], axis=2).reshape(
            -1, 12
        )
        records[:, 12:39] = derivatives[:, :3].reshape(-1, 27)
        cl, queue, device = self._cl, self._queue, self.device
        rows = self._rows[: number * chunks]
        items = (chunks, number) if device.is_processor else (chunks * CHUNK_POINTS, number)
        with device_errors(device.info.name, "evaluate"):
            # releasing a copy's event waits for it: keep the events until all copies are done
            inputs = [cl.enqueue_copy(queue, self._poses_buffer, records, is_blocking=False)]
            if self._source_is_new:
                points_here = self._source.points
                inputs.append(cl.enqueue_copy(queue, self._source_buffer, points_here, is_blocking=False))
                self._source_is_new = False
            if not device.double:
                inputs.append(cl.enqueue_copy(queue, self._places_buffer, places, is_blocking=False))
            cl.enqueue_nd_range_kernel(
                queue, kernel, items, (1, 1) if device.is_processor else (CHUNK_POINTS, 1)
            )
            self._running = cl.enqueue_copy(queue, rows, self._rows_buffer, is_blocking=False)
            queue.flush()
            try:
                self._waiting.until(self._running, scoring.deadline_s)
            except DeviceHung:
                _BUSY.add(self)
                raise
        self._running = None
        inputs.clear()
        return evaluations_of(rows.reshape(number, chunks, SUMS), derivatives)

    def _check_idle(self) -> None:
        """Raise if a device that did not answer in time still uses the buffers."""
        if self._running is None:
            return
        if self._running.command_execution_status > 0:
            raise DeviceHung(
                f"device {self.device.info.name!r} is still busy with what it did not finish in time"
            )
        self._running = None
        _BUSY.discard(self)

    def _kernel(self, neighbors: Neighbors) -> Any:
        if neighbors not in self._kernels:
            built = build_kernel(self._context, self.device, neighbors, self._limits.neighbors)
            self._kernels.setdefault(neighbors, built)
        return self._kernels[neighbors]

    def _ready_kernel(self, scoring: Scoring) -> Any:
        """Return the kernel with all its arguments, which are set once for a map and a scan."""
        neighbors = scoring.neighbors
        kernel = self._kernel(neighbors)
        placed = self.maps.use(self._map, scoring.covariance)
        points = len(self._source.points)
        if self._arguments.get(neighbors) == (placed, points):
            return kernel
        real, integer, offset = self._real.type, np.int32, np.int64
        leaf, gauss = self._map.leaf, gauss_for(self._map.leaf)
        box = self._map.box.tolist()
        kernel.set_args(
            self._source_buffer,
            integer(points),
            self._poses_buffer,
            self._places_buffer,
            self._rows_buffer,
            placed.buffer,
            *(offset(at) for at in placed.places),
            *(integer(side) for side in (*box, *placed.lead, placed.squares)),
            real(leaf),
            real(1.0 / leaf),
            # radius of one leaf: every neighbour within it lies in the 27 voxels around the point
            real(leaf**2 if neighbors == "radius" else math.inf),
            real(gauss.d1),
            real(gauss.d2),
        )
        self._arguments[neighbors] = (placed, points)
        return kernel


def kernel_source() -> str:
    """Return the program's source, OpenCL C 1.2."""
    return resources.files(opencl).joinpath("evaluate.cl").read_text(encoding="utf-8")


def build_kernel(
    context: Any, device: Device, neighbors: Neighbors, most: int, *, extra: Sequence[str] = ()
) -> Any:
    """Return a new kernel for a device; drivers cache built programs.

    Parameters
    ----------
    context
        Context of the device.
    device
    neighbors
        Which voxels a point is scored against.
    most
        Largest number of these voxels.
    extra
        More options for the driver's compiler.

    Raises
    ------
    KernelBuildFailed
        The driver refuses the program; the message has the beginning of its output.
    """
    import pyopencl as cl

    macros = {
        "DOUBLE": int(device.double),
        "IN_PLACE": int(device.in_place),
        "SEARCH": _SEARCH[neighbors],
        "MOST": most,
        "ITEM_PER_CHUNK": int(device.is_processor),
    }
    options = ["-cl-std=CL1.2", *(f"-D{name}={value}" for name, value in macros.items()), *extra]
    try:
        built = cl.Program(context, kernel_source()).build(options, devices=[device.handle])
    except cl.Error as error:
        lines = [line.strip() for line in str(error).splitlines() if line.strip()]
        said = next((line for line in lines if "error" in line.lower() and "clBuild" not in line), lines[0])
        raise KernelBuildFailed(
            f"the driver of device {device.info.name!r} cannot build the program: {said[:200]}",
            hint=f"is {device.info.platform} {device.info.driver} whole? another device: --device;"
            " `--backend numba` needs none",
        ) from None
    return cl.Kernel(built, "evaluate")
