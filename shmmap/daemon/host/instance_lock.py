# SPDX-License-Identifier: Apache-2.0
"""One daemon per instance: whoever binds takes a live socket's place, so a lock comes first."""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Final

from shmmap.errors import InstanceBusy, ShmmapError
from shmmap.segment.taken_name import name_taken

__all__ = ["InstanceLock"]

_OTHERWISE: Final = "choose another --instance or --runtime-dir"


class InstanceLock:
    """An exclusive ``flock`` on a file, held for the daemon's life and removed with it.

    Parameters
    ----------
    path
        It says the process id, for the message to whoever comes second.
    check
        Raises what else hinders the daemon, once the lock is held and before the file is changed.

    Raises
    ------
    InstanceBusy
        Somebody holds it; the message names the process.
    CannotStart
        The file cannot be made, or is another user's or another program's.
    """

    def __init__(self, path: str, check: Callable[[], object] = lambda: None) -> None:
        self.path = path
        self._fd = self._locked(path)
        try:
            if not re.fullmatch(rb"[0-9\0]*\n?", os.pread(self._fd, 64, 0)):
                raise name_taken("the lock file", path, None, otherwise=_OTHERWISE)
            check()
        except BaseException:
            if not os.fstat(self._fd).st_size:
                self.release()
            else:
                os.close(self._fd)
            raise
        os.ftruncate(self._fd, 0)
        os.pwrite(self._fd, f"{os.getpid()}\n".encode(), 0)

    @staticmethod
    def _locked(path: str) -> int:
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
                    return fd
            os.close(fd)  # its owner removed it just before we got the lock: try the new file

    def restore(self) -> None:
        """Make the file again if another program removed it, unless another daemon has made one."""
        if os.path.exists(self.path):
            return
        with contextlib.suppress(ShmmapError, OSError):
            again = InstanceLock(self.path)
            os.close(self._fd)
            self._fd = again._fd

    def release(self) -> None:
        """Remove the file and let the next daemon in.

        If somebody removed it meanwhile, the file of this name is another daemon's and stays.
        """
        with contextlib.suppress(FileNotFoundError):
            if os.path.samestat(os.stat(self.path), os.fstat(self._fd)):
                os.unlink(self.path)
        os.close(self._fd)
