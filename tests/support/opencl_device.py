# SPDX-License-Identifier: Apache-2.0
"""An OpenCL device: the machine's, used as a processor or as a GPU, or one whose program never ends.

``python -m tests.support.opencl_device align DEADLINE [FALLBACK]`` aligns a street twice on a device that
never ends, and prints what came of it; the process then has to end although the device stays busy.
``... program WORDS...`` is shmmap-ndt on such a device.
"""

from __future__ import annotations

import dataclasses
import gc
import json
import sys
import time

import numpy as np
import pytest
from shmmap_clients.ndt_scan_matcher import (
    DeviceError,
    DeviceOptions,
    Limits,
    NdtMatcher,
    Settings,
    matrix_from_pose,
)
from shmmap_clients.ndt_scan_matcher.backends import opencl_backend
from shmmap_clients.ndt_scan_matcher.backends.opencl.devices import Device, choose_device, list_devices
from shmmap_clients.ndt_scan_matcher.cli import main

from tests.clients.ndt_scan_matcher.scene import map_of, scan_from, street


def need_device() -> None:
    """Skip the test where nothing can compute."""
    pytest.importorskip("pyopencl", reason="pyopencl is not installed: pip install '.[opencl]'")
    if not any(info.fp64 and not info.unusable for info in list_devices()):
        pytest.skip("no OpenCL device with double precision: apt install pocl-opencl-icd")


def as_if(patch: pytest.MonkeyPatch, **says: object) -> None:
    """Let the device say something else of itself: ``kind="GPU"`` has a work-item for each point."""

    def chosen(options: DeviceOptions) -> Device:
        device = choose_device(options)
        return dataclasses.replace(device, info=dataclasses.replace(device.info, **says))  # type: ignore[arg-type]

    patch.setattr(opencl_backend, "choose_device", chosen)


# -- a device whose program never ends: ``python -m tests.support.opencl_device ACTION [WORDS...]``


_BEGIN = "    const int at = get_global_id(1);"
# volatile: a compiler may take a loop without effects for one that ends
_SPIN = "    volatile int spin = points;\n    while (spin > 0) spin = spin | 1;\n"


def hang() -> None:
    """Let every program that is built from now on never end."""
    source = opencl_backend.kernel_source()
    assert source.count(_BEGIN) == 1
    opencl_backend.kernel_source = lambda: source.replace(_BEGIN, _SPIN + _BEGIN)


def align(deadline_s: float, fallback: str | None) -> None:
    """Align twice, and print a line for each."""
    pose = np.array([1.3, 0.4, 1.8, 0.02, -0.03, 0.4])
    points = street()
    scan = scan_from(points, pose, 500)
    settings = Settings(backend="opencl", fallback=fallback)
    matcher = NdtMatcher(settings, limits=Limits(deadline_s=deadline_s))
    matcher.set_map(matcher.prepare(map_of(points, 2.0)))
    for _ in range(2):
        begin = time.monotonic()
        try:
            result = matcher.align(scan, matrix_from_pose(pose + 0.05))
        except DeviceError as error:
            said: dict[str, object] = {"error": error.code}
        else:
            said = {"converged": result.converged, "late": result.cut.deadline}
        fault = None if matcher.fault is None else matcher.fault.code
        print(json.dumps({**said, "fault": fault, "took_s": time.monotonic() - begin}), flush=True)
    matcher.close()
    del matcher
    gc.collect()
    # the device is still reading what the backend has
    assert [type(one) for one in opencl_backend._BUSY] == [opencl_backend.OpenclBackend]
    print("end", flush=True)


if __name__ == "__main__":
    hang()
    if sys.argv[1] == "align":
        align(float(sys.argv[2]), sys.argv[3] if len(sys.argv) > 3 else None)
    else:
        sys.exit(main(sys.argv[2:]))
