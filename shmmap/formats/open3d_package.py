# SPDX-License-Identifier: Apache-2.0
"""Open3D, loaded where it is needed: 1-2 s and 100-200 MB, once in a process."""

from __future__ import annotations

from typing import Any

from shmmap.errors import ShmmapError

__all__ = ["load_open3d"]


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
    ShmmapError
        It cannot be loaded; the hint says what is missing.
    """
    try:
        import open3d
    except ModuleNotFoundError as error:
        if error.name != "open3d":  # it is there, and lacks something itself
            raise ShmmapError(
                f"{purpose} needs the Python package Open3D, which lacks a package itself: {error}",
                hint=f"pip install {error.name}",
            ) from error
        hint = f"pip install open3d{', ' if instead else ''}{instead}"
        raise ShmmapError(
            f"{purpose} needs the Python package Open3D, which is not installed", hint=hint
        ) from error
    except ImportError as error:
        raise ShmmapError(
            f"{purpose} needs the Python package Open3D, which cannot be loaded: {error}",
            hint="it needs the system packages libegl1 libgl1 libx11-6 libusb-1.0-0",
        ) from error
    return open3d
