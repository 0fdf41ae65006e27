# SPDX-License-Identifier: Apache-2.0
"""The bridge's status for ``shmmap doctor``: a small file beside the daemon's socket.

Its name is ``INSTANCE.ros-bridge-DOMAIN.json``. A running bridge holds a lock on the file (fcntl(2)): the
file of a killed bridge is ignored, and no second bridge answers the same requests. The file is rewritten in
place by one call, padded with blanks to its former length, so that no reader sees a partial status.

If the daemon's directory is not writable, the file is in the user's own, ``$XDG_RUNTIME_DIR/shmmap``; if
that is not writable either, there is no file.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import stat
from collections.abc import Mapping
from typing import Any, Final

from shmmap.errors import Busy

_MODE: Final = 0o644


def status_name(instance: str, domain: int) -> str:
    """Return the file's name."""
    return f"{instance}.ros-bridge-{domain}.json"


class StatusFile:
    """The status file, which exists while the bridge runs.

    Parameters
    ----------
    endpoint
        The daemon's socket.
    instance, domain
        Instance of the daemon, and DDS domain of the bridge.

    Attributes
    ----------
    path
        Path of the file; empty if it could not be created.

    Raises
    ------
    Busy
        Another bridge of this daemon runs in this domain.
    """

    def __init__(self, endpoint: str, instance: str, domain: int) -> None:
        self.path = ""
        self._fd = -1
        self._written = 0
        own = os.environ.get("XDG_RUNTIME_DIR", "")
        for place in (os.path.dirname(endpoint), f"{own}/shmmap" if own.startswith("/") else ""):
            if place and self._take(f"{place}/{status_name(instance, domain)}"):
                return

    def _take(self, path: str) -> bool:
        flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
        while True:
            try:
                fd = os.open(path, flags, _MODE)
            except OSError:
                return False  # not writable for this user, or no such directory
            try:
                fcntl.lockf(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
                status = os.fstat(fd)
                same = os.path.samestat(status, os.stat(path, follow_symlinks=False))
            except (BlockingIOError, PermissionError):  # POSIX allows either error
                os.close(fd)
                raise Busy(
                    f"another bridge of this daemon runs in this domain: it holds {path}",
                    hint="stop it, or choose another --domain",
                ) from None
            except FileNotFoundError:  # the previous bridge is just ending
                same = False
            if same and stat.S_ISREG(status.st_mode):
                self.path, self._fd, self._written = path, fd, status.st_size
                return True
            os.close(fd)
            if same:
                return False

    def write(self, status: Mapping[str, Any]) -> None:
        """Replace the status."""
        if self._fd < 0:
            return
        data = json.dumps(status).encode() + b"\n"
        data = data.ljust(self._written)
        with contextlib.suppress(OSError):  # on a full disk the last status stays
            self._written = max(self._written, os.pwrite(self._fd, data, 0))

    def close(self) -> None:
        """Remove the file."""
        if self._fd >= 0:
            with contextlib.suppress(OSError):
                os.unlink(self.path)
            os.close(self._fd)
            self._fd = -1
