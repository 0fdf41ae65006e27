# SPDX-License-Identifier: Apache-2.0
"""Where a published map lies: a directory, a bucket or a web server, behind one small set of operations.

Only what a published map needs: whole objects, named by paths, made once or replaced on a condition.
"""

from __future__ import annotations

import ipaddress
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final, NamedTuple, Protocol, TypeAlias
from urllib.parse import urlsplit

from shmmap.errors import BadRequest, Offline

__all__ = [
    "BUCKET_SCHEMES",
    "LONG_RUN",
    "PROBE",
    "SERVING",
    "WEB_SCHEMES",
    "Listed",
    "ObjectReader",
    "Store",
    "StoreRefused",
    "StoreUrl",
    "Tag",
    "Timeouts",
    "is_loopback",
    "is_published",
    "is_url",
    "may_be_plain",
    "put_over",
    "read_url",
    "refuse_read_only",
]

BUCKET_SCHEMES: Final = ("s3", "gs", "az")
WEB_SCHEMES: Final = ("https", "http")
_SCHEMES: Final = ("file", *BUCKET_SCHEMES, *WEB_SCHEMES)

Tag: TypeAlias = Mapping[str, Any]
"""Names one state of an object; only the store that gave it knows what is in it."""


class StoreRefused(Offline):
    """The store answers, and refuses.

    ``of_credentials``: because of the account or its credentials.  A store that does not let an account list
    objects also answers so for an object that is absent.
    """

    def __init__(self, message: str, *, hint: str = "", of_credentials: bool = False) -> None:
        super().__init__(message, hint=hint)
        self.of_credentials = of_credentials


class Listed(NamedTuple):
    """An object: its path from the store's URL, its size in bytes, and when it was written (Unix time)."""

    path: str
    size: int
    modified_s: float


class ObjectReader(Protocol):
    """Reads whole objects whose size is known; may be called in threads."""

    @property
    def url(self) -> str:
        """Where it is, as a person would name it."""

    def get_exactly(self, path: str, nbytes: int) -> memoryview:
        """Return an object of exactly ``nbytes`` bytes.

        Raises
        ------
        Offline
            Nothing answers in time, or the answer is a refusal.
        MapMissing
            There is none.
        MapDataError
            It has more or fewer bytes.
        """


class Store(ObjectReader, Protocol):
    """Objects below one URL.  All methods may be called in threads.

    Every method raises `Offline` where nothing answers in time or the answer is a refusal, and `CannotWrite`
    where a directory's disk is full or not writable.  No message holds a credential.
    """

    @property
    def read_only(self) -> str:
        """Why nothing can be written or listed there; empty if it can."""

    def get(self, path: str, max_bytes: int) -> memoryview:
        """Return a whole object.

        Raises
        ------
        MapMissing
            There is none.
        MapDataError
            It has more than ``max_bytes``; it is not read.
        """

    def get_tagged(self, path: str, max_bytes: int) -> tuple[memoryview, Tag]:
        """Return a whole object, and the tag of this state of it."""

    def get_if_changed(self, path: str, max_bytes: int, tag: Tag) -> tuple[memoryview, Tag] | None:
        """Return a whole object and its tag; None if it still is in the state that ``tag`` names."""

    def head(self, path: str) -> Listed | None:
        """Return an object's size and age; None if there is none."""

    def list(self, prefix: str) -> Iterator[Listed]:
        """All objects whose path begins with ``prefix``, which ends with ``/``; in no order."""

    def put(self, path: str, data: bytes) -> None:
        """Write an object that never changes, named by its content; what is there already is replaced."""

    def put_new(self, path: str, data: bytes) -> bool:
        """Write an object that is not there yet; False if another one is, which stays."""

    def put_if(self, path: str, data: bytes, tag: Tag) -> bool:
        """Replace the state of an object that ``tag`` names; False if it has another one now."""

    def delete(self, path: str) -> None:
        """Remove an object; one that is not there is no error."""


def refuse_read_only(store: Store) -> None:
    """Raise `BadRequest` if nothing can be written there."""
    if store.read_only:
        raise BadRequest(f"{store.url}: {store.read_only}")


def put_over(store: Store, path: str, data: bytes, seen: Tag | None) -> bool:
    """Replace an object if its tag still is ``seen`` (None: there was no object); False if it has changed."""
    return store.put_new(path, data) if seen is None else store.put_if(path, data, seen)


@dataclass(frozen=True, slots=True)
class Timeouts:
    """Time limits of requests, seconds: to connect, for the next bytes, and for all retries together."""

    connect_s: float
    read_s: float
    retries: int
    retry_s: float


SERVING: Final = Timeouts(connect_s=1.0, read_s=2.0, retries=2, retry_s=2.5)
"""For requests that clients wait for: a server that is silent, or falls silent, is asked once more."""
PROBE: Final = Timeouts(connect_s=1.0, read_s=1.0, retries=0, retry_s=1.0)
"""To find out whether a server is back."""
LONG_RUN: Final = Timeouts(connect_s=10.0, read_s=30.0, retries=8, retry_s=120.0)
"""For long runs."""


@dataclass(frozen=True, slots=True)
class StoreUrl:
    """A URL that was read: ``path`` of a directory, or ``text`` without a final ``/``."""

    scheme: str
    text: str
    path: str = ""
    host: str = ""


def is_url(text: str) -> bool:
    """Whether it is a URL, no path."""
    return "://" in text


def is_published(path: str) -> bool:
    """Whether a map's path is that of a published one: a URL, or a directory with a file ``CURRENT``."""
    return is_url(path) or os.path.isfile(os.path.join(path, "CURRENT"))


def read_url(text: str) -> StoreUrl:
    """Read where a map is published.

    Raises
    ------
    BadRequest
        If it is no URL of a known scheme and no path, or holds a password or a query.
    """
    if not is_url(text):
        if not text:
            raise BadRequest("a URL or a directory is needed")
        path = os.path.abspath(text)
        return StoreUrl("file", path, path)
    scheme = text.partition("://")[0].lower()
    if scheme not in _SCHEMES:
        raise BadRequest(
            f"a map cannot lie at {scheme}://",
            hint=f"the URL begins with one of {', '.join(f'{s}://' for s in _SCHEMES)}",
        )
    try:
        parts = urlsplit(text)
        host, _ = parts.hostname or "", parts.port
    except ValueError:
        raise BadRequest(f"this is no valid {scheme}:// URL") from None
    if "@" in parts.netloc or parts.query or parts.fragment or "?" in text or "#" in text:
        raise BadRequest(
            f"a URL ({scheme}://) with a user, a query or a fragment is not taken: it may hold a secret",
            hint="credentials come from the environment or a credentials file",
        )
    if scheme == "file":
        if host not in ("", "localhost") or not parts.path:
            raise BadRequest(f"{text} names no directory of this machine", hint="file:///DIRECTORY")
        path = os.path.abspath(parts.path)
        return StoreUrl("file", path, path)
    if not host:
        raise BadRequest(f"{text} names no {'server' if scheme in WEB_SCHEMES else 'bucket'}")
    if any(part in (".", "..") for part in parts.path.split("/")) or not text.isprintable() or " " in text:
        raise BadRequest(f"{text!r} is no plain URL")
    # the host of a bucket is its name: its case stays
    return StoreUrl(scheme, f"{scheme}://{parts.netloc}{parts.path}".rstrip("/"), host=host)


def may_be_plain(url: str, *, insecure_http: bool, trust: str | None) -> bool:
    """Whether a map may be read over plain ``http://`` from other machines.

    It may if the user allows it, and from a web server if a root of trust is named: then all that is read is
    verified.  Requests to a bucket carry credentials, which the signature of a map does not protect.
    """
    return insecure_http or bool(trust and is_url(url) and url.partition("://")[0].lower() in WEB_SCHEMES)


def is_loopback(host: str) -> bool:
    """Whether a host is this machine."""
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return host == "localhost" or host.endswith(".localhost")
