# SPDX-License-Identifier: Apache-2.0
"""A published map at a web server, read with the standard library's `http.client`.

obstore would do, but for three things: it refuses answers of unknown length, it follows redirects to any
host, and it cannot be given a time limit for a body.
"""

from __future__ import annotations

import base64
import http.client
import io
import random
import re
import socket
import ssl
import threading
import time
import urllib.parse
import urllib.request
from collections.abc import Callable
from email.utils import parsedate_to_datetime
from functools import partial
from typing import Any, Final, NoReturn, TypeAlias, TypeVar

from shmmap.errors import BadRequest, ConfigError, MapMissing, Offline
from shmmap.origin.remote.store import Listed, StoreRefused, StoreUrl, Tag, Timeouts
from shmmap.origin.remote.transport import (
    AGAIN,
    BETWEEN,
    NO_TLS,
    PROXY,
    Body,
    answer_limit_s,
    call_apart,
    refuse_page,
    refuse_plain_http,
    status_hint,
    too_slow,
    unasked_304,
)

_READ_ONLY: Final = "a web server cannot be written to: publish to its directory, or to the bucket behind it"
_SILENT: Final = "is the network up, and the address right?"
_PUBLIC: Final = "a web server is asked without credentials: may everybody read there?"
_ADDRESS: Final = "is the address right?"
_ELSEWHERE: Final = "only redirects to the same server are followed: name the place itself in the URL"
_CERTIFICATE: Final = "SSL_CERT_FILE names further authorities; is the clock right?"
_TUNNEL: Final = re.compile(r"Tunnel connection failed: ([0-9]+)")  # of `http.client`
_IN_TARGETS: Final = "%/:=&?~#+!$,;'@()*[]"
_PIECE_BYTES: Final = 64 << 10
_MAX_REDIRECTS: Final = 5
_IDLE_CONNECTIONS: Final = 32
_IDLE_S: Final = 50.0
"""An idle connection is used again for this long: servers close them after 60 s or more, as a rule."""
_FIRST_PAUSE_S: Final = 0.05
_LONGEST_PAUSE_S: Final = 5.0


_OK: Final = 200
_PARTIAL: Final = 206
_NOT_MODIFIED: Final = 304
_MOVED: Final = (301, 302, 303, 307, 308)
_NO_PERMISSION: Final = (401, 403)
_GONE: Final = (404, 410)
_TRANSIENT: Final = (429, 500, 502, 503, 504)

_Answer = TypeVar("_Answer")


class _Late(Exception):
    """The answer has taken longer than its limit."""


class _NotModified(Exception):
    """The object is still in the state that the request named."""


class _Moved(Exception):
    """The answer names another place at the same server."""

    def __init__(self, target: str) -> None:
        super().__init__()
        self.target = target


class _Failed(Exception):
    """A failure that another try may not have; ``error`` is raised if none is left."""

    def __init__(self, error: Offline) -> None:
        super().__init__()
        self.error = error


class _Clock:
    """Time limit of one answer; ``until_s`` in `time.monotonic`."""

    def __init__(self, read_s: float) -> None:
        self.read_s = read_s
        self.allow(0)

    def allow(self, nbytes: int) -> None:
        """Begin the limit of an answer of this size."""
        self.limit_s = answer_limit_s(self.read_s, nbytes)
        self.until_s = time.monotonic() + self.limit_s

    def set_on(self, connected: socket.socket) -> None:
        """Limit the next operation of a socket."""
        connected.settimeout(min(self.check(), self.read_s))

    def check(self) -> float:
        """Return the seconds that are left; raise if there are none."""
        left_s = self.until_s - time.monotonic()
        if left_s <= 0:
            raise _Late
        return left_s


class _Received(io.RawIOBase):
    """What a socket receives, each read limited by a clock."""

    def __init__(self, connected: socket.socket, clock: _Clock) -> None:
        self._socket, self._clock = connected, clock
        self._file = connected.makefile("rb", buffering=0)  # keeps a socket open that `http.client` closes

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        self._clock.set_on(self._socket)
        try:
            return self._file.readinto(buffer) or 0
        except TimeoutError:
            self._clock.check()
            raise

    def close(self) -> None:
        self._file.close()
        super().close()

    def makefile(self, _mode: str) -> io.BufferedReader:
        """Return the reader that `http.client` asks its socket for."""
        return io.BufferedReader(self, _PIECE_BYTES)


class _Connection:
    """One connection, of which the server's certificate was verified; used by one request at a time."""

    def __init__(self, server: _Server) -> None:
        self.clock = clock = _Clock(server.timeouts.read_s)
        self.used_s = 0.0
        self._response: http.client.HTTPResponse | None = None
        kind: Any = http.client.HTTPConnection
        if server.tls is not None:
            kind = partial(http.client.HTTPSConnection, context=server.tls)
        self._client = kind(*(server.proxy or server.address), timeout=server.timeouts.connect_s)
        if server.proxy and server.tls is not None:
            self._client.set_tunnel(*server.address, headers=server.proxy_headers)

        class Response(http.client.HTTPResponse):
            def __init__(self, sock: socket.socket, *given: Any, **named: Any) -> None:
                super().__init__(_Received(sock, clock), *given, **named)  # type: ignore[arg-type]

        self._client.response_class = Response

    def ask(self, method: str, target: str, headers: dict[str, str]) -> http.client.HTTPResponse:
        """Send a request and return the answer, whose body has not been read."""
        if self._client.sock is None:
            self._client.connect()
        self.clock.allow(0)
        self.clock.set_on(self._client.sock)
        self._client.request(method, target, headers=headers)
        response: http.client.HTTPResponse = self._client.getresponse()
        self._response = response
        return response

    def close(self) -> None:
        self._client.close()
        if self._response is not None:
            self._response.close()


class _Server:
    """One server and its idle connections."""

    def __init__(self, url: str, timeouts: Timeouts) -> None:
        self._idle: list[_Connection] = []
        self._lock = threading.Lock()
        parts = urllib.parse.urlsplit(url)
        self.timeouts = timeouts
        self.origin = _origin_of(url)
        self.address = parts.hostname or "", parts.port or (443 if parts.scheme == "https" else 80)
        self.tls = ssl.create_default_context() if parts.scheme == "https" else None
        self.proxy, self.proxy_headers = _proxy_for(parts)

    def __del__(self) -> None:
        for connection in self._idle:
            connection.close()

    def connection(self) -> tuple[_Connection, bool]:
        """Return a connection, and whether it was used before."""
        with self._lock:
            while self._idle:
                connection = self._idle.pop()
                if time.monotonic() - connection.used_s < _IDLE_S:
                    return connection, True
                connection.close()
        return _Connection(self), False

    def keep(self, connection: _Connection) -> None:
        """Use a connection again, whose last answer was read to its end."""
        connection.used_s = time.monotonic()
        with self._lock:
            if len(self._idle) < _IDLE_CONNECTIONS:
                self._idle.append(connection)
                return
        connection.close()

    def target(self, path: str) -> str:
        """Return the target of a request line; a proxy needs the whole URL."""
        return f"{self.origin}{path}" if self.proxy and self.tls is None else path


def _origin_of(url: str) -> str:
    """Return scheme, host and port of a URL; only these may be asked."""
    parts = urllib.parse.urlsplit(url)
    scheme, host = parts.scheme.lower(), (parts.hostname or "").lower()
    port = parts.port or {"https": 443, "http": 80}.get(scheme, 0)
    return f"{scheme}://{f'[{host}]' if ':' in host else host}:{port}"


def _proxy_for(parts: urllib.parse.SplitResult) -> tuple[tuple[str, int] | None, dict[str, str]]:
    """Return the proxy that the environment names for a URL, and headers for it."""
    proxies = urllib.request.getproxies()
    named = proxies.get(parts.scheme.lower()) or proxies.get("all", "")
    if not named or urllib.request.proxy_bypass(parts.netloc):
        return None, {}
    try:
        found = urllib.parse.urlsplit(named if "://" in named else f"http://{named}")
        port = found.port or 80
    except ValueError:
        raise _bad_proxy("it is no valid URL") from None
    if found.scheme != "http" or not found.hostname:
        raise _bad_proxy("its URL has to begin with http://")
    headers = {}
    if found.username:
        user = f"{urllib.parse.unquote(found.username)}:{urllib.parse.unquote(found.password or '')}"
        headers["Proxy-Authorization"] = f"Basic {base64.b64encode(user.encode()).decode()}"
    return (found.hostname, port), headers


def _bad_proxy(why: str) -> ConfigError:
    return ConfigError("the proxy that the environment names cannot be used", hint=why)


_Take: TypeAlias = Callable[[str, http.client.HTTPResponse, _Clock], _Answer]
"""Makes something of an answer; its arguments are the object's URL, the answer, and its time limit."""


class WebServer:
    """A `shmmap.origin.remote.store.Store` below an ``http`` or ``https`` URL, which can only be read."""

    read_only = _READ_ONLY

    def __init__(self, where: StoreUrl, *, timeouts: Timeouts, insecure_http: bool) -> None:
        refuse_plain_http(where, where.text, insecure_http=insecure_http)
        self.url = where.text
        self._timeouts = timeouts
        self._server = _Server(where.text, timeouts)
        self._base = urllib.parse.quote(urllib.parse.urlsplit(where.text).path, safe="/%~!$&'()*+,;=:@")

    # --- reading --------------------------------------------------------------------------------

    def get(self, path: str, max_bytes: int) -> memoryview:
        """Return a whole object."""
        return self._read(path, _Reading(max_bytes))[0]

    def get_exactly(self, path: str, nbytes: int) -> memoryview:
        """Return an object of exactly ``nbytes`` bytes."""
        return self._read(path, _Reading(nbytes, exact=True))[0]

    def get_tagged(self, path: str, max_bytes: int) -> tuple[memoryview, Tag]:
        """Return a whole object, and its ETag."""
        return self._read(path, _Reading(max_bytes))

    def get_if_changed(self, path: str, max_bytes: int, tag: Tag) -> tuple[memoryview, Tag] | None:
        """Return a whole object and its ETag; None if the ETag is still that of ``tag``."""
        try:
            return self._read(path, _Reading(max_bytes, unless=tag.get("e_tag")))
        except _NotModified:
            return None

    def _read(self, path: str, reading: _Reading) -> tuple[memoryview, Tag]:
        return self._ask("GET", path, reading.take, reading.headers)

    def head(self, path: str) -> Listed | None:
        """Return an object's size and time of writing; None if it does not exist."""
        try:
            size, modified_s = self._ask("HEAD", path, _described, dict)
        except MapMissing:
            return None
        return Listed(path, size, modified_s)

    # --- writing --------------------------------------------------------------------------------

    def _refuse(self, *_: object) -> NoReturn:
        """Raise `BadRequest`: a web server can neither be listed nor written."""
        raise BadRequest(f"{self.url}: {self.read_only}")

    list = require_conditions = put = put_new = put_if = delete = _refuse

    # --- requests -------------------------------------------------------------------------------

    def _ask(
        self, method: str, path: str, take: _Take[_Answer], headers: Callable[[], dict[str, str]]
    ) -> _Answer:
        """Make a request, again if it fails, and return what ``take`` makes of the answer."""
        return call_apart(partial(self._repeat, method, path, take, headers))

    def _repeat(
        self, method: str, path: str, take: _Take[_Answer], headers: Callable[[], dict[str, str]]
    ) -> _Answer:
        name, target = f"{self.url}/{path}", f"{self._base}/{urllib.parse.quote(path)}"
        tries, pause_s, began_s = 0, _FIRST_PAUSE_S, time.monotonic()
        while True:
            try:
                return self._follow(name, method, target, {"User-Agent": "shmmap", **headers()}, take)
            except _Failed as failed:
                tries += 1
                if tries > self._timeouts.retries or time.monotonic() - began_s > self._timeouts.retry_s:
                    raise failed.error from None
            time.sleep(pause_s * random.uniform(0.5, 1.0))  # noqa: S311  no secret
            pause_s = min(2 * pause_s, _LONGEST_PAUSE_S)

    def _follow(
        self, name: str, method: str, target: str, headers: dict[str, str], take: _Take[_Answer]
    ) -> _Answer:
        """Make a request, and follow redirects within this server, which together have the time of one."""
        limit_s = answer_limit_s(self._timeouts.read_s, 0)
        end_s = time.monotonic() + limit_s
        for _ in range(_MAX_REDIRECTS + 1):
            try:
                return self._once(name, method, target, headers, take)
            except _Moved as moved:
                target = moved.target
            if time.monotonic() > end_s:
                raise too_slow(name, limit_s)
        raise StoreRefused(f"{name}: refused, its redirects do not end")

    def _once(
        self, name: str, method: str, target: str, headers: dict[str, str], take: _Take[_Answer]
    ) -> _Answer:
        server = self._server
        connection, is_old = server.connection()
        is_complete = False
        try:
            try:
                response = connection.ask(method, server.target(target), headers)
            except ConnectionError:  # the server has closed an idle connection
                if not is_old:
                    raise
                connection.close()
                connection = _Connection(server)
                response = connection.ask(method, server.target(target), headers)
            self._check(name, target, headers, response)
            result = take(name, response, connection.clock)
            is_complete = response.isclosed() or response.length == 0
            response.close()
            if is_complete:
                server.keep(connection)
            return result
        except _Late:
            raise too_slow(name, connection.clock.limit_s) from None
        except ssl.SSLCertVerificationError:
            raise StoreRefused(
                f"{name}: the server's certificate is not accepted", hint=_CERTIFICATE
            ) from None
        except ssl.SSLError as error:
            if isinstance(error, ssl.SSLEOFError):
                raise _Failed(Offline(f"{name}: no answer", hint=_SILENT)) from None
            raise StoreRefused(f"{name}: the answer is no TLS", hint=NO_TLS) from None
        except OSError as error:
            if refused := _TUNNEL.match(str(error)):
                wants = "wants a user and a password" if refused[1] == "407" else "does not connect to it"
                raise StoreRefused(f"{name}: the proxy {wants} (status {refused[1]})", hint=PROXY) from None
            raise _Failed(Offline(f"{name}: no answer", hint=_SILENT)) from None
        except (http.client.HTTPException, ValueError):
            raise _Failed(Offline(f"{name}: the answer is no HTTP", hint=_SILENT)) from None
        finally:
            if not is_complete:
                connection.close()

    def _check(
        self, name: str, target: str, headers: dict[str, str], response: http.client.HTTPResponse
    ) -> None:
        """Raise what an answer without an object means."""
        status, where = response.status, response.getheader("Location", "")
        if status == _OK or (status == _PARTIAL and "Range" in headers):
            return
        if status == _NOT_MODIFIED:
            raise _NotModified if "If-None-Match" in headers else unasked_304(name)
        if status in _GONE:
            raise MapMissing(f"{name} is not there")
        if status in _NO_PERMISSION:
            raise StoreRefused(f"{name}: refused, no permission", hint=_PUBLIC, of_credentials=True)
        if status in _MOVED:
            origin = self._server.origin
            there = urllib.parse.urljoin(f"{origin}{target}", where)
            if not where or _origin_of(there) != origin:
                raise StoreRefused(f"{name}: refused, it is somewhere else", hint=_ELSEWHERE)
            parts = urllib.parse.urlsplit(urllib.parse.quote(there.encode("latin-1"), safe=_IN_TARGETS))
            raise _Moved(urllib.parse.urlunsplit(("", "", parts.path or "/", parts.query, "")))
        refused = StoreRefused(f"{name}: refused (status {status})", hint=status_hint(status, _ADDRESS))
        if status in _TRANSIENT:
            raise _Failed(refused)
        raise refused


class _Reading:
    """Reads an object; after a failure in the middle, another request asks for the rest."""

    def __init__(self, max_bytes: int, *, exact: bool = False, unless: str | None = None) -> None:
        self._max_bytes, self._exact, self._unless = max_bytes, exact, unless
        self._body: Body | None = None
        self._tag = ""

    def headers(self) -> dict[str, str]:
        """Return headers for the next request."""
        body = self._body
        if body is not None and body.size is not None and body.at and self._tag.startswith('"'):
            return {"Range": f"bytes={body.at}-", "If-Range": self._tag}
        return {"If-None-Match": self._unless} if self._unless else {}

    def take(self, name: str, response: http.client.HTTPResponse, clock: _Clock) -> tuple[memoryview, Tag]:
        """Read an answer."""
        body = self._body
        if response.status == _OK or body is None:
            self._tag = response.getheader("ETag", "")
            body = self._body = Body(
                name,
                response.length,
                self._max_bytes,
                exact=self._exact,
                media_type=response.getheader("Content-Type", ""),
                encoding=response.getheader("Content-Encoding", ""),
            )
        elif (
            response.getheader("Content-Range", "").split("/")[0] != f"bytes {body.at}-{(body.size or 0) - 1}"
            or response.getheader("Content-Encoding", "identity").lower() != "identity"
        ):
            raise StoreRefused(f"{name}: its answer is another part than the one asked for", hint=BETWEEN)
        elif response.getheader("ETag", self._tag) != self._tag:
            self._body = None
            raise _Failed(StoreRefused(f"{name}: it was changed while it was read", hint=AGAIN))
        clock.allow(self._max_bytes if body.size is None else body.size - body.at)
        try:
            while piece := response.read1(_PIECE_BYTES):
                body.add(piece)
        except TimeoutError:
            raise _Failed(body.cut("stopped")) from None
        except (OSError, http.client.HTTPException):
            raise _Failed(body.cut()) from None
        if body.lacks:
            raise _Failed(body.cut())
        return body.whole(), {"e_tag": self._tag} if self._tag else {}


def _described(name: str, response: http.client.HTTPResponse, _clock: _Clock) -> tuple[int, float]:
    """Return an object's size and time of writing, 0 if unknown."""
    length = response.getheader("Content-Length", "")
    if not length.isdecimal():
        raise StoreRefused(f"{name}: its answer has no length", hint=BETWEEN)
    refuse_page(name, response.getheader("Content-Type", ""))
    try:
        return int(length), parsedate_to_datetime(response.getheader("Last-Modified", "")).timestamp()
    except (ValueError, TypeError):
        return int(length), 0.0
