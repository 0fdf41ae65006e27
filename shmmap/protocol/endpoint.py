# SPDX-License-Identifier: Apache-2.0
"""Where the daemon listens, and where clients look for it."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Final

from shmmap.errors import BadRequest

__all__ = [
    "DEFAULT_INSTANCE",
    "EVENTS_LONGER",
    "SYSTEM_RUNTIME_DIR",
    "endpoint_path",
    "runtime_dirs",
    "socket_path",
]

DEFAULT_INSTANCE: Final = "default"
SYSTEM_RUNTIME_DIR: Final = "/run/shmmap"
EVENTS_LONGER: Final = len(".events")
"""By how much the path of the socket of events is longer than that of requests."""
_SUN_PATH_BYTES: Final = 107  # sizeof(sockaddr_un.sun_path) - 1 on Linux


def runtime_dirs(environ: Mapping[str, str] = os.environ) -> tuple[str, ...]:
    """Directories a client looks in, in order: the user's own, then the system's."""
    own = environ.get("XDG_RUNTIME_DIR", "")
    return (*([f"{own}/shmmap"] if own else []), SYSTEM_RUNTIME_DIR)


def socket_path(runtime_dir: str, instance: str = DEFAULT_INSTANCE) -> str:
    """Path of the instance's request socket."""
    return f"{runtime_dir.rstrip('/')}/{instance}.sock"


def endpoint_path(endpoint: str, *, longer: int = 0) -> str:
    """Return the absolute socket path of an endpoint given as path or ``ipc://`` URL.

    Parameters
    ----------
    endpoint
        The path or URL.
    longer
        How many bytes a name beside it is longer, which must fit into a socket address, too.

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
