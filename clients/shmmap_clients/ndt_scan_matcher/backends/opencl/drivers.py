# SPDX-License-Identifier: Apache-2.0
"""Drivers that are installed, but that nothing tells the loader of.

The loader reads files in /etc/OpenCL/vendors, each of which names a driver's library.  Containers with
NVIDIA's driver often have the library without the file: then a folder with one is made for this process,
with copies of those that are there.
"""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Final

__all__ = ["make_drivers_known", "vendors_with_nvidia"]

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


def vendors_with_nvidia(vendors: Path, folders: Iterable[Path]) -> Path | None:
    """Return a new folder of vendors' files that names NVIDIA's driver, too; None where none is needed.

    Parameters
    ----------
    vendors
        What the loader reads.
    folders
        Where the driver's library may be.
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


def make_drivers_known() -> None:
    """Let the loader find NVIDIA's driver; to be called before it is loaded."""
    if "OCL_ICD_VENDORS" in os.environ:
        return
    made = vendors_with_nvidia(_VENDORS, _FOLDERS)
    if made is not None:
        os.environ["OCL_ICD_VENDORS"] = str(made)
        atexit.register(shutil.rmtree, made, ignore_errors=True)
