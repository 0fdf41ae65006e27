# SPDX-License-Identifier: Apache-2.0
"""Binding a socket whose file only those may use who are meant to."""

from __future__ import annotations

import contextlib
import os
import stat

import zmq

from shmmap.errors import ConfigError

__all__ = ["bind_socket", "remove_socket"]


def bind_socket(socket: zmq.Socket[bytes], path: str, gid: int, *, own: bool = True) -> None:
    """Listen at ``path``.

    Parameters
    ----------
    gid
        Group that may connect; -1: only this user.
    own
        Whether the file is ours; that of an activated socket has the owner its unit says.

    Raises
    ------
    ConfigError
        One cannot listen there, or there is something else than a socket.
    """
    if os.path.lexists(path) and not _is_socket(path):  # libzmq would remove it without a word
        raise ConfigError(
            f"cannot listen at {path}: there is something that is no socket",
            key="endpoint",
            hint="choose another --endpoint",
        )
    # libzmq makes the socket file with the umask's mode; nobody may connect before it is right
    mask = os.umask(0o117 if gid >= 0 else 0o177)
    try:
        socket.bind(f"ipc://{path}")
    except zmq.ZMQError as error:
        raise ConfigError(
            f"cannot listen at {path}: {error}", key="endpoint", hint="choose another --endpoint"
        ) from error
    finally:
        os.umask(mask)
    if gid >= 0 and own:
        os.chown(path, -1, gid)


def remove_socket(path: str) -> None:
    """Remove a socket's file; nothing else that may be there."""
    with contextlib.suppress(OSError):
        if _is_socket(path):
            os.unlink(path)


def _is_socket(path: str) -> bool:
    return stat.S_ISSOCK(os.lstat(path).st_mode)
