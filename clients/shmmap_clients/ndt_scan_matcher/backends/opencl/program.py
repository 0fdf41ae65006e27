# SPDX-License-Identifier: Apache-2.0
"""The program for a device: its source, the options it is built with, and what a failing build says."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import resources
from typing import Any, Final

from shmmap_clients.ndt_scan_matcher.backends.backend import Neighbors
from shmmap_clients.ndt_scan_matcher.backends.opencl.devices import Device
from shmmap_clients.ndt_scan_matcher.backends.opencl.errors import KernelBuildFailed

__all__ = ["build_kernel", "build_options", "kernel_source"]

_SEARCH: Final = {"direct1": 1, "direct7": 7, "radius": 27}


def kernel_source() -> str:
    """Return the program's source, OpenCL C 1.2."""
    return resources.files(__package__).joinpath("evaluate.cl").read_text(encoding="utf-8")


def build_options(device: Device, neighbors: Neighbors, most: int) -> list[str]:
    """Return the options that the source is built with.

    Parameters
    ----------
    device
    neighbors
        Which voxels a point is scored against.
    most
        And how many of them at most.
    """
    macros = {
        "DOUBLE": int(device.double),
        "IN_PLACE": int(device.in_place),
        "SEARCH": _SEARCH[neighbors],
        "MOST": most,
        "ITEM_PER_CHUNK": int(device.is_processor),
    }
    return ["-cl-std=CL1.2", *(f"-D{name}={value}" for name, value in macros.items())]


def build_kernel(
    context: Any, device: Device, neighbors: Neighbors, most: int, *, extra: Sequence[str] = ()
) -> Any:
    """Return the kernel for a device, a new one; drivers keep what they have built, and build once.

    Parameters
    ----------
    context
        Of the device.
    device, neighbors, most
        As in `build_options`.
    extra
        More options for the driver's compiler.

    Raises
    ------
    KernelBuildFailed
        With the beginning of what the driver says.
    """
    import pyopencl as cl

    program = cl.Program(context, kernel_source())
    try:
        built = program.build([*build_options(device, neighbors, most), *extra], devices=[device.handle])
    except cl.Error as error:
        lines = [line.strip() for line in str(error).splitlines() if line.strip()]
        told = next((line for line in lines if "error" in line.lower() and "clBuild" not in line), lines[0])
        raise KernelBuildFailed(
            f"the driver of device {device.info.name!r} cannot build the program: {told[:200]}",
            hint=f"is {device.info.platform} {device.info.driver} whole? another device: --device;"
            " `--backend numba` needs none",
        ) from None
    return cl.Kernel(built, "evaluate")
