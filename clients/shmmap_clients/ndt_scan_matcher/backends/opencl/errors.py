# SPDX-License-Identifier: Apache-2.0
"""What can be wrong with a device; after none of these is another one taken silently.

::

    DeviceError
    ├── NoDevice           no driver, no such device, or it cannot do what was asked
    ├── KernelBuildFailed  the driver refuses the program
    ├── DeviceMemory       the device has not the memory that the limits ask for
    └── DeviceHung         it did not answer in time
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from shmmap import ShmmapError

__all__ = ["DeviceError", "DeviceHung", "DeviceMemory", "KernelBuildFailed", "NoDevice", "device_errors"]

_OUT_OF_MEMORY = (
    "MEM_OBJECT_ALLOCATION_FAILURE",
    "OUT_OF_RESOURCES",
    "OUT_OF_HOST_MEMORY",
    "INVALID_BUFFER_SIZE",
)
_LESS: Final = "lower limits (--max-voxels, --max-map-bytes, --max-points) need less"


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
