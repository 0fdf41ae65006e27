# SPDX-License-Identifier: Apache-2.0
"""`Backend`: what computes score and derivatives, one small contract for several kinds of hardware.

Beside it stands what backends have in common: the scan's buffer, the options of a device, the count of what
was written to one, and what can be wrong with it.  After none of these errors is another device taken
silently::

    DeviceError
    ├── NoDevice           no driver, no such device, or it cannot do what was asked
    ├── KernelBuildFailed  the driver refuses the program
    ├── DeviceMemory       the device has not the memory that the limits ask for
    └── DeviceHung         it did not answer in time
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

__all__ = [
    "Backend",
    "DeviceError",
    "DeviceHung",
    "DeviceMemory",
    "DeviceOptions",
    "KernelBuildFailed",
    "MapMemory",
    "NoDevice",
    "Precision",
    "ScanBuffer",
    "UploadStatistics",
    "check_batch",
    "device_errors",
]

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
    """For backends that compute on a device; the others ignore it.

    Attributes
    ----------
    device
        Index or part of the name, as ``shmmap-ndt devices`` lists them; None: what the variable
        ``SHMMAP_OPENCL_DEVICE`` says, or the first GPU, else the first device.
    precision
        ``"auto"``: double where the device has it.
    memory
        ``"svm"``: shared segments are read where they lie; ``"copy"``: each map is copied to the device;
        ``"auto"``: the first where the device says that it can (``CL_DEVICE_SVM_FINE_GRAIN_SYSTEM``).
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
    """What was written to a device for maps; all zero where maps are read where they lie.

    Attributes
    ----------
    written_bytes
        With the gaps between arrays.
    writes
        One for each map and kind of covariance.
    laid_out_again
        Maps that were written again because two kinds of covariance had no room side by side.
    """

    written_bytes: int = 0
    writes: int = 0
    laid_out_again: int = 0


class Backend(Protocol):
    """Evaluates poses of one scan against one map.

    An implementation allocates what the limits allow when it is made, and nothing that grows later.
    One object serves one thread at a time.
    """

    @property
    def name(self) -> str:
        """As in `BACKENDS`."""

    @property
    def on_device(self) -> bool:
        """Whether the work is done elsewhere than in the threads of this process."""

    @property
    def fault(self) -> DeviceError | None:
        """Why another backend than the one that was asked for computes; None if it does not."""

    max_map_bytes: int
    """Of a map, see `Limits.map_bytes`: less than the limit where a device has not as much memory."""

    @property
    def uploads(self) -> UploadStatistics:
        """Counts of what was written to a device for maps; always the same object, which is updated."""

    def prepare(self, voxel_map: VoxelMap, scoring: Scoring) -> None:
        """Prepare this map, so that evaluations with it need not wait.

        It may be called in another thread, beside evaluations with the map in use.
        """

    def set_map(self, voxel_map: VoxelMap) -> None:
        """Match against this map from now on; it is kept alive until the next."""

    def set_source(self, points: NDArray[np.floating]) -> int:
        """Take a scan, (N, 3), metres, sensor or base frame; returns how many points the limit left out."""

    def evaluate(self, poses: NDArray[np.float64], scoring: Scoring) -> list[Evaluation]:
        """Return score, gradient and Hessian at each of (k, 6) pose vectors; k up to the limit.

        A pose has the same bits alone and among others.

        Raises
        ------
        BadRequest
            There are more poses than the limit.
        DeviceError
            A device failed, or has not answered at the scoring's deadline.
        """

    def step(self, at: Evaluation, steady: bool, /) -> NDArray[np.float64]:
        """Return the step that an evaluation asks for: `upward_step` if steady, else `newton_step`."""

    def close(self) -> None:
        """Give back threads and memory; a hung device is not waited for."""


def check_batch(poses: NDArray[np.float64], most: int) -> None:
    """Refuse more poses than the limit that buffers were made for."""
    if len(poses) > most:
        raise BadRequest(f"{len(poses)} poses at once, the limit on poses is {most}")


class ScanBuffer:
    """Room for a scan of at most ``most`` points, as numbers of ``dtype``."""

    def __init__(self, most: int, dtype: np.dtype[Any] | type = np.float64) -> None:
        self._buffer: NDArray[Any] = np.empty((most, 3), dtype)
        self._count = 0

    @property
    def points(self) -> NDArray[Any]:
        """The scan, (N, 3), metres."""
        return self._buffer[: self._count]

    def take(self, points: NDArray[np.floating]) -> int:
        """Take a scan; returns how many points were left out.

        Point i of the kept m is floor(i n / m) of the given n: the same ones each time, and evenly over
        the whole scan, whatever its order.  Points that are not finite find no neighbour.
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
    """A device cannot do what it is asked to."""

    code = "device_error"
    exit_code = 69
    advice = "`shmmap-ndt device-check` examines it; `--backend numba` needs no device"


class NoDevice(DeviceError):
    """There is no such device, or it cannot do what was asked."""

    code = "no_device"


class KernelBuildFailed(DeviceError):
    """The device's driver cannot build the program."""

    code = "kernel_build_failed"


class DeviceMemory(DeviceError):
    """The device has not as much memory as the limits ask for."""

    code = "device_memory"


class DeviceHung(DeviceError):
    """The device did not answer in time."""

    code = "device_hung"


@contextmanager
def device_errors(device: str, what: str) -> Iterator[None]:
    """Turn pyopencl's errors, and a lack of memory, into those of this module.

    Parameters
    ----------
    device
        The device's name.
    what
        What is asked of it, as in "device X cannot ...".
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
    except MemoryError as error:  # of this process, which a processor's memory is
        raise DeviceMemory(
            f"device {device!r} has not enough memory to {what}: {error}", hint=_LESS
        ) from None
