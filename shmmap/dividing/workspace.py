# SPDX-License-Identifier: Apache-2.0
"""The directory in which an output is made before it appears, and the state of a run to resume.

The directory lies beside the output, hidden.  Its state file records the run's progress.  It is replaced in
one step, after the rows that it counts were passed to the kernel.  Such rows survive a killed process but not
a power loss, so a state is valid only until the machine restarts.
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
from shmmap.formats.durable_file import flush_directory, locked_entry, writing_errors

__all__ = ["Workspace"]

_STATE: Final = "state.json"
_LOCK: Final = "lock"
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
        The directory.
    content
        The subdirectory that becomes ``out``.
    """

    def __init__(self, out: str, doing: str = "dividing", *, keep_failed: bool = False) -> None:
        parent, name = os.path.split(out)
        self.out = out
        self.path = os.path.join(parent, f".{name}.{doing}")
        self._keep_failed = keep_failed
        self.content = os.path.join(self.path, "map")
        with writing_errors(self.path):
            try:
                self._lock = locked_entry(self.path, _LOCK, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise InstanceBusy(
                    f"another run is making {out}", hint="wait for it, or choose another output"
                ) from None

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

    def state(self) -> dict[str, Any] | None:
        """Return the state saved last since the machine started; None if no run can be resumed."""
        try:
            state = json.loads(Path(self.path, _STATE).read_bytes())
        except (OSError, ValueError):
            return None
        return state if isinstance(state, dict) and state.get("boot") == _boot_id() else None

    def save(self, state: dict[str, Any]) -> None:
        """Save the progress of the run."""
        interim = Path(self.path, _STATE + ".new")
        interim.write_text(json.dumps({**state, "boot": _boot_id()}))
        interim.replace(Path(self.path, _STATE))

    def empty(self) -> None:
        """Remove everything but the lock file."""
        for name in os.listdir(self.path):
            path = os.path.join(self.path, name)
            if os.path.isdir(path):
                shutil.rmtree(path)
            elif name != _LOCK:
                os.unlink(path)

    def directory(self, name: str) -> str:
        """Return the path of a directory in the workspace, creating it if missing."""
        path = os.path.join(self.path, name)
        os.makedirs(path, exist_ok=True)
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
            shutil.rmtree(self.path)


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
