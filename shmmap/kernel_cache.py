# SPDX-License-Identifier: Apache-2.0
"""Where compiled kernels are kept, and whether those of the layers are there; without importing numba.

``NUMBA_CACHE_DIR`` where that is set, else ``$CACHE_DIRECTORY/kernels`` (a service), else
``$XDG_CACHE_HOME/shmmap/kernels`` or ``~/.cache/shmmap/kernels``.
"""

from __future__ import annotations

import importlib.util
import os
import sys
from pathlib import Path

from shmmap import __version__

__all__ = ["compiled_mark", "kernel_directory"]


def kernel_directory() -> Path | None:
    """Directory of compiled kernels, made if missing; None where none can be written."""
    named = os.environ.get("NUMBA_CACHE_DIR")
    service = os.environ.get("CACHE_DIRECTORY", "").split(":")[0]
    base = os.environ.get("XDG_CACHE_HOME", "")
    try:
        if named:
            path = Path(named)
        elif service:
            path = Path(service) / "kernels"
        else:
            path = (Path(base) if base.startswith("/") else Path.home() / ".cache") / "shmmap" / "kernels"
        path.mkdir(parents=True, exist_ok=True, mode=0o700)
        return path if os.access(path, os.W_OK | os.X_OK) else None
    except (OSError, RuntimeError):  # RuntimeError: no home directory
        return None


def compiled_mark() -> Path | None:
    """The file that says that all kernels of layers are compiled, for this version, Python and numba.

    None where they cannot be kept, or there is no numba.
    """
    directory, numba = kernel_directory(), importlib.util.find_spec("numba")
    if directory is None or numba is None or not numba.origin:
        return None
    try:
        which = os.stat(numba.origin).st_mtime_ns
    except OSError:
        return None
    return directory / f"layers-{__version__}-{sys.implementation.cache_tag}-{which:x}.compiled"
