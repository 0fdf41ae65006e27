# SPDX-License-Identifier: Apache-2.0
"""How long an answer of a store may take, how large it may be, and what is said of one that is wrong.

A limit for each read alone would let a server that sends a byte a second hold a request for hours.  So each
whole answer has one: ``read_s`` and a second for every 64 KiB of it.  Requests to buckets run in an event
loop in a thread of its own, which can end them; requests to web servers watch the clock at each read.  A main
thread that waits for either still handles signals.
"""

from __future__ import annotations

import asyncio
import os
import threading
from collections.abc import Awaitable, Callable, Coroutine
from concurrent.futures import Future
from typing import Any, Final, TypeVar

from shmmap.errors import BadRequest, MapDataError, Offline
from shmmap.origin.remote.store import WEB_SCHEMES, StoreRefused, StoreUrl, is_loopback
from shmmap.origin.remote.zstd_frame import DAMAGED

__all__ = [
    "BYTES_PER_S",
    "Body",
    "answer_limit_s",
    "call_apart",
    "host_of",
    "is_panic",
    "page",
    "refuse_plain_http",
    "run_coroutine",
    "too_slow",
    "within",
]

_Answer = TypeVar("_Answer")

BYTES_PER_S: Final = 64 << 10
"""Rate below which an answer is given up."""
_PANICS: Final = ("PanicException", "RustPanic")
_PORTAL: Final = "is this the login page of a network, or another server than the map's?"
_CUT: Final = "does the store, or something between here and it, end transfers early?"
_SLOW: Final = "is the link this slow, or does something between here and the store hold its answers back?"


def answer_limit_s(read_s: float, nbytes: int) -> float:
    """Return the seconds that an answer of this size may take, once it has begun."""
    return read_s + max(nbytes, BYTES_PER_S) / BYTES_PER_S


async def within(name: str, limit_s: float, work: Awaitable[_Answer]) -> _Answer:
    """Wait for a part of a request, and end it at its limit."""
    try:
        return await asyncio.wait_for(work, limit_s)
    except asyncio.TimeoutError:
        raise too_slow(name, limit_s) from None


def too_slow(name: str, seconds: float) -> Offline:
    """Return the error for an answer that has taken longer than its limit."""
    return Offline(f"{name}: the answer was not complete within {seconds:.0f} s", hint=_SLOW)


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
        self._media_type = media_type.partition(";")[0].strip().lower()
        if encoding and encoding.lower() != "identity":
            raise StoreRefused(
                f"{name}: its answer is compressed ({encoding[:20]!r}), which was not asked for",
                hint="objects of a map have to be sent as they are stored",
            )
        self.size = size
        if size is not None:
            self._check(size)
        self._data = bytearray(size or 0)
        self._at = 0

    def add(self, piece: bytes | memoryview) -> None:
        """Take the next bytes."""
        end = self._at + len(piece)
        if end > len(self._data):
            self._check(end, is_all=False)
            self._data.extend(bytes(end - len(self._data)))
        self._data[self._at : end] = piece
        self._at = end

    @property
    def lacks(self) -> bool:
        """Whether bytes that the answer announced have not come."""
        return self.size is not None and self._at < self.size

    def cut(self, how: str = "ended") -> Offline:
        """Return the error for an answer that has ended too early."""
        of = f" of {self.size:,}" if self.size is not None else ""
        return Offline(f"{self._name}: the answer {how} after {self._at:,}{of} bytes", hint=_CUT)

    def whole(self) -> memoryview:
        """Return all bytes; raise if some are missing, or if they are a page."""
        if self.lacks:
            raise self.cut()
        self._check(self._at)
        if bytes(self._data[:64]).lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"<"):
            raise self._page()
        return memoryview(self._data)

    def _check(self, size: int, *, is_all: bool = True) -> None:
        is_other = self._exact and is_all and size != self._max_bytes
        if size <= self._max_bytes and not is_other:
            return
        if self._media_type == "text/html":
            raise self._page()
        limit = f"not {self._max_bytes:,}" if self._exact else f"at most {self._max_bytes:,} are read"
        more = "" if is_all else " or more"
        raise MapDataError(f"it has {size:,} bytes{more}, {limit}", path=self._name, cause=DAMAGED)

    def _page(self) -> Offline:
        return page(self._name, self._media_type)


def page(name: str, media_type: str) -> Offline:
    """Return the error for a page in place of an object, as captive portals send it."""
    return StoreRefused(
        f"{name}: what the store answers is no map: a page ({media_type or 'of no stated type'})",
        hint=_PORTAL,
    )


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


_starting: Final = threading.Lock()
_loop: tuple[int, asyncio.AbstractEventLoop] | None = None  # and the process that it belongs to


def run_coroutine(work: Coroutine[Any, Any, _Answer]) -> _Answer:
    """Run a request in the event loop; an exception in this thread, as Ctrl-C raises, ends the request.

    Raises
    ------
    Offline
        The system allows no more threads.
    """
    try:
        future = asyncio.run_coroutine_threadsafe(work, _running_loop())
    except RuntimeError:
        work.close()
        raise Offline("no request can be made: the system allows no more threads") from None
    try:
        return future.result()
    finally:
        future.cancel()


def _running_loop() -> asyncio.AbstractEventLoop:
    global _loop
    with _starting:
        if _loop is None or _loop[0] != os.getpid():
            loop = asyncio.new_event_loop()
            threading.Thread(target=loop.run_forever, name="requests", daemon=True).start()
            _loop = os.getpid(), loop
        return _loop[1]


def call_apart(call: Callable[[], _Answer]) -> _Answer:
    """Call a function that may block; in the main thread such that signals are handled meanwhile.

    After an exception of a signal handler, the call goes on in its thread until it ends.
    """
    if threading.current_thread() is not threading.main_thread():
        return call()
    future: Future[_Answer] = Future()

    def run() -> None:
        try:
            future.set_result(call())
        except BaseException as error:  # noqa: BLE001  raised in the main thread
            future.set_exception(error)

    threading.Thread(target=run, name="request", daemon=True).start()
    return future.result()
