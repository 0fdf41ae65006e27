# SPDX-License-Identifier: Apache-2.0
"""Where an output is made before it appears, and what a killed run can continue from.

The directory lies beside the output, hidden.  Its state file says how far the run came; it is replaced
in one step and only after the rows it speaks of were handed to the kernel.  What a killed process wrote
is still there, what a machine lost with its power is not: so a state counts only in the same boot.
"""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import json
import os
import shutil
from pathlib import Path
from types import TracebackType
from typing import Any, Final

from shmmap.errors import InstanceBusy
from shmmap.formats.durable_file import flush_directory, writing_errors

__all__ = ["Workspace"]

_STATE: Final = "state.json"
_LOCK: Final = "lock"
_RENAME_EXCHANGE: Final = 2  # linux/fs.h
_AT_FDCWD: Final = -100  # fcntl.h


class Workspace:
    """A hidden directory beside ``out``, held by this process alone.

    Parameters
    ----------
    doing
        What is done there: a part of its name.
    keep_failed
        A run that failed, not only one that was interrupted, can be resumed.

    Attributes
    ----------
    path
        The directory.
    content
        The directory in it that becomes ``out``.
    """

    def __init__(self, out: str, doing: str = "dividing", *, keep_failed: bool = False) -> None:
        parent, name = os.path.split(out)
        self.out = out
        self.path = os.path.join(parent, f".{name}.{doing}")
        self._keep_failed = keep_failed
        self.content = os.path.join(self.path, "map")
        with writing_errors(self.path):
            os.makedirs(parent, exist_ok=True)
            self._lock = self._take()

    def _take(self) -> int:
        while True:
            os.makedirs(self.path, exist_ok=True)
            path = os.path.join(self.path, _LOCK)
            fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
            try:
                fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                os.close(fd)
                raise InstanceBusy(
                    f"another run is making {self.out}", hint="wait for it, or choose another output"
                ) from None
            with contextlib.suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(fd), os.stat(path)):
                    return fd
            os.close(fd)  # the run that held it has just removed it

    def __enter__(self) -> Workspace:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # an interrupted run can be resumed; one that failed at its input would fail again
        failed = isinstance(error, Exception) and not self._keep_failed
        if error is None or failed or self.state() is None:
            self.remove()
        os.close(self._lock)

    def state(self) -> dict[str, Any] | None:
        """Read what `save` wrote last since the machine started; None where there is nothing to resume."""
        try:
            state = json.loads(Path(self.path, _STATE).read_bytes())
        except (OSError, ValueError):
            return None
        return state if isinstance(state, dict) and state.get("boot") == _boot_id() else None

    def save(self, state: dict[str, Any]) -> None:
        """Save how far the run came."""
        interim = Path(self.path, _STATE + ".new")
        interim.write_text(json.dumps({**state, "boot": _boot_id()}))
        interim.replace(Path(self.path, _STATE))

    def empty(self) -> None:
        """Remove everything but the lock."""
        for name in os.listdir(self.path):
            path = os.path.join(self.path, name)
            if os.path.isdir(path):
                shutil.rmtree(path)
            elif name != _LOCK:
                os.unlink(path)

    def directory(self, name: str) -> str:
        """Return the path of a directory in the workspace, made if it is not there."""
        path = os.path.join(self.path, name)
        os.makedirs(path, exist_ok=True)
        return path

    def publish(self, *, replace: bool, durable: bool) -> None:
        """Rename `content` to ``out``, in one step; with ``replace`` in the place of what is there."""
        if durable:
            _flush_file_system(self.path)
        # from here on the workspace may hold the map that was replaced, which no run may resume from
        Path(self.path, _STATE).unlink(missing_ok=True)
        if replace and os.path.isdir(self.out) and os.listdir(self.out):
            _exchange(self.content, self.out, aside=os.path.join(self.path, "replaced"))
        else:
            os.rename(self.content, self.out)  # replaces an empty directory, fails on any other
        if durable:
            flush_directory(os.path.dirname(self.out))

    def remove(self) -> None:
        """Remove the directory and everything in it."""
        with contextlib.suppress(OSError):
            shutil.rmtree(self.path)


def _flush_file_system(path: str) -> None:
    """Force everything to the disk: one call, where an fsync for each of thousands of files takes minutes."""
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
    # file systems without it: for an instant there is no map, but never half of one
    os.rename(other, aside)
    os.rename(one, other)


def _boot_id() -> str:
    return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
