# SPDX-License-Identifier: Apache-2.0
"""Which device a backend computes on, how precisely, and where the map lies for it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from shmmap import BadRequest

__all__ = ["DeviceOptions", "MapMemory", "Precision"]

Precision = Literal["auto", "double", "float"]
MapMemory = Literal["auto", "svm", "copy"]


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
        ``"svm"``: shared segments are read where they lie; ``"copy"``: each cell is copied to the device
        once; ``"auto"``: the first where the device says that it can (``CL_DEVICE_SVM_FINE_GRAIN_SYSTEM``).
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
