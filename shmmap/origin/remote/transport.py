# SPDX-License-Identifier: Apache-2.0
"""How long an answer of a store may take, how large it may be, and what is said of one that is wrong.

A limit for each read alone would let a server that sends a byte a second hold a request for hours.  So each
whole answer has one: ``read_s`` and a second for every 64 KiB of it.  Bodies are read against the clock; what
a library does before and after runs in a thread that is left alone when its time is over.  A main thread that
waits for either still handles signals.

=========================================  ==========================  ===================================
what                                       ``serve``                   ``fetch versions publish prepare``
=========================================  ==========================  ===================================
a connection                               1 s                         10 s
silence, before or within an answer        2 s; asked once more        30 s; asked once more
a whole answer, with its redirects         2 s and 1 s for 64 KiB,     30 s and 1 s for 64 KiB,
                                           at least 3 s                at least 31 s
a bucket's error, or an answer without an  5.5 s                       62 s
object
an object sent to a bucket                                             62 s and 2 s for 64 KiB
a thousand names of a listing                                          70 s
refused connections, statuses 429 and 5xx  again twice, for 2.5 s      again 8 times, for 31 s
=========================================  ==========================  ===================================

An answer that is not complete at its limit is not asked for again: the object is offline.  What is slow, or
has failed in the last minute, takes no place from other objects.
"""

from __future__ import annotations

import contextlib
import contextvars
import math
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, wait
from functools import partial
from typing import Final, NoReturn, TypeVar

from shmmap.errors import BadRequest, MapDataError, Offline
from shmmap.origin.remote.store import WEB_SCHEMES, StoreRefused, StoreUrl, is_loopback
from shmmap.origin.remote.zstd_frame import DAMAGED
from shmmap.processes.request_threads import PREFIX

_Answer = TypeVar("_Answer")

BYTES_PER_S: Final = 64 << 10
"""Rate below which an answer is given up."""
_PANICS: Final = ("PanicException", "RustPanic")
BETWEEN: Final = "does a proxy between here and the store change its answers?"
AGAIN: Final = "try again later"
CREDENTIALS: Final = "are the credentials valid, and is the clock right?"
NO_TLS: Final = "is the port right? For plain http, the address begins with http://"
PROXY: Final = (
    "http_proxy and https_proxy name the proxy, with its user and password, and no_proxy exceptions"
)
_LOOK_S: Final = 0.1
_PAGE_BYTES: Final = 64 << 10
_PORTAL: Final = "is this the login page of a network, or another server than the map's?"
_CUT: Final = "does the store, or something between here and it, end transfers early?"
_SLOW: Final = "is the link this slow, or does something between here and the store hold its answers back?"


_ARRIVED: Final[contextvars.ContextVar[Callable[[int], None]]] = contextvars.ContextVar(
    "arrived", default=lambda _nbytes: None
)


@contextlib.contextmanager
def reporting_bytes(report: Callable[[int], None]) -> Iterator[None]:
    """Within the block, call ``report`` with the number of bytes of each piece of an answer that comes.

    It is called in the thread that reads the answer.
    """
    token = _ARRIVED.set(report)
    try:
        yield
    finally:
        _ARRIVED.reset(token)


def answer_limit_s(read_s: float, nbytes: int) -> float:
    """Return the seconds that an answer of this size may take, once it has begun."""
    return read_s + max(nbytes, BYTES_PER_S) / BYTES_PER_S


class Incomplete(Offline):
    """The store answers, but this object has not come whole: others may."""


def too_slow(name: str, seconds: float) -> Offline:
    """Return the error for an answer that has taken longer than its limit."""
    return Incomplete(f"{name}: the answer was not complete within {seconds:.0f} s", hint=_SLOW)


class Body:
    """The bytes of one answer, as they come.

    Parameters
    ----------
    name
        The object's URL, for messages.
    size
        Bytes that the answer announces; None if it does not.
    max_bytes, exact
        The most that is read; with ``exact``, what the object must have.
    media_type, encoding
        Headers ``Content-Type`` and ``Content-Encoding`` of the answer.

    Raises
    ------
    MapDataError
        The answer announces another size.
    Offline
        It is a page, or compressed.
    """

    def __init__(
        self, name: str, size: int | None, max_bytes: int, *, exact: bool, media_type: str, encoding: str
    ) -> None:
        self._name, self._max_bytes, self._exact = name, max_bytes, exact
        self._most = max(max_bytes, _PAGE_BYTES)  # a page is read, so that it is named
        self._media_type = media_type
        if encoding and encoding.lower() != "identity":
            raise StoreRefused(
                f"{name}: its answer is compressed ({encoding[:20]!r}), which was not asked for",
                hint="objects of a map have to be sent as they are stored",
            )
        self.size = size
        if size is not None and size > self._most:
            self._refuse_size(size)
        self._data = bytearray(size or 0)
        self._arrived = _ARRIVED.get()
        self.at = 0

    def add(self, piece: bytes | memoryview) -> None:
        """Take the next bytes."""
        end = self.at + len(piece)
        if end > self._most:
            self._refuse_size(end, more=" or more")
        if end > len(self._data):
            self._data.extend(bytes(end - len(self._data)))
        self._data[self.at : end] = piece
        self.at = end
        self._arrived(len(piece))

    @property
    def lacks(self) -> bool:
        """Whether bytes that the answer announced have not come."""
        return self.size is not None and self.at < self.size

    def cut(self, how: str = "ended") -> Offline:
        """Return the error for an answer that has ended too early."""
        of = f" of {self.size:,}" if self.size is not None else ""
        return Incomplete(f"{self._name}: the answer {how} after {self.at:,}{of} bytes", hint=_CUT)

    def whole(self) -> memoryview:
        """Return all bytes; raise if some are missing, or if they are a page."""
        if self.lacks:
            raise self.cut()
        if self.size is not None and self.at > self.size:
            raise StoreRefused(
                f"{self._name}: it has sent more than the {self.size:,} bytes announced", hint=_CUT
            )
        if bytes(self._data[:64]).lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"<"):
            raise _page(self._name, self._media_type)
        if self.at > self._max_bytes or (self._exact and self.at != self._max_bytes):
            self._refuse_size(self.at)
        return memoryview(self._data)

    def _refuse_size(self, size: int, more: str = "") -> NoReturn:
        refuse_page(self._name, self._media_type)
        limit = f"not {self._max_bytes:,}" if self._exact else f"at most {self._max_bytes:,} are read"
        raise MapDataError(f"it has {size:,} bytes{more}, {limit}", path=self._name, cause=DAMAGED)


def refuse_page(name: str, media_type: str) -> None:
    """Raise if an answer is a page, as captive portals send it in place of every object."""
    if media_type.lower().startswith("text/html"):
        raise _page(name, media_type)


def _page(name: str, media_type: str) -> Offline:
    kind = media_type.partition(";")[0].strip().lower() or "of no stated type"
    return StoreRefused(f"{name}: what the store answers is no map: a page ({kind})", hint=_PORTAL)


_HINTS: Final = {
    **dict.fromkeys((400, 401, 403), CREDENTIALS),
    407: PROXY,
    **dict.fromkeys((408, 409, 425, 429), AGAIN),
    **dict.fromkeys((412, 413, 416, 431), BETWEEN),
    511: _PORTAL,
}


def status_hint(status: int, otherwise: str) -> str:
    """Return the hint for an answer of this status; for most below 500 it is ``otherwise``."""
    return _HINTS.get(status, AGAIN if status >= 500 else otherwise)


def unasked_304(name: str) -> Offline:
    """Return the error for the answer "not modified" to a request that did not ask whether it is."""
    return StoreRefused(f"{name}: refused (status 304: not modified), which was not asked", hint=BETWEEN)


def refuse_plain_http(where: StoreUrl, endpoint: str, *, insecure_http: bool) -> None:
    """Raise `BadRequest` if requests would go to another machine in plain text and that is not allowed."""
    if endpoint.lower().startswith("http://") and not insecure_http and not is_loopback(host_of(endpoint)):
        raise BadRequest(
            f"{where.text}: plain http:// can be read and changed in transit",
            hint="use https://, or --insecure-http"
            + (", or --trust ROOT.json where the map is signed" if where.scheme in WEB_SCHEMES else ""),
        )


def host_of(url: str) -> str:
    """Return the host name of a URL; empty if it has none."""
    from urllib.parse import urlsplit

    try:
        return urlsplit(url).hostname or ""
    except ValueError:
        return ""


def is_panic(error: BaseException) -> bool:
    """Whether an error is a panic of a library in Rust; most are no `Exception`."""
    return any(kind.__name__ in _PANICS for kind in type(error).__mro__)


# --- waiting ------------------------------------------------------------------------------------------


def call_apart(
    call: Callable[[], _Answer],
    name: str = "",
    limit_s: float = math.inf,
    look: Callable[[], None] = lambda: None,
) -> _Answer:
    """Call a function that may block; the main thread still handles signals meanwhile.

    After the limit, or an exception of a signal handler, the call goes on in a thread until it ends.
    ``look`` is called again and again while this one waits.

    Raises
    ------
    Offline
        The request called ``name`` has not ended within its limit.
    """
    if math.isinf(limit_s) and threading.current_thread() is not threading.main_thread():
        return call()
    future: Future[_Answer] = Future()

    try:
        within = partial(contextvars.copy_context().run, call)
        threading.Thread(target=_run, args=(within, future), name=f"{PREFIX}apart", daemon=True).start()
    except RuntimeError:  # the system allows no more threads
        return call()
    end_s = time.monotonic() + limit_s
    try:
        while not wait([future], min(_LOOK_S, end_s - time.monotonic())).done:
            if time.monotonic() >= end_s:
                raise too_slow(name, limit_s)
            look()
        return future.result()
    finally:
        del future  # else an error, whose text may be long, is kept by its own traceback


def _run(call: Callable[[], _Answer], future: Future[_Answer]) -> None:
    try:
        future.set_result(call())
    except BaseException as error:  # noqa: BLE001  raised in the thread that waits
        future.set_exception(error)
    finally:
        del future
