# SPDX-License-Identifier: Apache-2.0
"""Web servers on loopback: one that fails as a test wants it, and nginx with a configuration of the test."""

from __future__ import annotations

import gzip
import hashlib
import http.server
import itertools
import os
import random
import re
import shutil
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from tests.support.daemon_process import Deadline

Read = Callable[[str], bytes]
"""Returns the content of a path; OSError: there is none."""
Fault = Callable[[str], str]
"""What becomes of a request for a path: a status such as ``503``, or one with Amazon's code such as
``403 ExpiredToken``; one of `WRONG_ANSWERS`; ``stall`` (no answer), ``stall body`` (but not the rest of one),
``truncate``, ``corrupt``; ``redirect URL``, which is followed by the path; or nothing."""

DRIP_S = 0.05
PAGE = b"<!DOCTYPE html>\n<html><body>Please log in</body></html>\n"


def _head(status: str, *lines: str) -> bytes:
    return "\r\n".join([f"HTTP/1.1 {status}", "Connection: close", *lines, "", ""]).encode()


def _length(data: bytes) -> str:
    return f"Content-Length: {len(data)}"


def _drip(data: bytes) -> Iterator[bytes]:
    """A byte at a time, and so that the end never comes."""
    for at in itertools.count():
        yield data[at : at + 1] or b" "
        time.sleep(DRIP_S)


def _chunk(data: bytes) -> bytes:
    return b"%x\r\n%s\r\n" % (len(data), data)


WRONG_ANSWERS: dict[str, Callable[[bytes], Iterable[bytes]]] = {
    "drip head": lambda _: _drip(_head("200 OK", "X-Long: " + "x" * 10_000)),
    "drip body": lambda data: itertools.chain([_head("200 OK", _length(data * 99))], _drip(data)),
    "drip error": lambda _: itertools.chain([_head("503 Busy", "Content-Length: 9999")], _drip(b"")),
    "drip chunks": lambda data: itertools.chain(
        [_head("200 OK", "Transfer-Encoding: chunked")], map(_chunk, _drip(data))
    ),
    "continue": lambda _: itertools.chain.from_iterable(
        (_head("100 Continue"), *_pause()) for _ in itertools.count()
    ),
    "endless": lambda _: itertools.chain(
        [_head("200 OK", "Transfer-Encoding: chunked")], itertools.repeat(_chunk(bytes(1 << 16)))
    ),
    "chunked": lambda data: [
        _head("200 OK", "Transfer-Encoding: chunked"),
        *(_chunk(data[at : at + 7]) for at in range(0, len(data), 7)), b"0\r\n\r\n",
    ],
    "chunked cut": lambda data: [
        _head("200 OK", "Transfer-Encoding: chunked"), _chunk(data[: len(data) // 2])
    ],
    "no length": lambda data: [_head("200 OK"), data],
    "cut": lambda data: [_head("200 OK", _length(data)), data[: len(data) // 2]],
    "gzip": lambda data: [
        _head("200 OK", "Content-Encoding: gzip", _length(packed := gzip.compress(data))), packed
    ],
    "page": lambda _: [_head("200 OK", "Content-Type: text/html; charset=utf-8", _length(PAGE)), PAGE],
    "page of no type": lambda _: [_head("200 OK", _length(PAGE)), PAGE],
    "not modified": lambda _: [_head("304 Not Modified")],
    "partial": lambda data: [_head("206 Partial Content", _length(data[:5])), data[:5]],
    "no HTTP": lambda _: [b"SSH-2.0-OpenSSH_9.2\r\n"],
    "closed": lambda _: [],
}  # fmt: skip
"""What is sent in place of an answer with this content; then the connection is closed."""


def endless_error(_data: bytes) -> Iterable[bytes]:
    """A refusal whose text does not end: another of `WRONG_ANSWERS`, which leaves no others a processor."""
    return itertools.chain([_head("403 Forbidden")], itertools.repeat(b"x" * (1 << 16)))


def _pause() -> Iterator[bytes]:
    time.sleep(DRIP_S)
    yield b""


def _no_fault(_path: str) -> str:
    return ""


def _digest(data: bytes) -> str:
    return hashlib.md5(data).hexdigest()


class _Server(http.server.ThreadingHTTPServer):
    daemon_threads = True
    request_queue_size = 128
    web: FaultyWeb

    def get_request(self) -> tuple[socket.socket, object]:
        connection, address = super().get_request()
        self.web.connections.add(connection)
        return connection, address

    def handle_error(self, *_: object) -> None:
        """Ignore a client that has gone, or a connection that was ended: that is intended."""


class _Handler(http.server.BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True
    server: _Server

    def log_message(self, *arguments: object) -> None:
        """Say nothing."""

    def date_time_string(self, timestamp: float | None = None) -> str:
        """Set the time that the server's clock shows."""
        return super().date_time_string((timestamp or time.time()) + self.server.web.clock_ahead_s)

    def do_GET(self) -> None:
        """Answer."""
        web = self.server.web
        web.last_headers = {name.lower(): value for name, value in self.headers.items()}
        path = self.path.lstrip("/")
        self.rfile.read(int(self.headers.get("Content-Length", "0")))
        fault = web.fault(path)
        if fault == "stall":
            web.until_healed()
            self.close_connection = True
            return
        if fault.startswith("redirect "):
            web.note(path, 302)
            self.wfile.write(_head("302 Found", f"Location: {fault.split()[1]}/{path}", "Content-Length: 0"))
            return
        if fault in WRONG_ANSWERS:
            self._answer_wrongly(path, WRONG_ANSWERS[fault])
            return
        if fault[:3].isdigit():
            status, _, code = fault.partition(" ")
            self._answer(int(status), f"<Error><Code>{code}</Code></Error>".encode() if code else b"")
            return
        try:
            data = web.read(path)
        except OSError:
            self._answer(404, b"")
            return
        tag = f'"{web.tag(data)}"'
        if self.headers.get("If-None-Match") == tag:
            self._answer(304, b"", tag)
            return
        found = re.fullmatch(r"bytes=(\d+)-(\d*)", self.headers.get("Range", ""))
        first = int(found[1]) if found else 0
        last = min(int(found[2]), len(data) - 1) if found and found[2] else len(data) - 1
        part = data[first : last + 1]
        if fault == "stall body" and found:
            fault = ""
        if fault == "corrupt":
            part = part[:-1] + bytes([part[-1] ^ 1])
        partly = f"bytes {first}-{last}/{len(data)}" if found else ""
        self._answer(206 if found else 200, part, tag, partly=partly, fault=fault)

    do_HEAD = do_PUT = do_POST = do_GET  # noqa: N815  stores ask so, too; only the faults matter then

    def _answer_wrongly(self, path: str, pieces: Callable[[bytes], Iterable[bytes]]) -> None:
        self.close_connection = True
        try:
            data = self.server.web.read(path)
        except OSError:
            data = b"x" * 40
        self.server.web.note(path, 0)
        for piece in pieces(data):
            self.wfile.write(piece)
            if self.command == "HEAD" and piece.startswith(b"HTTP/1.1 200"):
                return

    def _answer(self, status: int, data: bytes, tag: str = "", *, partly: str = "", fault: str = "") -> None:
        self.server.web.note(self.path.lstrip("/"), status)
        self.send_response(status)
        self.send_header("Content-Length", str(len(data)))
        self.send_header("Last-Modified", "Thu, 01 Jan 2026 00:00:00 GMT")
        if tag:
            self.send_header("ETag", tag)
        if partly:
            self.send_header("Content-Range", partly)
        self.end_headers()
        if fault in ("truncate", "stall body"):
            self.wfile.write(data[: len(data) // 2])
            self.wfile.flush()
            if fault == "stall body":
                self.server.web.until_healed()
            self.connection.shutdown(socket.SHUT_RDWR)
            self.close_connection = True
        else:
            self.wfile.write(data)


class FaultyWeb:
    """A running server; `fault` says what becomes of each request, `tag` what the ETag of a content is."""

    def __init__(self, source: Path | Read) -> None:
        self.folder = source if isinstance(source, Path) else Path(os.devnull)
        self.read: Read = self._read_file if isinstance(source, Path) else source
        self.fault: Fault = _no_fault
        self.tag: Callable[[bytes], str] = _digest
        self.clock_ahead_s = 0.0
        self.last_headers: dict[str, str] = {}
        self.connections: set[socket.socket] = set()
        self._requests: list[tuple[str, int]] = []
        self._healed = threading.Event()
        self._port = 0
        self._server: _Server | None = None
        self._thread: threading.Thread | None = None
        self.listen()

    def _read_file(self, path: str) -> bytes:
        return (self.folder / path).read_bytes()

    @property
    def url(self) -> str:
        """Where it is."""
        return f"http://127.0.0.1:{self._port}"

    def listen(self) -> None:
        """Answer again, at the same port."""
        self._server = _Server(("127.0.0.1", self._port), _Handler)
        self._server.web = self
        self._port = self._server.server_port
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.02,))
        self._thread.start()

    def refuse(self) -> None:
        """Refuse connections, and end those there are."""
        self.heal()
        if self._server is not None and self._thread is not None:
            self._server.shutdown()
            self._server.server_close()
            self._thread.join()
        self._server = None
        for connection in list(self.connections):
            with suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
        self.connections.clear()

    def heal(self) -> None:
        """Fail no more; end requests that stall."""
        self.fault = _no_fault
        self._healed.set()
        self._healed = threading.Event()

    def until_healed(self) -> None:
        """Wait until `heal`."""
        self._healed.wait()

    def note(self, path: str, status: int) -> None:
        """Write down what was asked."""
        self._requests.append((path, status))

    def requests(self) -> list[tuple[str, int]]:
        """What was asked since the last call: path and status."""
        found, self._requests = self._requests, []
        return found


@contextmanager
def faulty_web(source: Path | Read) -> Iterator[FaultyWeb]:
    """Run a server of a directory, or of a reading function, until the end of the block."""
    web = FaultyWeb(source)
    try:
        yield web
    finally:
        web.refuse()


# Nginx on loopback, with a configuration of the test: as a plain web server, or as a gateway


_PLACES = f"{os.environ.get('PATH', '')}{os.pathsep}/usr/sbin{os.pathsep}/usr/local/sbin"

_WEB = """\
worker_processes 1;
pid {folder}/nginx.pid;
events {{ worker_connections 256; }}
http {{
    access_log off;
    client_body_temp_path {folder}/body;
    proxy_temp_path {folder}/proxy;
    fastcgi_temp_path {folder}/fastcgi;
    uwsgi_temp_path {folder}/uwsgi;
    scgi_temp_path {folder}/scgi;
    server {{
        listen 127.0.0.1:{port};
        root {root};
        {more}
    }}
}}
"""


def needed_nginx() -> str:
    """Path of nginx; the test is skipped where there is none."""
    found = shutil.which("nginx", path=_PLACES)
    if found is None:
        pytest.skip("nginx is not installed")
    return found


def free_port() -> int:
    """Return a port that no program listens at, below those that the kernel gives to connections.

    So it is still free when a server that was stopped starts again.
    """
    while True:
        port = random.randrange(20_000, 32_000)
        with socket.socket() as one, suppress(OSError):
            one.bind(("127.0.0.1", port))
            return port


def web_server(root: Path, folder: Path, port: int, more: str = "") -> str:
    """Configuration of a plain web server of a directory."""
    return _WEB.format(folder=folder, port=port, root=root, more=more)


class Nginx:
    """nginx with a configuration, in a process group of its own; its files lie in ``folder``."""

    def __init__(self, configuration: str, folder: Path, port: int) -> None:
        self.port = port
        self.folder = folder
        folder.mkdir(exist_ok=True)
        self._file = folder / "nginx.conf"
        self._process: subprocess.Popen[bytes] | None = None
        self.configure(configuration)

    @property
    def command(self) -> list[str]:
        """Its command: as root its workers stay root, the owner of the tests' directories."""
        user = " user root;" if os.geteuid() == 0 else ""
        log = str(self.folder / "error.log")
        options = ["-p", str(self.folder), "-c", str(self._file), "-e", log, "-g", f"daemon off;{user}"]
        return [needed_nginx(), *options]

    def configure(self, configuration: str) -> None:
        """Take another configuration, from the next start on."""
        self._file.write_text(configuration)

    def start(self) -> None:
        """Start it, and wait until it listens."""
        process = self._process = subprocess.Popen(self.command, start_new_session=True)
        waiting = Deadline()
        while waiting(not self._listens()):
            assert process.poll() is None, (self.folder / "error.log").read_text()
            time.sleep(0.01)

    def _listens(self) -> bool:
        with socket.socket() as one:
            return one.connect_ex(("127.0.0.1", self.port)) == 0

    def kill(self) -> None:
        """Kill all of its processes: transfers end where they are."""
        process, self._process = self._process, None
        if process is not None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()

    def connections(self) -> int:
        """How many connections its workers have open."""
        here = f"0100007F:{self.port:04X}"
        rows = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
        return sum(row[1] == here and row[3] == "01" for row in rows)
