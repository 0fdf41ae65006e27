# SPDX-License-Identifier: Apache-2.0
"""`Backend`: the interface of all that compute score and derivatives, on any kind of hardware.

This module also has what backends share: the scan's buffer, the options of a device, the counts of bytes
written to a device, and the errors of devices.  None of these errors makes another device take over
silently::

    DeviceError
    ├── NoDevice           no driver, no such device, or the device lacks a required feature
    ├── KernelBuildFailed  the driver refuses the program
    ├── DeviceMemory       the device has less memory than the limits require
    └── DeviceHung         the device did not answer in time
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Final, Literal, Protocol, get_args

import numpy as np
from numpy.typing import NDArray

from shmmap import BadRequest, ShmmapError
from shmmap_clients.ndt_scan_matcher.map.voxel_map import VoxelMap
from shmmap_clients.ndt_scan_matcher.matching.evaluation import Evaluation, Scoring

Precision = Literal["auto", "double", "float"]
MapMemory = Literal["auto", "svm", "copy"]
_OUT_OF_MEMORY = (
    "MEM_OBJECT_ALLOCATION_FAILURE",
    "OUT_OF_RESOURCES",
    "OUT_OF_HOST_MEMORY",
    "INVALID_BUFFER_SIZE",
)
_LESS: Final = "lower limits (--max-voxels, --max-map-bytes, --max-points) need less"


@dataclass(frozen=True, slots=True)
class DeviceOptions:
    """Options of backends that compute on a device; other backends ignore them.

    Attributes
    ----------
    device
        Index or part of the name, as ``shmmap-ndt devices`` lists them.  None: the value of the variable
        ``SHMMAP_OPENCL_DEVICE``, or the first GPU, or else the first device.
    precision
        ``"auto"``: double where the device supports it.
    memory
        ``"svm"``: the device reads shared segments in place; ``"copy"``: each map is copied to the device;
        ``"auto"``: ``"svm"`` where the device reports support (``CL_DEVICE_SVM_FINE_GRAIN_SYSTEM``).
    """

    device: str | None = None
    precision: Precision = "auto"
    memory: MapMemory = "auto"

    def __post_init__(self) -> None:
        for name, value, known in (
            ("precision", self.precision, get_args(Precision)),
            ("memory", self.memory, get_args(MapMemory)),
        ):
            if value not in known:
                raise BadRequest(f"unknown {name} {value!r}", hint=f"it is {', '.join(known)}")


@dataclass(slots=True)
class UploadStatistics:
    """Counts of writes of maps to a device; all zero where the device reads maps in place.

    Attributes
    ----------
    written_bytes
        Bytes written, including the gaps between arrays.
    writes
        Number of writes: one for each map and kind of covariance.
    laid_out_again
        Maps that were written again because the buffer had no room for two kinds of covariance.
    """

    written_bytes: int = 0
    writes: int = 0
    laid_out_again: int = 0


class Backend(Protocol):
    """Evaluates poses of one scan against one map.

    An implementation allocates all memory that the limits allow in its constructor; nothing grows later.
    One object serves one thread at a time.
    """

    @property
    def name(self) -> str:
        """Name of the backend, a key of `BACKENDS`."""

    @property
    def on_device(self) -> bool:
        """Whether a device does the work, not the threads of this process."""

    @property
    def fault(self) -> DeviceError | None:
        """Reason why the fallback computes instead of the requested backend; None if it does not."""

    max_map_bytes: int
    """Largest map, see `Limits.map_bytes`: below that limit where a device has less memory."""

    @property
    def uploads(self) -> UploadStatistics:
        """Counts of writes of maps to a device; always the same object, updated in place."""

    def prepare(self, voxel_map: VoxelMap, scoring: Scoring) -> None:
        """Prepare this map, so that evaluations with it need not wait.

        Another thread may call it while evaluations use the current map.
        """

    def set_map(self, voxel_map: VoxelMap) -> None:
        """Match against this map from now on; keep a reference to it until the next call."""

    def set_source(self, points: NDArray[np.floating]) -> int:
        """Store a scan, (N, 3), metres, sensor or base frame; return the number of points above the limit."""

    def evaluate(self, poses: NDArray[np.float64], scoring: Scoring) -> list[Evaluation]:
        """Return score, gradient and Hessian at each of (k, 6) pose vectors; k up to the limit.

        The result of a pose is the same to the bit, whichever other poses are in the batch.

        Raises
        ------
        BadRequest
            The number of poses exceeds the limit.
        DeviceError
            A device failed, or did not answer before the scoring's deadline.
        """

    def step(self, at: Evaluation, steady: bool, /) -> NDArray[np.float64]:
        """Return the next step from an evaluation: `upward_step` if steady, else `newton_step`."""

    def close(self) -> None:
        """Release threads and memory, without waiting for a hung device."""


def check_batch(poses: NDArray[np.float64], most: int) -> None:
    """Refuse more poses than the limit that buffers were made for."""
    if len(poses) > most:
        raise BadRequest(f"{len(poses)} poses at once, the limit on poses is {most}")


class ScanBuffer:
    """Buffer for a scan of at most ``most`` points of type ``dtype``."""

    def __init__(self, most: int, dtype: np.dtype[Any] | type = np.float64) -> None:
        self._buffer: NDArray[Any] = np.empty((most, 3), dtype)
        self._count = 0

    @property
    def points(self) -> NDArray[Any]:
        """The scan, (N, 3), metres."""
        return self._buffer[: self._count]

    def take(self, points: NDArray[np.floating]) -> int:
        """Store a scan; return the number of points left out.

        Of n points, m are kept: point i of these is number floor(i n / m) of the scan.  The choice is
        deterministic and even over the whole scan.  Points that are not finite find no neighbour.
        """
        if points.ndim != 2 or points.shape[1] != 3:
            raise BadRequest(f"a scan must have shape (N, 3), this one has {points.shape}")
        given, most = len(points), len(self._buffer)
        self._count = min(given, most)
        if given <= most:
            with np.errstate(over="ignore"):
                self._buffer[:given] = points
        else:
            with np.errstate(over="ignore"):
                np.copyto(self._buffer, points[np.arange(most) * given // most], casting="same_kind")
        return given - self._count


class DeviceError(ShmmapError):
    """A device failed or cannot be used."""

    code = "device_error"
    exit_code = 69
    advice = "`shmmap-ndt warmup --backend opencl` tries it; `--backend numba` needs no device"


class NoDevice(DeviceError):
    """There is no such device, or it lacks a required feature."""

    code = "no_device"


class KernelBuildFailed(DeviceError):
    """The device's driver cannot build the program."""

    code = "kernel_build_failed"


class DeviceMemory(DeviceError):
    """The device has less memory than the limits require."""

    code = "device_memory"


class DeviceHung(DeviceError):
    """The device did not answer in time."""

    code = "device_hung"


@contextmanager
def device_errors(device: str, what: str) -> Iterator[None]:
    """Translate errors of pyopencl, and a lack of memory, into errors of this module.

    Parameters
    ----------
    device
        The device's name.
    what
        The operation, as in "device X cannot ...".
    """
    import pyopencl as cl

    try:
        yield
    except cl.Error as error:
        said = " ".join(str(error).split())[:300]
        if isinstance(error, cl.MemoryError) or any(name in said for name in _OUT_OF_MEMORY):
            raise DeviceMemory(
                f"device {device!r} has not enough memory to {what}: {said}",
                hint=_LESS,
            ) from None
        raise DeviceError(f"device {device!r} cannot {what}: {said}") from None
    except MemoryError as error:  # a processor as device uses the memory of this process
        raise DeviceMemory(
            f"device {device!r} has not enough memory to {what}: {error}", hint=_LESS
        ) from None
