# SPDX-License-Identifier: Apache-2.0
"""Paths at which the daemon listens and clients look for it."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Final

from shmmap.errors import BadRequest
from shmmap.private_directory import CLOSED, NotPrivate, require_private

DEFAULT_INSTANCE: Final = "default"
SYSTEM_RUNTIME_DIR: Final = "/run/shmmap"
EVENTS_LONGER: Final = len(".events")
"""Bytes by which the path of the events socket is longer than that of the request socket."""
_SUN_PATH_BYTES: Final = 107  # sizeof(sockaddr_un.sun_path) - 1 on Linux


def runtime_dirs(environ: Mapping[str, str] = os.environ) -> tuple[str, ...]:
    """Return the directories that a client searches, in order: the user's own, then the system's.

    ``XDG_RUNTIME_DIR`` is ignored if it is not absolute, as its specification demands.  The directory in /tmp
    is included if it exists and belongs to this user.
    """
    own = environ.get("XDG_RUNTIME_DIR", "")
    found = [f"{own}/shmmap"] if own.startswith("/") else []
    fallback = fallback_runtime_dir()
    if os.path.lexists(fallback) and not why_not_used(fallback):
        found.append(fallback)
    return (*found, SYSTEM_RUNTIME_DIR)


def fallback_runtime_dir() -> str:
    """Return the directory of a user's sockets without ``XDG_RUNTIME_DIR``, as in some ssh sessions."""
    return f"/tmp/shmmap-{os.geteuid()}"  # noqa: S108  its owner is checked


def why_not_used(directory: str) -> str:
    """Return why the directory in /tmp is not private to this user, and what to do; empty if it is."""
    try:
        require_private(directory, make=0, refused=CLOSED)
    except NotPrivate as error:
        return f"it {error.why} ({error.hint})"
    except OSError as error:
        return str(error.strerror)
    return ""


def socket_path(runtime_dir: str, instance: str = DEFAULT_INSTANCE) -> str:
    """Return the path of the instance's request socket."""
    return f"{runtime_dir.rstrip('/')}/{instance}.sock"


def endpoint_path(endpoint: str, *, longer: int = 0) -> str:
    """Return the absolute socket path of an endpoint given as path or ``ipc://`` URL.

    Parameters
    ----------
    endpoint
        The path or URL.
    longer
        Bytes by which a neighbouring name is longer; that name must fit into a socket address, too.

    Raises
    ------
    BadRequest
        For another transport, or a path longer than a socket address can hold (107 bytes).
    """
    path = endpoint.removeprefix("ipc://")
    if "://" in path or not path or path.startswith("@") or "\0" in path:
        raise BadRequest(f"endpoint {endpoint!r} is not usable", hint="give a socket path or an ipc:// URL")
    absolute = os.path.abspath(path)
    nbytes, most = len(os.fsencode(absolute)), _SUN_PATH_BYTES - longer
    if nbytes > most:
        events = f", {longer} more for the socket of events beside it" if longer else ""
        raise BadRequest(
            f"socket path {absolute} has {nbytes} bytes, and at most {most} may be used: a socket address"
            f" holds {_SUN_PATH_BYTES}{events}",
            hint="use a shorter directory or name: --runtime-dir, --instance or --endpoint",
        )
    return absolute
