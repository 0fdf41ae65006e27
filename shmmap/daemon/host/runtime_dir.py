# SPDX-License-Identifier: Apache-2.0
"""The directory of the sockets and of the lock."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

from shmmap.errors import CannotStart
from shmmap.logfmt import log
from shmmap.protocol.endpoint import fallback_runtime_dir, why_not_private

__all__ = ["make_runtime_dir"]


def make_runtime_dir(path: Path, gid: int) -> None:
    """Make the directory of the socket, for the owner and, where there is one, the group.

    Raises
    ------
    CannotStart
        It cannot be made, or in /tmp another account has made it.
    """
    if str(path) == fallback_runtime_dir():
        _make_private(path)
        return
    if path.is_dir():
        return
    try:
        path.mkdir(mode=0o750 if gid >= 0 else 0o700, parents=True, exist_ok=True)
        if gid >= 0:
            os.chown(path, -1, gid)
    except OSError as error:
        raise CannotStart(
            f"runtime directory {path}: {error.strerror}", hint="make it, or give another --runtime-dir"
        ) from error


def _make_private(path: Path) -> None:
    """Make the directory in /tmp that is used without ``XDG_RUNTIME_DIR``, for the owner alone."""
    with contextlib.suppress(FileExistsError):
        path.mkdir(mode=0o700)
    if why := why_not_private(str(path)):
        raise CannotStart(
            f"runtime directory {path}: {why}",
            hint="see whose it is and remove it, or set XDG_RUNTIME_DIR, or give --runtime-dir",
        )
    log.info("runtime directory", path=path, reason="XDG_RUNTIME_DIR is not set")
