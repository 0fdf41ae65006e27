# SPDX-License-Identifier: Apache-2.0
"""Files of an instance: the directory of its sockets, its lock, and the removal of its segments.

There is one daemon per instance: binding would replace a live socket, so the lock is taken first.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import stat
from collections.abc import Callable
from pathlib import Path
from typing import Final

from shmmap.daemon.host.signals import StartSignals
from shmmap.errors import CannotStart, InstanceBusy, ShmmapError
from shmmap.logfmt import log
from shmmap.private_directory import CLOSED, NotPrivate, require_private
from shmmap.protocol.endpoint import fallback_runtime_dir
from shmmap.segment.directory import ShmDirectory
from shmmap.segment.names import name_taken, segment_prefix, statistics_name
from shmmap.statistics.exclusive_name import has_writer


def make_runtime_dir(path: Path, gid: int) -> None:
    """Make the directory of the socket, for the owner and, if given, the group.

    Raises
    ------
    CannotStart
        The directory cannot be made, or it is in /tmp and another account has made it.
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
    """Make the directory in /tmp that replaces ``XDG_RUNTIME_DIR``, for the owner alone."""
    try:
        require_private(path, refused=CLOSED)
    except NotPrivate as error:
        raise CannotStart(
            f"runtime directory {error.filename}: it {error.why}",
            hint=f"{error.hint}, or set XDG_RUNTIME_DIR, or give --runtime-dir",
        ) from None
    log.info("runtime directory", path=path, reason="XDG_RUNTIME_DIR is not set")


_OTHERWISE: Final = "choose another --instance or --runtime-dir"


class InstanceLock:
    """An exclusive ``flock`` on a file, held while the daemon runs and removed with it.

    Parameters
    ----------
    path
        The lock file; it contains the process id, for the message to a second daemon.
    check
        Called with the lock held and the file unchanged; raises an error if the daemon cannot start.

    Raises
    ------
    InstanceBusy
        Another process holds the lock; the message names it.
    CannotStart
        The file cannot be created, or belongs to another user or program.
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
            status = os.fstat(fd)  # another owner could hold the lock without end
            if status.st_uid not in (os.geteuid(), 0) or not stat.S_ISREG(status.st_mode):
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
            os.close(fd)  # its owner removed the file just before we got the lock: try the new file

    def restore(self) -> None:
        """Create the file again if another program removed it, unless another daemon has created one."""
        if os.path.exists(self.path):
            return
        with contextlib.suppress(ShmmapError, OSError):
            again = InstanceLock(self.path)
            os.close(self._fd)
            self._fd = again._fd

    def release(self) -> None:
        """Remove the file and release the lock.

        If another program removed the file, the present one is another daemon's and stays.
        """
        with contextlib.suppress(FileNotFoundError):
            if os.path.samestat(os.stat(self.path), os.fstat(self._fd)):
                os.unlink(self.path)
        os.close(self._fd)


def lock_path(socket_path: str) -> str:
    """Return the path of the lock that protects the request socket."""
    return socket_path.removesuffix(".sock") + ".lock"


def take_away(directory: ShmDirectory, instance: str) -> None:
    """Remove the instance's names from the segment directory."""
    for name in directory.names(segment_prefix(instance)):
        with contextlib.suppress(OSError):
            os.unlink(directory.path + name)


def stopped_early(
    signals: StartSignals,
    directory: ShmDirectory,
    instance: str,
    kind: type[BaseException] | None,
    *_: object,
) -> None:
    """Remove the previous run's segments when the daemon is stopped before it has any of its own.

    They stay if a daemon with another runtime directory serves them by then.
    """
    if kind is SystemExit and not signals.keep and not has_writer(directory, statistics_name(instance)):
        take_away(directory, instance)
