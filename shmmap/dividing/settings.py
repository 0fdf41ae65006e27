# SPDX-License-Identifier: Apache-2.0
"""Settings for dividing a map, and the remaining memory."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from typing import Final

from shmmap.dividing.frame import Translation
from shmmap.dividing.lattice import CellLattice
from shmmap.dividing.sources import AXES
from shmmap.errors import BadRequest
from shmmap.formats.pcd.header import ENCODINGS


@dataclass(frozen=True, slots=True)
class DivideSettings:
    """Settings for dividing a map.

    Attributes
    ----------
    cell_size
        Side of a cell, metres, at most 6 decimals.
    origin
        A corner of the lattice of cells, metres, in the frame of the inputs.
    translate
        Translation of every point, ``auto`` or ``none``; see `shmmap.dividing.frame`.
    frame_before
        Translation that ``auto`` prefers if float32 is then precise enough: that of the cloud's earlier
        state, so that the map keeps its frame.
    unit, vertical_unit
        Units of the inputs' coordinates, in the plane and in height; see `shmmap.dividing.frame`.
    leaf
        Side of the voxels that are reduced to one point each, metres; 0 keeps every point.
    prefix
        Start of every file name.
    encoding
        Encoding of the PCD files: ``binary``, ``binary_compressed`` or ``ascii``.
    memory_bytes
        Memory limit of the process, including code and libraries.
    common_fields
        Keep only the common fields if the inputs' fields differ.
    drop_noise
        Leave out points that LAS classifies as noise (classes 7 and 18).
    fields
        Fields to keep, including x, y and z; empty: all.
    force
        Replace an existing divided map.
    resume
        Resume a killed run that had the same inputs and settings.
    check
        Before the map appears, read everything back and check that each point is in its cell.
    durable
        Flush the map to the disk before it appears.
    checkpoint_s
        Seconds between saves of the state to resume from.
    """

    cell_size: float = 20.0
    origin: tuple[float, float] = (0.0, 0.0)
    translate: Translation = "auto"
    frame_before: tuple[float, float, float] | None = None
    unit: str = ""
    vertical_unit: str = ""
    leaf: float = 0.0
    prefix: str = ""
    encoding: str = "binary"
    memory_bytes: int = 1 << 30
    common_fields: bool = False
    drop_noise: bool = False
    fields: tuple[str, ...] = ()
    force: bool = False
    resume: bool = False
    check: bool = False
    durable: bool = True
    checkpoint_s: float = 5.0


def lattice_of(settings: DivideSettings) -> CellLattice:
    """Check the settings and return the lattice of cells, in the frame of the inputs.

    Raises
    ------
    BadRequest
        A setting is invalid.
    """
    lattice = CellLattice.of(settings.cell_size, settings.origin)
    if settings.leaf:
        if not settings.leaf > 0:
            raise BadRequest(f"the leaf must be a positive number of metres, not {settings.leaf}")
        CellLattice.of(settings.leaf, settings.origin)
        if settings.leaf > settings.cell_size:
            raise BadRequest(f"voxels of {settings.leaf} m are larger than cells of {settings.cell_size} m")
    # hidden files do not count as clouds of a directory
    if "/" in settings.prefix or settings.prefix.startswith(".") or not settings.prefix.isprintable():
        raise BadRequest(f"{settings.prefix!r} cannot start a file name")
    if settings.encoding not in ENCODINGS:
        raise BadRequest(f"encoding {settings.encoding!r} is not one of {', '.join(ENCODINGS)}")
    if settings.fields and (missing := [axis for axis in AXES if axis not in settings.fields]):
        raise BadRequest(
            f"the fields to keep lack {', '.join(missing)}", hint="name x, y and z, too: x,y,z,intensity"
        )
    if isinstance(settings.translate, tuple):
        if not all(map(math.isfinite, settings.translate)):
            raise BadRequest("a translation is three numbers of metres")
        lattice.moved(*settings.translate[:2])  # refuses sizes without exact corners
    if settings.memory_bytes < MIN_MEMORY_BYTES:
        raise BadRequest(
            f"{settings.memory_bytes:,} bytes of memory are too little",
            hint=f"at least {MIN_MEMORY_BYTES >> 20}M: code and libraries are counted",
        )
    return lattice


MIN_MEMORY_BYTES: Final = 384 << 20
"""The smallest useful limit: Python, numpy, numba and its compiler take 200 MiB."""

_SPARE_BYTES: Final = 96 << 20  # for the compiler, the decompressors and the tables of cells


def memory_left(limit_bytes: int) -> int:
    """Return the bytes that this process may still take under ``limit_bytes``, less a reserve."""
    with open("/proc/self/statm", "rb") as file:
        resident = int(file.read().split()[1]) * os.sysconf("SC_PAGESIZE")
    return max(32 << 20, limit_bytes - resident - _SPARE_BYTES)


def peak_memory_bytes() -> int:
    """Return the peak resident memory of this program.

    It is read from ``VmHWM``, since ``ru_maxrss`` includes the peak of the process that started this one.
    """
    with open("/proc/self/status", "rb") as file:
        for line in file:
            if line.startswith(b"VmHWM:"):
                return int(line.split()[1]) << 10
    raise OSError("/proc/self/status has no VmHWM")
