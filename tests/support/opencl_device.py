# SPDX-License-Identifier: Apache-2.0
"""An OpenCL device for tests: the machine's, used as a processor or as a GPU would be."""

from __future__ import annotations

import dataclasses

import pytest
from shmmap_clients.ndt_scan_matcher import DeviceOptions
from shmmap_clients.ndt_scan_matcher.backends import opencl_backend
from shmmap_clients.ndt_scan_matcher.backends.opencl.devices import Device, choose_device, list_devices

__all__ = ["as_if", "need_device"]


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
