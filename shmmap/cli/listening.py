# SPDX-License-Identifier: Apache-2.0
"""Where programs of the command line listen: the option ``--listen``, and its socket."""

from __future__ import annotations

import errno
import ipaddress
import socket
from typing import Final

from shmmap.errors import BadRequest, CannotStart, InstanceBusy, ShmmapError

_HOST: Final = "127.0.0.1"


def listen_address(text: str) -> tuple[str, int]:
    """Parse ``9731``, ``HOST:9731`` or ``[ADDRESS]:9731``; without a host it is the loopback's.

    Raises
    ------
    BadRequest
        The text is no address with a port.
    """
    host, _, port = text.rpartition(":")
    if host.startswith("[") or ":" in host:
        host, is_ipv6 = host[1:-1], host.startswith("[") and host.endswith("]")
        try:
            ipaddress.IPv6Address(host)
        except ValueError:
            is_ipv6 = False
        port = port if is_ipv6 else ""
    if not port.isascii() or not port.isdecimal() or int(port) > 65535:
        raise BadRequest(
            f"{text!r} is no address to listen at",
            hint="give a port such as 9731, HOST:9731 or [ADDRESS]:9731",
        )
    return host or _HOST, int(port)


def listening_at(host: str, port: int, *, is_fixed: bool = True) -> socket.socket:
    """Return a socket that listens.

    Parameters
    ----------
    port
        Port; 0: any free one.
    is_fixed
        Whether it has to be that port; otherwise any free one will do.

    Raises
    ------
    InstanceBusy
        Another program listens there.
    BadRequest
        This machine has no such address.
    CannotStart
        Listening is not permitted.
    """
    where = f"{host} port {port}"
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        found = socket.socket(family, kind, protocol)
    except OSError as error:
        raise BadRequest(f"cannot listen at {where}: {error.strerror}") from error
    try:
        found.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        found.bind(address)
        found.listen()
    except OSError as error:
        found.close()
        if error.errno == errno.EADDRINUSE and not is_fixed:
            return listening_at(host, 0)
        problem: ShmmapError
        if error.errno == errno.EADDRINUSE:
            problem = InstanceBusy(
                f"another program listens at {where}", hint="stop it, or choose another port: --listen PORT"
            )
        elif error.errno == errno.EADDRNOTAVAIL:
            problem = BadRequest(f"cannot listen at {where}: this machine has no such address")
        else:
            problem = CannotStart(f"cannot listen at {where}: {error.strerror}")
        raise problem from error
    return found
