# SPDX-License-Identifier: Apache-2.0
"""A listening socket and its file: never replaces another program's file, and detects its own removal."""

from __future__ import annotations

import contextlib
import os
import socket
import stat
from pathlib import Path
from typing import Final

from shmmap.daemon.transport.connection import peer_of
from shmmap.errors import InstanceBusy
from shmmap.logfmt import escaped
from shmmap.segment.names import name_taken

_OTHERWISE: Final = "choose another --endpoint"


class SocketFile:
    """Listens at a path, and replaces a socket file that an ended process of this user left there.

    Parameters
    ----------
    path
        Path of the socket.
    gid
        Group that may connect; -1: only this user.
    passed
        A listening socket that the service manager passed; its file is not removed at the end.

    Attributes
    ----------
    socket
        The listening socket.

    Raises
    ------
    InstanceBusy
        A process listens there.
    CannotStart
        The path cannot be used, or another kind of file has the name.
    """

    def __init__(self, path: str, gid: int, passed: socket.socket | None = None) -> None:
        self.path = path
        self._is_passed = passed is not None
        self.socket = passed if passed is not None else _listen(path, gid)
        self._status = _status(path)

    @property
    def is_there(self) -> bool:
        """Whether the path still leads clients to this socket."""
        found = _status(self.path)
        return found is not None and self._status is not None and os.path.samestat(found, self._status)

    def remove(self) -> None:
        """Remove the file, unless it is another program's."""
        if self.is_there and not self._is_passed:
            with contextlib.suppress(OSError):
                os.unlink(self.path)


def refuse_taken(path: str) -> bool:
    """Check whether a socket may be created at ``path``; return True to replace a stale one of this user.

    Raises
    ------
    InstanceBusy
        A process listens there; the message names it.
    CannotStart
        Another kind of file, or another user's socket, has the name.
    """
    try:
        status = os.lstat(path)
    except OSError:  # nothing exists there, or the path is wrong: `bind` reports why
        return False
    if not stat.S_ISSOCK(status.st_mode):
        raise name_taken("the socket", path, None, otherwise=_OTHERWISE)
    pid = _answers(path)
    if pid is not None:
        raise InstanceBusy(
            f"the socket cannot be {path}: it is in use by {_program(pid)}",
            hint=f"stop that program, or {_OTHERWISE}",
        )
    if status.st_uid != os.geteuid():
        raise name_taken("the socket", path, None, otherwise=_OTHERWISE)
    return True


def _status(path: str) -> os.stat_result | None:
    """Return the status of a socket's file; None if there is none."""
    try:
        return os.lstat(path)
    except OSError:
        return None


def _listen(path: str, gid: int) -> socket.socket:
    if refuse_taken(path):
        with contextlib.suppress(FileNotFoundError):
            os.unlink(path)
    listening = socket.socket(socket.AF_UNIX)
    listening.setblocking(False)
    # the file gets the umask's mode; no client may connect before mode and group are right
    mask = os.umask(0o117 if gid >= 0 else 0o177)
    try:
        listening.bind(path)
        if gid >= 0:
            os.chown(path, -1, gid)
        listening.listen(socket.SOMAXCONN)
    except OSError as error:
        listening.close()
        raise name_taken("the socket", path, error, otherwise=_OTHERWISE) from error
    finally:
        os.umask(mask)
    return listening


def _answers(path: str) -> int | None:
    """Return the process that has the socket at ``path`` open, 0 if it is not known; None if none has."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK) as probe:
        try:
            probe.connect(path)
            pid = peer_of(probe).pid
            return pid if pid > 0 and os.path.exists(f"/proc/{pid}") else _owner(path)
        except FileNotFoundError:
            return None
        except ConnectionRefusedError:  # a leftover, unless a process has bound it and is about to listen
            return _owner(path) or None
        except OSError:  # for example, a process has bound another type of socket
            return _owner(path)


def _owner(path: str) -> int:
    """Return the other process that has an open socket with this path; 0 if the kernel does not show it."""
    inodes = set()
    with contextlib.suppress(OSError), open("/proc/net/unix", errors="surrogateescape") as table:
        for line in table:
            row = line.rstrip("\n").split(maxsplit=7)
            if len(row) == 8 and row[7] == path:
                inodes.add(f"socket:[{row[6]}]")
    for process in Path("/proc").glob("[0-9]*") if inodes else ():
        if process.name == str(os.getpid()):  # where this daemon listens at a file that was removed
            continue
        with contextlib.suppress(OSError):
            if any(os.readlink(fd) in inodes for fd in process.joinpath("fd").iterdir()):
                return int(process.name)
    return 0


def _program(pid: int) -> str:
    """Return a process's id and program for a message."""
    if not pid:
        return "a process that this user does not see"
    try:
        words = Path(f"/proc/{pid}/cmdline").read_bytes().rstrip(b"\0").split(b"\0")
        name = os.fsdecode(b" ".join(words[:4]))[:80] or Path(f"/proc/{pid}/comm").read_text().strip()
    except OSError:
        name = ""
    return f"pid {pid} ({escaped(name)})" if name else f"pid {pid}"
