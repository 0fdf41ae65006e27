# SPDX-License-Identifier: Apache-2.0
"""Write archives of arrays for `numpy.load`; an interrupt during writing causes no second error."""

from __future__ import annotations

import contextlib
import zipfile
from collections.abc import Iterator, Mapping
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from shmmap.processes.interrupts import interrupts_later


@contextlib.contextmanager
def npz_archive(file: IO[bytes], compression: int = zipfile.ZIP_STORED) -> Iterator[zipfile.ZipFile]:
    """Open an archive on a file for writing, and complete it unless the block raises."""
    archive: zipfile.ZipFile | None = None
    try:
        with interrupts_later():
            archive = zipfile.ZipFile(file, "w", compression)
        yield archive
        archive.close()
    except BaseException:
        if archive is not None:
            archive.fp = None  # else the finalizer would close it, which fails after an interrupt
        raise


def write_npz(file: IO[bytes], arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays of any name; `numpy.savez` does not accept the name "file"."""
    with npz_archive(file) as archive:
        for name, values in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, values, allow_pickle=False)
