# SPDX-License-Identifier: Apache-2.0
"""The directory in which an output is made before it appears, and the state of a run to resume.

The directory lies beside the output, hidden.  Its state file records the run's progress.  It is replaced in
one step, after the rows that it counts were passed to the kernel.  Such rows survive a killed process but not
a power loss, so a state is valid only until the machine restarts.

Its name can be guessed, so only a directory of this user is used that others cannot write to, see
`shmmap.private_directory`.  It is held by its descriptor: what another account does with the name meanwhile
has no effect on what is written, resumed or removed.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import fcntl
import json
import os
import shutil
import stat
from collections.abc import Collection
from pathlib import Path
from types import TracebackType
from typing import Any, Final

from shmmap.errors import InstanceBusy, ShmmapError
from shmmap.formats.durable_file import flush_directory, writing_errors
from shmmap.private_directory import PRIVATE, NotPrivate, open_own, open_private, within

_STATE: Final = "state.json"
_LOCK: Final = "lock"
_EXCHANGES: Final = 100  # times that the directory may be removed by its last holder, or exchanged
_RENAME_EXCHANGE: Final = 2  # from linux/fs.h
_AT_FDCWD: Final = -100  # from fcntl.h


class Workspace:
    """A hidden directory beside ``out``, held by this process alone.

    Parameters
    ----------
    doing
        Kind of work, as part of the directory's name.
    keep_failed
        Also failed runs can be resumed, not only interrupted ones.

    Attributes
    ----------
    path
        Path of the directory in this process, whatever has its name.
    content
        The subdirectory that becomes ``out``.

    Raises
    ------
    CannotWrite
        It cannot be made, or another account made it or could write to it.
    InstanceBusy
        Another run holds it.
    """

    def __init__(self, out: str, doing: str = "dividing", *, keep_failed: bool = False) -> None:
        parent, name = os.path.split(out)
        self.out = out
        self._name = os.path.join(parent, f".{name}.{doing}")
        self._keep_failed = keep_failed
        with writing_errors(self._name):
            os.makedirs(parent, exist_ok=True)
            self._fd, self._lock = self._held()
        self.path = within(self._fd)
        self.content = within(self._fd, "map")

    def _held(self) -> tuple[int, int]:
        """Open and lock the directory; a run that ends removes it, then there is a new one."""
        for _ in range(_EXCHANGES):
            with contextlib.suppress(FileNotFoundError), contextlib.ExitStack() as undo:
                fd = open_private(self._name, make=PRIVATE)
                undo.callback(os.close, fd)
                if (names := os.listdir(fd)) and _LOCK not in names:
                    raise NotPrivate(self._name, "is not of an interrupted run")
                lock = open_own(_LOCK, os.O_RDWR | os.O_CREAT, dir_fd=fd)
                undo.callback(os.close, lock)
                try:
                    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    raise InstanceBusy(
                        f"another run is making {self.out}", hint="wait for it, or choose another output"
                    ) from None
                if os.path.samestat(os.fstat(fd), os.lstat(self._name)) and os.path.samestat(
                    os.fstat(lock), os.stat(_LOCK, dir_fd=fd, follow_symlinks=False)
                ):
                    undo.pop_all()
                    return fd, lock
        raise NotPrivate(self._name, "is exchanged again and again")

    def __enter__(self) -> Workspace:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # an interrupted run can be resumed; a run that failed at its input would fail again
        failed = isinstance(error, Exception) and not self._keep_failed
        if error is None or failed or self.state() is None:
            self.remove()
        os.close(self._lock)
        os.close(self._fd)
        # users know the directory by its name
        if isinstance(error, OSError) and isinstance(error.filename, str):
            error.filename = error.filename.replace(self.path, self._name)
        if isinstance(error, ShmmapError):
            error.message = error.message.replace(self.path, self._name)

    def state(self) -> dict[str, Any] | None:
        """Return the state saved last since the machine started; None if no run can be resumed."""
        try:
            with open(open_own(_STATE, os.O_RDONLY, dir_fd=self._fd), "rb") as file:
                state = json.loads(file.read())
        except (OSError, ValueError):
            return None
        return state if isinstance(state, dict) and state.get("boot") == _boot_id() else None

    def save(self, state: dict[str, Any]) -> None:
        """Save the progress of the run."""
        interim = Path(self.path, _STATE + ".new")
        interim.unlink(missing_ok=True)  # a killed run's
        interim.write_text(json.dumps({**state, "boot": _boot_id()}))
        interim.replace(Path(self.path, _STATE))

    def empty(self) -> None:
        """Remove everything but the lock file; links are removed, not followed."""
        self.clear("", but=(_LOCK,))

    def clear(self, directory: str, *, but: Collection[str] = ()) -> None:
        """Remove what is in a directory of the workspace, but these names; links are not followed."""
        with os.scandir(os.path.join(self.path, directory)) as entries:
            others = [entry for entry in entries if entry.name not in but]
        for entry in others:
            if entry.is_dir(follow_symlinks=False):
                shutil.rmtree(entry.path)
            else:
                os.unlink(entry.path)

    def directory(self, name: str) -> str:
        """Return the path of a directory in the workspace, creating it if missing.

        Raises
        ------
        OSError
            Something else has its name, such as a link.
        """
        path = self.path
        for part in name.split("/"):
            path = os.path.join(path, part)
            with contextlib.suppress(FileExistsError):
                os.mkdir(path)
            if not stat.S_ISDIR(os.lstat(path).st_mode):
                raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR), path)
        return path

    def publish(self, *, replace: bool, durable: bool) -> None:
        """Rename `content` to ``out``, in one step; with ``replace`` in exchange for an existing map."""
        if durable:
            _flush_file_system(self.path)
        # the workspace may soon contain the replaced map, from which no run may resume
        Path(self.path, _STATE).unlink(missing_ok=True)
        if replace and os.path.isdir(self.out) and os.listdir(self.out):
            _exchange(self.content, self.out, aside=os.path.join(self.path, "replaced"))
        else:
            os.rename(self.content, self.out)  # replaces an empty directory, and fails on any other
        if durable:
            flush_directory(os.path.dirname(self.out))

    def remove(self) -> None:
        """Remove the directory and everything in it."""
        with contextlib.suppress(OSError):
            self.empty()
            os.unlink(_LOCK, dir_fd=self._fd)  # last: a directory without it is not taken to be a workspace
            if os.path.samestat(os.fstat(self._fd), os.lstat(self._name)):
                os.rmdir(self._name)


def _flush_file_system(path: str) -> None:
    """Flush the file system to the disk: one call, since fsync of thousands of files takes minutes."""
    fd = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        if ctypes.CDLL(None, use_errno=True).syncfs(fd):
            code = ctypes.get_errno()
            raise OSError(code, os.strerror(code), path)
    finally:
        os.close(fd)


def _exchange(one: str, other: str, *, aside: str) -> None:
    function = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    if function is not None and not function(
        _AT_FDCWD, os.fsencode(one), _AT_FDCWD, os.fsencode(other), _RENAME_EXCHANGE
    ):
        return
    # file systems without an exchange: for an instant there is no map, but never half of one
    os.rename(other, aside)
    os.rename(one, other)


def _boot_id() -> str:
    return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
