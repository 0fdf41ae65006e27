# SPDX-License-Identifier: Apache-2.0
"""One daemon per instance: whoever binds takes a live socket's place, so a lock comes first."""

from __future__ import annotations

import contextlib
import fcntl
import os
from pathlib import Path
from typing import Final

from shmmap.errors import InstanceBusy
from shmmap.segment.taken_name import name_taken

__all__ = ["InstanceLock"]

_OTHERWISE: Final = "choose another --instance or --runtime-dir"


class InstanceLock:
    """An exclusive ``flock`` on a file, held for the daemon's life and removed with it.

    Parameters
    ----------
    path
        It says the process id, for the message to whoever comes second.

    Raises
    ------
    InstanceBusy
        Somebody holds it; the message names the process.
    CannotStart
        The file cannot be made, or is another user's.
    """

    def __init__(self, path: str) -> None:
        self.path = path
        while True:
            try:
                fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
            except OSError as error:
                raise name_taken("the lock file", path, error, otherwise=_OTHERWISE) from error
            if os.fstat(fd).st_uid not in (os.geteuid(), 0):  # who made it could hold it for ever
                os.close(fd)
                raise name_taken("the lock file", path, None, otherwise=_OTHERWISE)
            try:
                fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                owner = os.pread(fd, 64, 0).decode(errors="replace").strip()
                os.close(fd)
                raise InstanceBusy(
                    f"another daemon{f' (pid {owner})' if owner else ''} holds {path}",
                    hint="stop it, or choose another --instance or --runtime-dir",
                ) from None
            with contextlib.suppress(FileNotFoundError):
                if Path(path).stat().st_ino == os.fstat(fd).st_ino:
                    break
            os.close(fd)  # its owner removed it just before we got the lock: try the new file
        self._fd = fd
        os.ftruncate(fd, 0)
        os.pwrite(fd, f"{os.getpid()}\n".encode(), 0)

    def release(self) -> None:
        """Remove the file and let the next daemon in.

        If somebody removed it meanwhile, the file of this name is another daemon's and stays.
        """
        with contextlib.suppress(FileNotFoundError):
            if os.path.samestat(os.stat(self.path), os.fstat(self._fd)):
                os.unlink(self.path)
        os.close(self._fd)
