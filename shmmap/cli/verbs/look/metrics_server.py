# SPDX-License-Identifier: Apache-2.0
"""Answer Prometheus' scrapes with the statistics in shared memory, whatever state the daemon is in."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Final

from shmmap.errors import ShmmapError

_MAX_CONNECTIONS: Final = 16
_SILENT_S: Final = 5.0
_CONTENT_TYPE: Final = "text/plain; version=0.0.4; charset=utf-8"
_FRONT_PAGE: Final = "shmmap: metrics in Prometheus' format are at /metrics\n"


class MetricsServer(ThreadingHTTPServer):
    """An HTTP server of one page.

    Parameters
    ----------
    listening
        Socket that listens; the server closes it.
    scrape
        Function that returns the page; called in several threads.
    """

    daemon_threads = True

    def __init__(self, listening: socket.socket, scrape: Callable[[], str]) -> None:
        self.scrape = scrape
        self._places = threading.BoundedSemaphore(_MAX_CONNECTIONS)
        super().__init__(listening.getsockname()[:2], _Handler, bind_and_activate=False)
        self.socket.close()
        self.socket = listening

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
