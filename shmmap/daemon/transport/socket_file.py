# SPDX-License-Identifier: Apache-2.0
"""Listening at a socket whose file only those may use who are meant to."""

from __future__ import annotations

import contextlib
import os
import socket
import stat

from shmmap.segment.taken_name import name_taken

__all__ = ["listen_at", "remove_socket"]


def listen_at(path: str, gid: int) -> socket.socket:
    """Listen at ``path``, in place of a socket that may be left there.

    Parameters
    ----------
    gid
        Group that may connect; -1: only this user.

    Raises
    ------
    CannotStart
        One cannot listen there, or there is something else than a socket.
    """
    remove_socket(path)
    listening = socket.socket(socket.AF_UNIX)
    listening.setblocking(False)
    # the file is made with the umask's mode; nobody may connect before it is right
    mask = os.umask(0o117 if gid >= 0 else 0o177)
    try:
        listening.bind(path)
        if gid >= 0:
            os.chown(path, -1, gid)
        listening.listen(socket.SOMAXCONN)
    except OSError as error:
        listening.close()
        raise name_taken("the socket", path, error, otherwise="choose another --endpoint") from error
    finally:
        os.umask(mask)
    return listening


def remove_socket(path: str) -> None:
    """Remove a socket's file; nothing else that may be there."""
    with contextlib.suppress(OSError):
        if _is_socket(path):
            os.unlink(path)


def _is_socket(path: str) -> bool:
    return stat.S_ISSOCK(os.lstat(path).st_mode)
