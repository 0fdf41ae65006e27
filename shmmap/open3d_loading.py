# SPDX-License-Identifier: Apache-2.0
"""Load Open3D, or say which package of Python or of the system it lacks."""

from __future__ import annotations

import os
from typing import Any, Final

from shmmap.errors import PackageMissing, ShmmapError

SYSTEM_PACKAGES: Final = (
    "libegl1",
    "libgl1",
    "libx11-6",
    "libusb-1.0-0",
    "libgomp1",
    *(() if os.uname().machine == "x86_64" else ("libgfortran5",)),  # Open3D for other machines links to it
)
"""Packages of Debian and Ubuntu that Open3D needs on a machine without a desktop."""


def load_open3d(purpose: str) -> Any:
    """Return the open3d module; its first import in a process takes 1-2 s and 100-200 MB.

    Parameters
    ----------
    purpose
        The user of Open3D, as the subject of a sentence: ``"the layer normals"``.

    Raises
    ------
    PackageMissing
        Open3D or a package that it needs is not installed; the hint shows how to install it.
    ShmmapError
        Open3D cannot be loaded; the hint names what the system lacks.
    """
    try:
        import open3d
    except ModuleNotFoundError as error:
        cpu_only = "open3d-cpu" if os.uname().machine == "x86_64" else "open3d"  # as in pyproject.toml
        package = cpu_only if error.name == "open3d" else error.name
        raise PackageMissing(
            f"{purpose} needs the Python package Open3D, which is not installed"
            if error.name == "open3d"
            else f"{purpose} needs the Python package Open3D, which lacks the package {package}",
            hint=f"pip install {package}",
        ) from error
    except (ImportError, OSError) as error:
        raise ShmmapError(
            f"{purpose} needs the Python package Open3D, which cannot be loaded: {error}",
            hint=f"it needs the system packages {' '.join(SYSTEM_PACKAGES)}",
        ) from error
    return open3d
