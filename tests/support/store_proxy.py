# SPDX-License-Identifier: Apache-2.0
"""A proxy before an S3 server that does not do what it should, or says that it did what it did not.

Such stores and proxies exist: they drop conditions, weaken ETags, refuse conditional writes, or answer in a
store's place.
"""

from __future__ import annotations

import http.client
import http.server
import threading
from collections.abc import Callable, MutableMapping
from dataclasses import dataclass, field
from typing import Final
from urllib.parse import urlsplit

from tests.support.map_stores import KEYS

_HOP: Final = ("connection", "transfer-encoding", "content-length", "date", "server")


@dataclass
class Asked:
    """A request, whose header names are in lower case."""

    method: str
    path: str
    headers: MutableMapping[str, str]
    body: bytes

    @property
    def is_conditional(self) -> bool:
        """Whether it is a write on a condition."""
        return self.method == "PUT" and ("if-match" in self.headers or "if-none-match" in self.headers)


@dataclass
class Answer:
    """A reply."""

    status: int
    headers: dict[str, str] = field(default_factory=dict)
    body: bytes = b""


Forward = Callable[[Asked], Answer]
Rule = Callable[[Asked, Forward], Answer]
"""What becomes of a request; it may call the function that asks the server."""


def honest(asked: Asked, forward: Forward) -> Answer:
    """Change nothing."""
    return forward(asked)


def without_headers(*names: str) -> Rule:
    """Drop headers of writes: those that state a condition."""

    def rule(asked: Asked, forward: Forward) -> Answer:
        if asked.method == "PUT":
            for name in names:
                asked.headers.pop(name, None)
        return forward(asked)

    return rule


IGNORING: Final = {
    "If-None-Match": without_headers("if-none-match"),
    "If-Match": without_headers("if-match"),
    "If-Match and If-None-Match": without_headers("if-match", "if-none-match"),
}
"""Stores that ignore conditions, by those that they ignore."""


def with_tags(change: Callable[[str], str], *methods: str) -> Rule:
    """Change the ETags of replies; an empty one is left out."""

    def rule(asked: Asked, forward: Forward) -> Answer:
        answer = forward(asked)
        if asked.method in methods and "etag" in answer.headers:
            tag = change(answer.headers.pop("etag"))
            answer.headers |= {"etag": tag} if tag else {}
        return answer

    return rule


def conditional(status: int, body: bytes = b"") -> Rule:
    """Refuse conditional writes with a status."""

    def rule(asked: Asked, forward: Forward) -> Answer:
        return Answer(status, {}, body) if asked.is_conditional else forward(asked)

    return rule


def page(**headers: str) -> Rule:
    """Answer everything with 200 and a page, as the network of a hotel does."""

    def rule(asked: Asked, forward: Forward) -> Answer:
        del asked, forward
        more = {"last-modified": "Thu, 01 Jan 2026 00:00:00 GMT", **headers}
        return Answer(200, {"content-type": "text/html", **more}, b"<html>Log in</html>")

    return rule


class _Handler(http.server.BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True
    server: _Server

    def log_message(self, *arguments: object) -> None:
        """Say nothing."""

    def do_GET(self) -> None:
        """Answer as the rule says."""
        proxy = self.server.proxy
        headers = {name.lower(): value for name, value in self.headers.items()}
        body = self.rfile.read(int(headers.get("content-length", "0")))
        asked = Asked(self.command, self.path, headers, body)
        proxy.asked.append((asked.method, asked.path.partition("?")[0]))
        answer = proxy.rule(asked, proxy.forward)
        self.send_response(answer.status)
        for name, value in answer.headers.items():
            self.send_header(name, value)
        if answer.status not in (204, 304) and not (self.command == "HEAD" and not answer.body):
            self.send_header("content-length", str(len(answer.body)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(answer.body)

    do_HEAD = do_PUT = do_POST = do_DELETE = do_GET  # noqa: N815  the names that `http.server` calls


class _Server(http.server.ThreadingHTTPServer):
    daemon_threads = True
    request_queue_size = 128
    proxy: StoreProxy


class StoreProxy:
    """A running proxy; `rule` may be changed at any time."""

    def __init__(self, endpoint: str) -> None:
        self.rule: Rule = honest
        self.asked: list[tuple[str, str]] = []
        self._server = _Server(("127.0.0.1", 0), _Handler)
        self._server.proxy = self
        self._host = urlsplit(endpoint).netloc
        self.endpoint = f"http://127.0.0.1:{self._server.server_port}"
        self.environment = {**KEYS, "AWS_ENDPOINT_URL": self.endpoint}
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.02,))
        self._thread.start()

    def forward(self, asked: Asked) -> Answer:
        """Ask the server behind it."""
        connection = http.client.HTTPConnection(self._host, timeout=60)
        try:
            headers = {name: value for name, value in asked.headers.items() if name != "connection"}
            connection.request(asked.method, asked.path, asked.body or None, headers)
            reply = connection.getresponse()
            named = [(name.lower(), value) for name, value in reply.getheaders()]
            kept = {name: value for name, value in named if name not in _HOP}
            if asked.method == "HEAD":
                kept |= {name: value for name, value in named if name == "content-length"}
            return Answer(reply.status, kept, reply.read())
        finally:
            connection.close()

    def requests(self) -> list[tuple[str, str]]:
        """What was asked since the last call: method and path."""
        found, self.asked = self.asked, []
        return found

    def close(self) -> None:
        """End it."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()
