# SPDX-License-Identifier: Apache-2.0
"""Interface to the storage of a published map: a directory, a bucket or a web server.

It has only the operations that a published map needs.  Objects are read and written whole, named by paths,
and either written once or replaced on a condition.
"""

from __future__ import annotations

import ipaddress
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final, NamedTuple, Protocol, TypeAlias
from urllib.parse import urlsplit

from shmmap.errors import BadRequest, MapMissing, Offline

BUCKET_SCHEMES: Final = ("s3", "gs", "az")
WEB_SCHEMES: Final = ("https", "http")
_SCHEMES: Final = ("file", *BUCKET_SCHEMES, *WEB_SCHEMES)

Tag: TypeAlias = Mapping[str, Any]
"""Token for one state of an object, such as an ETag; opaque to all but the store that returned it."""


class StoreRefused(Offline):
    """The store answered with a refusal.

    ``of_credentials``: the reason is the account or its credentials.  If an account may not list objects, a
    store also gives this reply for an object that does not exist.  ``status``: that of HTTP; 0: none.
    """

    def __init__(
        self, message: str, *, hint: str = "", of_credentials: bool = False, status: int = 0
    ) -> None:
        super().__init__(message, hint=hint)
        self.of_credentials = of_credentials
        self.status = status


class NoBucket(StoreRefused):
    """There is no such bucket; what would be in it is not merely missing."""

    exit_code = MapMissing.exit_code
    advice = "make the bucket first, or correct its name"


class NoTag(StoreRefused):
    """The store has answered without an ETag, so it is not known what it has done."""


class Listed(NamedTuple):
    """An object: path relative to the store's URL, size in bytes, and time of writing (Unix time)."""

    path: str
    size: int
    modified_s: float


class ObjectReader(Protocol):
    """Reads whole objects whose size is known; thread-safe."""

    @property
    def url(self) -> str:
        """URL or path of the store, as users write it."""

    def get_exactly(self, path: str, nbytes: int) -> memoryview:
        """Return an object of exactly ``nbytes`` bytes.

        Raises
        ------
        Offline
            The store does not answer in time, or refuses.
        MapMissing
            The object does not exist.
        MapDataError
            The object has more or fewer bytes.
        """


class Store(ObjectReader, Protocol):
    """Objects below one URL.  All methods are thread-safe.

    Every method raises `Offline` if the store does not answer in time or refuses, and `CannotWrite` if a
    directory's disk is full or not writable.  No message contains a credential.
    """

    @property
    def read_only(self) -> str:
        """Why the store can neither be written nor listed; empty if it can."""

    def get(self, path: str, max_bytes: int) -> memoryview:
        """Return a whole object.

        Raises
        ------
        MapMissing
            The object does not exist.
        MapDataError
            The object is larger than ``max_bytes``, so it is not read.
        """

    def get_tagged(self, path: str, max_bytes: int) -> tuple[memoryview, Tag]:
        """Return a whole object, and the tag of its state."""

    def get_if_changed(self, path: str, max_bytes: int, tag: Tag) -> tuple[memoryview, Tag] | None:
        """Return a whole object and its tag; None if it is still in the state that ``tag`` names."""

    def head(self, path: str) -> Listed | None:
        """Return an object's size and time of writing; None if it does not exist."""

    def list(self, prefix: str) -> Iterator[Listed]:
        """Yield all objects whose path begins with ``prefix``, which ends with ``/``, in any order."""

    def require_conditions(self, tag: Tag | None = None) -> None:
        """Raise an error if `put_new` or `put_if` cannot keep their promise; publishers call it first.

        Parameters
        ----------
        tag
            Tag of an object that is to be replaced.

        Raises
        ------
        BadRequest
            The store is read-only.
        CannotWrite
            The store ignores or refuses conditions, or the tag cannot be used for one.
        """

    def put(self, path: str, data: bytes) -> None:
        """Write an object that is named by its content; an existing object is overwritten."""

    def put_new(self, path: str, data: bytes) -> bool:
        """Write an object if none exists at this path; return False if another one exists, which stays."""

    def put_if(self, path: str, data: bytes, tag: Tag) -> bool:
        """Replace an object if it still is in the state that ``tag`` names; return False if it is not."""

    def delete(self, path: str) -> None:
        """Remove an object; a missing object is not an error."""


def refuse_read_only(store: Store) -> None:
    """Raise `BadRequest` if the store is read-only."""
    if store.read_only:
        raise BadRequest(f"{store.url}: {store.read_only}")


def put_over(store: Store, path: str, data: bytes, seen: Tag | None) -> bool:
    """Replace an object if its tag is still ``seen`` (None: no object); return False if it has changed."""
    return store.put_new(path, data) if seen is None else store.put_if(path, data, seen)


@dataclass(frozen=True, slots=True)
class Timeouts:
    """Time limits of requests in seconds (connection, next bytes, all retries together), and retries."""

    connect_s: float
    read_s: float
    retries: int
    retry_s: float


SERVING: Final = Timeouts(connect_s=1.0, read_s=2.0, retries=2, retry_s=2.5)
"""For requests that clients wait for; a silent server is asked once more."""
PROBE: Final = Timeouts(connect_s=1.0, read_s=1.0, retries=0, retry_s=1.0)
"""To find out whether a server is back."""
LONG_RUN: Final = Timeouts(connect_s=10.0, read_s=30.0, retries=8, retry_s=31.0)
"""For long runs."""


@dataclass(frozen=True, slots=True)
class StoreUrl:
    """A parsed URL: ``path`` of a directory, or ``text`` without a final ``/``."""

    scheme: str
    text: str
    path: str = ""
    host: str = ""


def is_url(text: str) -> bool:
    """Whether a text is a URL, not a path."""
    return "://" in text


def is_published(path: str) -> bool:
    """Whether a path names a published map: a URL, or a directory with a file ``CURRENT``."""
    return is_url(path) or os.path.isfile(os.path.join(path, "CURRENT"))


def read_url(text: str) -> StoreUrl:
    """Parse the URL or path of a published map.

    Raises
    ------
    BadRequest
        The text is neither a URL of a known scheme nor a path, or contains a password or a query.
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
    # a bucket's name is in place of the host, so its case is kept
    return StoreUrl(scheme, f"{scheme}://{parts.netloc}{parts.path}".rstrip("/"), host=host)


def may_be_plain(url: str, *, insecure_http: bool, trust: str | None) -> bool:
    """Whether a map may be read over plain ``http://`` from other machines.

    It may if the user allows it.  It also may from a web server if a root of trust is given, since then
    everything read is verified.  Requests to a bucket contain credentials, which a map's signature does not
    protect.
    """
    return insecure_http or bool(trust and is_url(url) and url.partition("://")[0].lower() in WEB_SCHEMES)


def is_loopback(host: str) -> bool:
    """Whether a host name or address is this machine's loopback."""
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return host == "localhost" or host.endswith(".localhost")
