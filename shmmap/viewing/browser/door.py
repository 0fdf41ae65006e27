# SPDX-License-Identifier: Apache-2.0
"""Who may look: a viser server whose address has a secret, and that answers no page of another site.

Any account of the machine reaches its loopback, and so does any page that a browser has open.  So the first
part of the path is a secret; and a connection must come from a page of this server, under a name that no
other site can point at this machine.  All else is answered by 403.

viser has no such check.  It starts its server by ``websockets.asyncio.server.serve``, which is replaced here
until it has started: the connections' first request passes through `Door.admit`.
"""

from __future__ import annotations

import hmac
import ipaddress
import logging
import secrets
import socket
import threading
import warnings
from collections.abc import Callable
from http import HTTPStatus
from typing import TYPE_CHECKING, Any, Final, Protocol

from shmmap.lazy_imports import needed_packages

if TYPE_CHECKING:
    import viser

_SECRET_BYTES: Final = 18
_CLOSE_S: Final = 0.3  # how long a browser may take to say goodbye at the end
_NO_ENTRY: Final = "This is not the address that shmmap view printed.\n"
_PATCHING: Final = threading.Lock()


class Headers(Protocol):
    """The headers of a request."""

    def get_all(self, key: str) -> list[str]:
        """Return all values of a header."""


class Door:
    """Decides about requests by their path, ``Host`` and ``Origin``.

    Attributes
    ----------
    secret
        First part of every path.
    """

    def __init__(self, host: str) -> None:
        self.secret = secrets.token_urlsafe(_SECRET_BYTES)
        self._names = {"localhost", host.lower(), socket.gethostname().lower()}

    def url(self, listening: socket.socket) -> str:
        """Return the address of the page."""
        host, port = listening.getsockname()[:2]
        return f"http://{f'[{host}]' if ':' in host else host}:{port}/{self.secret}/"

    def admit(self, path: str, headers: Headers) -> str | None:
        """Return the path behind the secret; None for a request that is refused."""
        hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
        _, first, rest = (*path.partition("?")[0].split("/", 2), "", "")[:3]
        if not hmac.compare_digest(first.encode(errors="replace"), self.secret.encode()):
            return None
        if len(hosts) != 1 or not self._is_ours(hosts[0]) or len(origins) > 1:
            return None
        is_page = not headers.get_all("Upgrade")
        ours = {f"http://{hosts[0]}".lower(), f"https://{hosts[0]}".lower()}
        if (origins and origins[0].lower() not in ours) or (not origins and not is_page):
            return None
        return f"/{rest}"

    def _is_ours(self, host: str) -> bool:
        """Whether a host is an address, or a name of this machine: a foreign name may lead here, too."""
        name = host.lower().rpartition(":")[0] if not host.endswith("]") and ":" in host else host.lower()
        try:
            ipaddress.ip_address(name.strip("[]"))
        except ValueError:
            return name in self._names
        return True


def open_server(listening: socket.socket, door: Door, label: str) -> viser.ViserServer:
    """Start a viser server behind a door.

    Raises
    ------
    PackageMissing
        viser is not installed.
    """
    with needed_packages("shmmap view --browser", together="'shmmap[view]'"):
        import rich
        import viser
        import websockets.asyncio.server as servers

    class Server(viser.ViserServer):
        """Never asks a host of the internet to show the map to others."""

        def request_share_url(self, verbose: bool = True) -> str | None:  # noqa: ARG002
            return None

    rich.get_console().quiet = True  # viser prints addresses without the secret
    logging.getLogger("websockets").setLevel(logging.CRITICAL)
    warnings.filterwarnings("ignore", "Queued a .* on a closed connection", UserWarning)  # a browser has left
    serve = servers.serve

    def guarded_serve(handler: Any, host: Any, port: Any, *, process_request: Any, **options: Any) -> Any:
        del host, port
        options["close_timeout"] = _CLOSE_S
        return serve(handler, sock=listening, process_request=_guarded(door, process_request), **options)

    with _PATCHING:
        servers.serve = guarded_serve  # type: ignore[assignment,misc]
        try:
            host, port = listening.getsockname()[:2]
            server = Server(host, port, label, verbose=False)
        finally:
            servers.serve = serve  # type: ignore[misc]
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    return server


def _guarded(door: Door, process_request: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    def guarded(connection: Any, request: Any) -> Any:
        path = door.admit(request.path, request.headers)
        if path is None:
            return connection.respond(HTTPStatus.FORBIDDEN, _NO_ENTRY)
        request.path = path
        response = process_request(connection, request)
        if response is not None:
            response.headers["Cache-Control"] = "no-store"
            response.headers["Referrer-Policy"] = "no-referrer"
            response.headers["X-Frame-Options"] = "DENY"
        return response

    return guarded
