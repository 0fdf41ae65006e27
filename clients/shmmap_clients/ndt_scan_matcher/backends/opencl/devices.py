# SPDX-License-Identifier: Apache-2.0
"""OpenCL devices of this machine: their list, their features, the choice of one, and waiting for it.

OpenCL finds drivers by files in /etc/OpenCL/vendors, each of which names a driver's library.  Containers with
NVIDIA's driver often have the library without its file.  Then this process uses its own folder, with copies
of all these files and an additional one for NVIDIA's library.
"""

from __future__ import annotations

import atexit
import ctypes
import os
import shutil
import tempfile
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from shmmap_clients.ndt_scan_matcher.backends.backend import DeviceError, DeviceHung, DeviceOptions, NoDevice

_VARIABLE: Final = "SHMMAP_OPENCL_DEVICE"
NO_DRIVER_HINT: Final = (
    "`apt install pocl-opencl-icd` brings one for processors, the vendor's package one for its GPU; in a"
    " container, /etc/OpenCL/vendors must have the driver's .icd file, too; PoCL without a cache directory"
    " that it can write (POCL_CACHE_DIR) shows no device"
)
_PREFERENCE: Final = ("GPU", "accelerator", "CPU", "other")
_VENDORS: Final = Path("/etc/OpenCL/vendors")
_NVIDIA: Final = "libnvidia-opencl.so.1"
_FOLDERS: Final = tuple(
    Path(folder)
    for folder in (
        "/usr/lib/x86_64-linux-gnu",
        "/usr/lib/aarch64-linux-gnu",
        "/usr/lib64",
        "/usr/lib",
        "/usr/local/nvidia/lib64",
        "/usr/local/cuda/compat",
    )
)
TIMEOUT_S: Final = 10.0  # for any command without an earlier deadline
_NAP_S: Final = 20e-6


@dataclass(frozen=True, slots=True)
class DeviceInfo:
    """Properties that a device reports.

    Attributes
    ----------
    index
        Index by which the device can be chosen.
    name, platform, driver
    kind
        ``"GPU"``, ``"accelerator"``, ``"CPU"`` or ``"other"``.
    fp64
        Whether the device supports double precision.
    memory_bytes, max_bytes
        Memory of the device, and the largest size of one buffer.
    unified
        Whether the device shares the processor's memory.
    svm_system
        Whether the device reads all memory of the process (``CL_DEVICE_SVM_FINE_GRAIN_SYSTEM``).
    unusable
        Why the device cannot be used; empty if it can.
    """

    index: int
    name: str
    platform: str
    driver: str
    kind: str
    fp64: bool
    memory_bytes: int
    max_bytes: int
    unified: bool
    svm_system: bool
    unusable: str

    def describe(self) -> str:
        """Return a one-line description for users."""
        able = [
            self.kind,
            f"driver {self.platform} {self.driver}",
            "double" if self.fp64 else "float only",
            f"{self.memory_bytes / 2**30:.1f} GiB{' shared with the processor' if self.unified else ''}",
        ]
        able.append("reads segments in place" if self.svm_system else "map is copied")
        return f"{self.index}  {self.name}: {', '.join(able)}; {self.unusable or 'usable'}"


@dataclass(frozen=True, slots=True)
class Device:
    """A chosen device, ready to use.

    Attributes
    ----------
    info
    handle
        The ``pyopencl.Device``.
    double
        Whether the device computes in double precision.
    in_place
        Whether the device reads the map's segments in place.
    """

    info: DeviceInfo
    handle: Any
    double: bool
    in_place: bool

    @property
    def is_processor(self) -> bool:
        """Whether work-items of the device are threads of a processor."""
        return self.info.kind == "CPU"


def list_devices() -> list[DeviceInfo]:
    """Return all devices, in the order of their indices.

    Raises
    ------
    ModuleNotFoundError
        pyopencl is not installed.
    """
    return [info for info, _ in _found()]


def choose_device(options: DeviceOptions) -> Device:
    """Return the requested device, never another one.

    Raises
    ------
    NoDevice
        There is no such device, or it lacks a required feature.
    ModuleNotFoundError
        pyopencl is not installed.
    """
    found = _found()
    if not found:
        raise NoDevice(
            "no OpenCL device: no driver is installed, or none of them has a device", hint=NO_DRIVER_HINT
        )
    wanted = options.device if options.device is not None else os.environ.get(_VARIABLE) or None
    info, handle = _first_preferred(found) if wanted is None else _named(found, wanted)
    if info.unusable:
        raise NoDevice(f"device {info.name!r} cannot be used: {info.unusable}")
    if options.precision == "double" and not info.fp64:
        raise NoDevice(
            f"device {info.name!r} has no double precision (cl_khr_fp64)",
            hint="--precision float asks for less",
        )
    double = info.fp64 if options.precision == "auto" else options.precision == "double"
    if options.memory == "svm" and not double:
        # A device without doubles cannot read them.  A device whose doubles are slow, and which is set to
        # floats, would subtract and convert nine doubles for each neighbour at each evaluation, at the slow
        # rate and with twice the bytes read.  Copying the map converts them once.
        raise NoDevice(
            "segments have double precision: a program that computes with floats cannot read them in place",
            hint="--memory copy, or --precision double",
        )
    in_place = double and (options.memory == "svm" or (options.memory == "auto" and info.svm_system))
    return Device(info, handle, double, in_place)


def _named(found: list[tuple[DeviceInfo, Any]], wanted: str) -> tuple[DeviceInfo, Any]:
    for info, handle in found:
        if wanted == str(info.index) or (not wanted.isdigit() and wanted.lower() in info.name.lower()):
            return info, handle
    have = "; ".join(f"{info.index} {info.name}" for info, _ in found)
    raise NoDevice(f"no OpenCL device {wanted!r}", hint=f"by index or part of the name: {have}")


def _first_preferred(found: list[tuple[DeviceInfo, Any]]) -> tuple[DeviceInfo, Any]:
    usable = [one for one in found if not one[0].unusable] or found
    return min(usable, key=lambda one: _PREFERENCE.index(one[0].kind))


def _found() -> list[tuple[DeviceInfo, Any]]:
    os.environ.setdefault(
        "PYOPENCL_NO_CACHE", "1"
    )  # pyopencl's own cache fails where its folder is not writable
    _make_drivers_known()
    import pyopencl as cl

    try:
        platforms = cl.get_platforms()
    except cl.Error:  # "platform not found": there is no driver at all
        return []
    found = []
    for platform in platforms:
        try:
            handles = platform.get_devices()
        except cl.Error:
            continue
        found += [(platform, handle) for handle in handles]
    return [(_info(cl, index, platform, handle), handle) for index, (platform, handle) in enumerate(found)]


def _info(cl: Any, index: int, platform: Any, handle: Any) -> DeviceInfo:
    def asked(name: str, default: Any) -> Any:
        try:
            return getattr(handle, name)
        except cl.Error:  # an older driver does not support this query
            return default

    kinds = {
        cl.device_type.GPU: "GPU",
        cl.device_type.ACCELERATOR: "accelerator",
        cl.device_type.CPU: "CPU",
    }
    kind = next((word for bit, word in kinds.items() if handle.type & bit), "other")
    unusable = ""
    if not handle.available or not handle.compiler_available:
        unusable = "its driver has no compiler" if handle.available else "it is not available"
    elif not handle.endian_little:
        unusable = "its numbers are big-endian"
    elif handle.max_work_group_size < 128:
        unusable = f"its work-groups have at most {handle.max_work_group_size} work-items, 128 are needed"
    svm = asked("svm_capabilities", 0)
    return DeviceInfo(
        index=index,
        name=handle.name.strip(),
        platform=platform.name.strip(),
        driver=handle.driver_version.strip(),
        kind=kind,
        fp64="cl_khr_fp64" in handle.extensions.split() or bool(asked("double_fp_config", 0)),
        memory_bytes=int(handle.global_mem_size),
        max_bytes=int(handle.max_mem_alloc_size),
        unified=bool(asked("host_unified_memory", False)),
        svm_system=bool(svm & cl.device_svm_capabilities.FINE_GRAIN_SYSTEM) and handle.address_bits == 64,
        unusable=unusable,
    )


def vendors_with_nvidia(vendors: Path, folders: Iterable[Path]) -> Path | None:
    """Return a new folder of vendors' files that includes NVIDIA's driver; None where none is needed.

    Parameters
    ----------
    vendors
        Folder that OpenCL's loader reads.
    folders
        Folders that may contain the driver's library.
    """
    named = sorted(vendors.glob("*.icd")) if vendors.is_dir() else []
    if any("nvidia" in file.read_text(encoding="utf-8", errors="replace") for file in named):
        return None
    library = next((folder / _NVIDIA for folder in folders if (folder / _NVIDIA).exists()), None)
    if library is None:
        return None
    made = Path(tempfile.mkdtemp(prefix="shmmap-opencl-"))
    for file in named:
        shutil.copy(file, made)
    (made / "nvidia.icd").write_text(f"{library}\n", encoding="utf-8")
    return made


def _make_drivers_known() -> None:
    """Make OpenCL's loader find NVIDIA's driver; call this before the first call of OpenCL."""
    if "OCL_ICD_VENDORS" in os.environ:
        return
    made = vendors_with_nvidia(_VENDORS, _FOLDERS)
    if made is not None:
        os.environ["OCL_ICD_VENDORS"] = str(made)
        atexit.register(shutil.rmtree, made, ignore_errors=True)


class Waiting:
    """Waits for events of one device.

    A wait sleeps for most of the time that the last wait took, then polls.  So it uses little processor
    time, and ends microseconds after the event.

    Parameters
    ----------
    device
        Name of the device, for errors.
    """

    def __init__(self, device: str) -> None:
        self._device = device
        self._usual_s = 0.0

    def until(self, event: Any, deadline_s: float | None = None) -> None:
        """Wait until a command has ended.

        Parameters
        ----------
        event
            Event of the command, whose queue has been flushed.
        deadline_s
            Deadline on `time.monotonic`; None: `TIMEOUT_S` from now.

        Raises
        ------
        DeviceHung
            The command has not ended at the deadline.
        DeviceError
            The command failed.
        """
        began_s = time.monotonic()
        latest_s = began_s + TIMEOUT_S
        if deadline_s is not None:
            latest_s = min(latest_s, deadline_s)
        if self._usual_s > 4 * _NAP_S and not _ended(event):
            time.sleep(min(0.6 * self._usual_s, max(latest_s - began_s, 0.0)))
        while not _ended(event):
            if time.monotonic() >= latest_s:
                _never_free(event)
                raise DeviceHung(
                    f"device {self._device!r} has not answered within {time.monotonic() - began_s:.3f} s",
                    hint="a higher --deadline gives it more time; --fallback numba goes on without it",
                )
            time.sleep(_NAP_S)
        status = event.command_execution_status
        if status < 0:
            raise DeviceError(f"device {self._device!r} failed: OpenCL error {status}")
        took_s = time.monotonic() - began_s
        self._usual_s = min(took_s, 0.9 * self._usual_s + 0.1 * took_s) if self._usual_s else took_s


def _ended(event: Any) -> bool:
    return bool(event.command_execution_status <= 0)  # CL_COMPLETE is 0, an error is negative


def _never_free(event: Any) -> None:
    """Keep an event until the process ends: freeing it would wait for a hung device, even at exit."""
    ctypes.pythonapi.Py_IncRef(ctypes.py_object(event))
