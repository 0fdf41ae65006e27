# SPDX-License-Identifier: Apache-2.0
"""Socket activation: the service manager made the request socket and hands it over (sd_listen_fds(3)).

The socket outlives the daemon, so that clients that connect while it starts or restarts only wait;
its file, owner and mode are the service manager's, and so the daemon never removes it.
"""

from __future__ import annotations

import os
import socket
from collections.abc import MutableMapping
from typing import Final, NamedTuple

from shmmap.errors import ConfigError

__all__ = ["FIRST_FD", "ActivatedSocket", "take_activated_socket"]

FIRST_FD: Final = 3  # SD_LISTEN_FDS_START


class ActivatedSocket(NamedTuple):
    """A listening socket and where it listens."""

    fd: int
    path: str


def take_activated_socket(
    environ: MutableMapping[str, str] = os.environ, *, first_fd: int = FIRST_FD
) -> ActivatedSocket | None:
    """Take over the socket that the service manager passed; None when it passed none.

    The variables are removed: loaders must not believe that the socket is theirs.

    Parameters
    ----------
    environ
        ``LISTEN_PID`` and ``LISTEN_FDS`` count.
    first_fd
        Where passed descriptors start.

    Raises
    ------
    ConfigError
        More than one socket was passed, or one that is no listening unix stream socket.
    """
    pid, count = environ.pop("LISTEN_PID", ""), environ.pop("LISTEN_FDS", "")
    environ.pop("LISTEN_FDNAMES", None)
    if pid != str(os.getpid()) or not count.isdigit() or int(count) == 0:
        return None
    for fd in range(first_fd, first_fd + int(count)):
        os.set_inheritable(fd, False)
    if int(count) != 1:
        raise _unusable(f"{count} sockets were passed, one is needed")
    try:
        with socket.socket(fileno=os.dup(first_fd)) as view:
            listens = view.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN)
            kind, family, path = view.type, view.family, view.getsockname()
    except OSError as error:
        raise _unusable(f"descriptor {first_fd} is no socket: {error.strerror}") from error
    if family != socket.AF_UNIX or kind != socket.SOCK_STREAM or not listens:
        raise _unusable("the socket that was passed is no listening unix stream socket")
    if not isinstance(path, str) or not path.startswith("/"):
        raise _unusable(f"the socket that was passed has no path, but {path!r}")
    os.set_blocking(first_fd, False)  # a client may give up between the poll and the accept
    return ActivatedSocket(first_fd, path)


def _unusable(what: str) -> ConfigError:
    return ConfigError(
        f"socket activation: {what}",
        key="endpoint",
        hint="the .socket unit needs exactly one ListenStream= with a path",
    )
