# SPDX-License-Identifier: Apache-2.0
"""Answer Prometheus' scrapes with the statistics in shared memory, whatever state the daemon is in."""

from __future__ import annotations

import errno
import ipaddress
import socket
import threading
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Final

from shmmap.errors import BadRequest, CannotStart, InstanceBusy, ShmmapError

_HOST: Final = "127.0.0.1"
_MAX_CONNECTIONS: Final = 16
_SILENT_S: Final = 5.0
_CONTENT_TYPE: Final = "text/plain; version=0.0.4; charset=utf-8"
_FRONT_PAGE: Final = "shmmap: metrics in Prometheus' format are at /metrics\n"


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


class MetricsServer(ThreadingHTTPServer):
    """An HTTP server of one page.

    Parameters
    ----------
    host, port
        Where to listen; port 0: one that is free.
    scrape
        Function that returns the page; called in several threads.

    Raises
    ------
    InstanceBusy
        Another program listens there.
    BadRequest
        This machine has no such address.
    CannotStart
        Listening is not permitted.
    """

    daemon_threads = True
    request_queue_size = _MAX_CONNECTIONS

    def __init__(self, host: str, port: int, scrape: Callable[[], str]) -> None:
        self.scrape = scrape
        self._places = threading.BoundedSemaphore(_MAX_CONNECTIONS)
        where = f"{host} port {port}"
        try:
            family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
            self.address_family = family
            super().__init__(address[:2], _Handler)  # type: ignore[arg-type]  # host and port
        except socket.gaierror as error:
            raise BadRequest(f"cannot listen at {where}: {error.strerror}") from error
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                raise InstanceBusy(
                    f"another program listens at {where}", hint="stop it, or choose another port"
                ) from error
            if error.errno == errno.EADDRNOTAVAIL:
                raise BadRequest(f"cannot listen at {where}: this machine has no such address") from error
            raise CannotStart(f"cannot listen at {where}: {error.strerror}") from error

    @property
    def url(self) -> str:
        """Address of the page."""
        host, port = self.address
        return f"http://{f'[{host}]' if ':' in host else host}:{port}/metrics"

    @property
    def address(self) -> tuple[str, int]:
        """Host and port where it listens."""
        host, port = self.server_address[:2]
        return str(host), port

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answer in a thread of its own; close the connection if too many are open."""
        if not self._places.acquire(blocking=False):
            self.shutdown_request(request)
            return
        super().process_request(request, client_address)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Answer, and free the place."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._places.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore peers that go away or say nothing."""


class _Handler(BaseHTTPRequestHandler):
    server: MetricsServer
    server_version = "shmmap"
    sys_version = ""
    timeout = _SILENT_S

    def do_GET(self) -> None:
        path = self.path.partition("?")[0]
        if path == "/":
            self._answer(200, _FRONT_PAGE)
        elif path == "/metrics":
            try:
                self._answer(200, self.server.scrape())
            except ShmmapError as error:
                self._answer(503, f"{error.message}\n")
        else:
            self._answer(404, "there is only /metrics\n")

    def do_HEAD(self) -> None:
        self.do_GET()

    def _answer(self, code: int, text: str) -> None:
        body = text.encode()
        self.send_response(code)
        self.send_header("Content-Type", _CONTENT_TYPE)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002
        """Log nothing: a scrape comes every few seconds."""
