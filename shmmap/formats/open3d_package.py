# SPDX-License-Identifier: Apache-2.0
"""Open3D, loaded where it is needed: 1-2 s and 100-200 MB, once in a process."""

from __future__ import annotations

import platform
from typing import Any, Final

from shmmap.errors import PackageMissing, ShmmapError

__all__ = ["SYSTEM_PACKAGES", "load_open3d"]

SYSTEM_PACKAGES: Final = (
    "libegl1", "libgl1", "libx11-6", "libusb-1.0-0",
    *(() if platform.machine() == "x86_64" else ("libgfortran5",)),  # its build for others links to it
)  # fmt: skip
"""Of Debian and Ubuntu, which Open3D needs where there is no desktop."""


def load_open3d(purpose: str, *, instead: str = "") -> Any:
    """Return the open3d module.

    Parameters
    ----------
    purpose
        What needs it, as the subject of a sentence: ``"the layer normals"``.
    instead
        What else can be done where the package is not installed: ``"or convert the file"``.

    Raises
    ------
    PackageMissing
        It, or a package that it needs, is not installed; the hint says how to install it.
    ShmmapError
        It cannot be loaded; the hint says what the system lacks.
    """
    try:
        import open3d
    except ModuleNotFoundError as error:
        cpu_only = "open3d-cpu" if platform.machine() == "x86_64" else "open3d"  # as in pyproject.toml
        package = cpu_only if error.name == "open3d" else error.name
        raise PackageMissing(
            f"{purpose} needs the Python package Open3D, which is not installed"
            if error.name == "open3d"
            else f"{purpose} needs the Python package Open3D, which lacks the package {package}",
            hint=f"pip install {package}{', ' if instead else ''}{instead}",
        ) from error
    except ImportError as error:
        raise ShmmapError(
            f"{purpose} needs the Python package Open3D, which cannot be loaded: {error}",
            hint=f"it needs the system packages {' '.join(SYSTEM_PACKAGES)}",
        ) from error
    return open3d
