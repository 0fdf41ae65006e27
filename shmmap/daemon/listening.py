# SPDX-License-Identifier: Apache-2.0
"""Binding a socket whose file only those may use who are meant to."""

from __future__ import annotations

import os

import zmq

from shmmap.errors import ConfigError

__all__ = ["bind_socket"]


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
        One cannot listen there.
    """
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
