# SPDX-License-Identifier: Apache-2.0
"""A file system that never answers, as of a server that is away: FUSE without a program behind it."""

from __future__ import annotations

import ctypes
import os
from pathlib import Path

_DETACH = 2
_libc = ctypes.CDLL(None, use_errno=True)


class HangingDirectory:
    """Hangs over a directory until `end`: then that is as it was.

    Raises
    ------
    OSError
        This process may not mount, or the kernel has no FUSE.
    """

    def __init__(self, path: Path) -> None:
        self._path = os.fsencode(path)
        self._fd = os.open("/dev/fuse", os.O_RDWR | os.O_CLOEXEC)
        options = b"fd=%d,rootmode=40000,user_id=%d,group_id=%d,allow_other" % (
            self._fd,
            os.geteuid(),
            os.getegid(),
        )
        if _libc.mount(b"hangs", self._path, b"fuse", 0, options):
            number = ctypes.get_errno()
            os.close(self._fd)
            raise OSError(number, os.strerror(number))

    def end(self) -> None:
        """Unmount it: waiting processes get an error."""
        if self._fd >= 0:
            _libc.umount2(self._path, _DETACH)
            os.close(self._fd)
            self._fd = -1
