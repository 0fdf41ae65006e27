# SPDX-License-Identifier: Apache-2.0
"""A published map in a bucket (S3, Google, Azure), accessed with obstore.

The text of an obstore error may contain a signed URL.  So our messages repeat only the kind of the error and
the HTTP status.

Only the host of the URL is asked.  Redirects are refused, except that what is read may be fetched from
another port of the same host: with no signature or key, but with the session token of temporary credentials,
which is of no use without their key; and from ``https://`` to ``http://`` never.  Where requests go through a
proxy (``https_proxy``, ``http_proxy``), redirects are for the proxy to refuse.
"""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from datetime import timedelta
from hashlib import sha256
from typing import Any, Final, TypeVar

from shmmap.errors import ConfigError, MapDataError, MapMissing, Offline
from shmmap.lazy_imports import FOR_REMOTE, needed_packages
from shmmap.origin.remote.bucket_errors import NOWHERE, failure, missing, refuse_unread
from shmmap.origin.remote.conditions import (
    ASKED,
    Seen,
    ask_conditions,
    asked_content,
    refuse_foreign,
    refuse_unsafe_tag,
)
from shmmap.origin.remote.credentials import clean_variables, find_credentials
from shmmap.origin.remote.store import (
    WEB_SCHEMES,
    Listed,
    StoreRefused,
    StoreUrl,
    Tag,
    Timeouts,
)
from shmmap.origin.remote.transport import (
    BETWEEN,
    BYTES_PER_S,
    Body,
    answer_limit_s,
    call_apart,
    host_of,
    is_panic,
    refuse_page,
    refuse_plain_http,
    status_hint,
    too_slow,
    unasked_304,
)
from shmmap.origin.remote.unread_answers import UNREAD

with needed_packages("a map in a bucket", together=FOR_REMOTE):
    import obstore
    from obstore import exceptions
    from obstore.store import AzureStore, GCSStore, S3Store

_Answer = TypeVar("_Answer")

_IMMUTABLE: Final = {
    "Cache-Control": "public, max-age=31536000, immutable",
    "Content-Type": "application/zstd",
}
_CHANGES: Final = {"Cache-Control": "no-cache", "Content-Type": "application/json"}
_HOSTS: Final = {
    "s3": "amazonaws.com,amazonaws.com.cn,api.aws,169.254.169.254,169.254.170.2,169.254.170.23,fd00:ec2::254",
    "gs": "googleapis.com,google.internal,169.254.169.254",
    "az": "windows.net,microsoftonline.com,azure.com,usgovcloudapi.net,microsoftonline.us,chinacloudapi.cn,"
    "partner.microsoftonline.cn,169.254.169.254",
}
"""Hosts of each kind of store, and of servers that credentials come from."""
_ASKED_FOR_CREDENTIALS: Final = (
    "AWS_CONTAINER_CREDENTIALS_FULL_URI",
    "AWS_METADATA_ENDPOINT",
    "AWS_ENDPOINT_URL_STS",
    "AZURE_AUTHORITY_HOST",
    "AZURE_MSI_ENDPOINT",
    "AZURE_STORAGE_MSI_ENDPOINT",
    "IDENTITY_ENDPOINT",
    "MSI_ENDPOINT",
    "GOOGLE_BASE_URL",
)
"""Variables with the URL of a server that obstore asks for credentials, or of a store."""
_BYTES_PER_PAGE: Final = 1 << 19
_LEAST_BYTES: Final = 64 << 10
_BYTES_RATIO: Final = 16
"""Sizes for which a store is opened: the least, and the ratio of two."""
_LATER_S: Final = 2.0
_OBJECTS_PER_PAGE: Final = 1000
_MAX_LOOK_BYTES: Final = 1 << 16


class BucketStore:
    """A `shmmap.origin.remote.store.Store` below a URL; `opened_store.open_store` makes it.

    After the first request to any store, a forked process cannot make requests: obstore's threads are
    missing in it.
    """

    read_only = ""

    def __init__(
        self, where: StoreUrl, *, timeouts: Timeouts, insecure_http: bool, instance_credentials: bool
    ) -> None:
        self.url = where.text
        self._scheme = where.scheme
        self._instance = instance_credentials
        self._timeouts = timeouts
        self._limit_s = timeouts.retry_s + answer_limit_s(timeouts.read_s, 0)
        self._open = _opener(where, timeouts, insecure=insecure_http, instance=instance_credentials)
        self._opened: dict[tuple[int, bool], Any] = {}
        self._opening = threading.Lock()
        self._store()  # settings that cannot be used are refused now
        self._asking = threading.Lock()
        self._is_asked = False

    def _store(self, nbytes: int = 0, *, sends: bool = False) -> Any:
        """Return obstore's store for requests that read, or send, up to ``nbytes``.

        obstore takes the time in which it sends for silence, and only a limit for all requests of a store
        ends an error's text that drips.  That limit is above the stated ones, so it ends what was given up.
        """
        most = _LEAST_BYTES
        while most < nbytes:
            most *= _BYTES_RATIO
        with self._opening:
            if (most, sends) not in self._opened:
                more_s = answer_limit_s(0.0, most)
                self._opened[most, sends] = self._open(
                    self._limit_s + more_s + _LATER_S, more_s if sends else 0.0
                )
            return self._opened[most, sends]

    # --- reading --------------------------------------------------------------------------------

    def get(self, path: str, max_bytes: int) -> memoryview:
        """Return a whole object."""
        return self._read(path, max_bytes)[0]

    def get_exactly(self, path: str, nbytes: int) -> memoryview:
        """Return an object of exactly ``nbytes`` bytes."""
        return self._read(path, nbytes, exact=True)[0]

    def get_tagged(self, path: str, max_bytes: int) -> tuple[memoryview, Tag]:
        """Return a whole object, and its ETag."""
        return self._read(path, max_bytes)

    def get_if_changed(self, path: str, max_bytes: int, tag: Tag) -> tuple[memoryview, Tag] | None:
        """Return a whole object and its ETag; None if the ETag is still that of ``tag``."""
        try:
            return self._read(path, max_bytes, unless=tag.get("e_tag"))
        except exceptions.NotModifiedError:
            return None

    def _read(
        self, path: str, max_bytes: int, *, exact: bool = False, unless: str | None = None
    ) -> tuple[memoryview, Tag]:
        asked = {"if_none_match": unless} if unless else None
        body, tag = self._answer(path, max_bytes, exact=exact, options=asked)
        return body.whole(), tag

    def _answer(
        self, path: str, max_bytes: int, *, exact: bool = False, options: Any = None
    ) -> tuple[Body, Tag]:
        """Return the body and the tag of the answer for an object."""
        name = self._name(path)
        store = self._store(max_bytes)
        result = self._ask(
            path, lambda: obstore.get(store, path, options=options), conditional=options is not None
        )
        meta, headers = result.meta, result.attributes
        body = Body(
            name,
            meta["size"],
            max_bytes,
            exact=exact,
            media_type=str(headers.get("Content-Type", "")),
            encoding=str(headers.get("Content-Encoding", "")),
        )
        limit_s = answer_limit_s(self._timeouts.read_s, meta["size"])
        self._ask(path, lambda: _fill(name, body, result, limit_s), more_s=limit_s)
        return body, _named(meta)

    def head(self, path: str) -> Listed | None:
        """Return an object's size and time of writing; None if it does not exist."""

        def head() -> Listed:
            result = obstore.get(self._store(), path, options={"head": True})
            refuse_page(self._name(path), str(result.attributes.get("Content-Type", "")))
            return Listed(path, result.meta["size"], result.meta["last_modified"].timestamp())

        try:
            return self._ask(path, head)
        except MapMissing:
            return None

    def list(self, prefix: str) -> Iterator[Listed]:
        """Yield all objects below a prefix."""
        store = self._store(_BYTES_PER_PAGE)
        chunks = iter(obstore.list(store, prefix.rstrip("/"), chunk_size=_OBJECTS_PER_PAGE))

        def next_page() -> Sequence[Any]:
            return next(chunks, ())

        began: set[str] = set()
        while page := self._ask(prefix, next_page, more_s=_BYTES_PER_PAGE / BYTES_PER_S):
            if page[0]["path"] in began:
                raise StoreRefused(f"{self._name(prefix)}: its listing repeats without end", hint=BETWEEN)
            began.add(page[0]["path"])
            UNREAD.take(_BYTES_PER_PAGE)
            for meta in page:
                yield Listed(meta["path"], meta["size"], meta["last_modified"].timestamp())
        if not began:  # obstore takes a page for an empty listing
            self.head(f"{prefix}none")

    # --- writing --------------------------------------------------------------------------------

    def put(self, path: str, data: bytes) -> None:
        """Write an object that never changes."""
        self._put(path, data, None, _IMMUTABLE)

    def require_conditions(self, tag: Tag | None = None) -> None:
        """Ask the store once whether it writes on conditions; see `conditions.ask_conditions`."""
        with self._asking:
            if not self._is_asked:
                ask_conditions(self)
                self._is_asked = True
        if tag is not None:
            refuse_unsafe_tag(self.url, tag)

    def put_new(self, path: str, data: bytes) -> bool:
        """Write an object if none exists at this path."""
        return self._is_written(path, data, lambda: self.write(path, data, create=True))

    def put_if(self, path: str, data: bytes, tag: Tag) -> bool:
        """Replace an object if it is still in the state that ``tag`` names."""
        refuse_unsafe_tag(self.url, tag)
        try:
            return self._is_written(path, data, lambda: self.write(path, data, tag))
        except MapMissing:
            return False

    def _is_written(self, path: str, data: bytes, write: Callable[[], Tag | None]) -> bool:
        """Write an object; return whether it has ``data`` then: the answer may have been lost."""
        try:
            return write() is not None or self._has(path, data)
        except Offline:
            with contextlib.suppress(Offline):
                if self._has(path, data):
                    return True
            raise

    def _has(self, path: str, data: bytes) -> bool:
        try:
            return bytes(self.get(path, len(data))) == data
        except (MapMissing, MapDataError):
            return False

    def write(
        self, path: str, data: bytes, only_if: Tag | None = None, *, create: bool = False
    ) -> Tag | None:
        """Write an object that changes and return its tag; None if a condition is not met."""
        mode: Any = "create" if create else None
        if only_if is not None:
            mode = dict(only_if)
            if self._scheme == "s3":
                mode["e_tag"] = mode["e_tag"].strip('"')  # Ceph's gateway needs it bare; Amazon takes both
        try:
            return _named(self._put(path, data, mode, _CHANGES))
        except (exceptions.AlreadyExistsError, exceptions.PreconditionError):
            return None

    def look(self, path: str) -> Seen:
        """Return what the store returns for an object; without its bytes if they are many."""
        try:
            body, tag = self._answer(path, _MAX_LOOK_BYTES)
            return Seen(bytes(body.whole()), tag)
        except MapDataError:
            return Seen(b"", {})

    def _put(self, path: str, data: bytes, mode: Any, attributes: dict[str, str]) -> Any:
        return self._ask(
            path,
            lambda: obstore.put(
                self._store(len(data), sends=True),
                path,
                data,
                mode=mode,
                attributes=attributes,
                use_multipart=False,
            ),
            more_s=2 * answer_limit_s(0.0, len(data)),  # it is sent twice if there is no answer
            conditional=mode is not None,
        )

    def delete(self, path: str) -> None:
        """Remove an object."""
        try:
            self._ask(path, lambda: obstore.delete(self._store(), path))
        except MapMissing:
            return

    # --- errors ---------------------------------------------------------------------------------

    def _name(self, path: str) -> str:
        return f"{self.url}/{path}"

    def _ask(
        self,
        path: str,
        ask: Callable[[], _Answer],
        *,
        more_s: float = 0.0,
        conditional: bool = False,
    ) -> _Answer:
        """Make a request and translate obstore's errors.

        Parameters
        ----------
        ask
            Makes the request, in another thread.
        more_s
            Seconds that the request may take beyond those of a small one.
        conditional
            Raise the error of a failed condition unchanged.
        """
        name, ended = self._name(path), UNREAD.ended
        try:
            return call_apart(ask, name, self._limit_s + more_s, UNREAD.look)
        except (exceptions.NotFoundError, FileNotFoundError) as error:
            refuse_unread(name, error, ended)
            raise missing(name, error) from None
        except (exceptions.AlreadyExistsError, exceptions.PreconditionError) as error:
            if conditional:
                raise
            status = 409 if isinstance(error, exceptions.AlreadyExistsError) else 412
            raise StoreRefused(f"{name}: refused (status {status})", hint=status_hint(status, "")) from None
        except exceptions.NotModifiedError:
            if conditional:
                raise
            raise unasked_304(name) from None
        except BaseException as error:
            if not (is_panic(error) or isinstance(error, exceptions.BaseError | OSError)):
                raise
            refuse_unread(name, error, ended)
            self._refuse_bad_credentials(name)
            raise failure(name, error) from None

    def _refuse_bad_credentials(self, name: str) -> None:
        """Raise why credentials that are read again and again cannot be used any more, if so."""
        try:
            find_credentials(self._scheme, os.environ, instance=self._instance)
        except ConfigError as error:
            raise StoreRefused(f"{name}: {error.message}", hint=error.hint, of_credentials=True) from None


def _fill(name: str, body: Body, result: obstore.GetResult, limit_s: float) -> None:
    """Read the body of an answer; all bytes of objects in buckets come through here."""
    end_s = time.monotonic() + limit_s
    try:
        for piece in result.stream(min_chunk_size=1):
            body.add(memoryview(piece))
            UNREAD.take(len(piece))
            if time.monotonic() > end_s and body.lacks:
                raise too_slow(name, limit_s)
    except (exceptions.BaseError, OSError):
        raise body.cut() from None


class SolePublisherStore(BucketStore):
    """A bucket that is written without conditions: what they would compare is read first.

    If another publisher comes between reading and writing, its version is lost.
    """

    def require_conditions(self, tag: Tag | None = None) -> None:
        """Write the small object, and compare what the store returns for it."""
        del tag
        with self._asking:
            if not self._is_asked:
                data = asked_content()
                self.write(ASKED, data)
                if refuse_foreign(self).data != data:
                    raise StoreRefused(
                        f"{self._name(ASKED)}: the store has accepted it, and returns another one",
                        hint="does another program publish there at the same time?",
                    )
                self._is_asked = True

    def get_tagged(self, path: str, max_bytes: int) -> tuple[memoryview, Tag]:
        """Return a whole object, and its hash: the store may give no usable ETag."""
        data, _ = super().get_tagged(path, max_bytes)
        return data, {"sha256": sha256(data).digest(), "size": len(data)}

    def put_new(self, path: str, data: bytes) -> bool:
        """Write an object if there is none."""
        try:
            return bytes(self.get(path, len(data))) == data
        except MapDataError:
            return False
        except MapMissing:
            self.write(path, data)
        return True

    def put_if(self, path: str, data: bytes, tag: Tag) -> bool:
        """Replace an object if it still has the hash of ``tag``."""
        try:
            _, now = self.get_tagged(path, tag["size"])
        except (MapMissing, MapDataError):
            return False
        if now != tag:
            return False
        self.write(path, data)
        return True


def _named(result: Any) -> Tag:
    """Return the tag from obstore's description of an object, or from its reply to a write."""
    return {key: result[key] for key in ("e_tag", "version") if result.get(key) is not None}


def server_url(where: StoreUrl) -> str:
    """Return the URL of a store's server, for requests without credentials; empty if unknown."""
    if where.scheme in WEB_SCHEMES:
        return where.text
    if endpoint := _endpoint(where.scheme):
        return endpoint
    region = os.environ.get("AWS_REGION") or os.environ.get("AWS_DEFAULT_REGION") or "us-east-1"
    account = os.environ.get("AZURE_STORAGE_ACCOUNT_NAME", "")
    usual = {
        "s3": f"https://s3.{region}.amazonaws.com",
        "gs": "https://storage.googleapis.com",
        "az": f"https://{account}.blob.core.windows.net" if account.isalnum() else "",
    }
    return usual.get(where.scheme, "")


def _opener(
    where: StoreUrl, timeouts: Timeouts, *, insecure: bool, instance: bool
) -> Callable[[float, float], Any]:
    """Return a function that opens the store.

    Its arguments: the time limit of each request, and how long sending may take; seconds.
    """
    endpoint = _endpoint(where.scheme)
    refuse_plain_http(where, endpoint, insecure_http=insecure)
    client: dict[str, Any] = {
        "connect_timeout": timedelta(seconds=timeouts.connect_s),
        "allow_http": endpoint.lower().startswith("http://"),
        "user_agent": "shmmap",
        **_no_redirects(where),
    }
    retry: dict[str, Any] = {
        "max_retries": timeouts.retries,
        "backoff": {
            "init_backoff": timedelta(milliseconds=50),
            "max_backoff": timedelta(seconds=5),
            "base": 2,
        },
    }
    given: dict[str, Any] = {}
    try:
        os.environ.update(clean_variables(os.environ))  # obstore reads them by itself
        found = find_credentials(where.scheme, os.environ, instance=instance)
        if found.provider is not None:
            given["credential_provider"] = found.provider
    except OSError:
        raise _cannot_be_opened(where) from None
    kind: Any = {"s3": S3Store, "gs": GCSStore, "az": AzureStore}[where.scheme]

    def opened(limit_s: float, sending_s: float) -> Any:
        client["timeout"] = timedelta(seconds=limit_s)
        client["read_timeout"] = timedelta(seconds=timeouts.read_s + sending_s)
        retry["retry_timeout"] = timedelta(seconds=timeouts.retry_s + sending_s)
        try:
            return kind.from_url(
                where.text, config=found.settings, client_options=client, retry_config=retry, **given
            )
        except (exceptions.BaseError, ValueError, TypeError, OSError):
            raise _cannot_be_opened(where) from None

    return opened


def _cannot_be_opened(where: StoreUrl) -> ConfigError:
    return ConfigError(
        f"{where.text} cannot be opened with the settings and credentials given",
        hint="look at the variables AWS_*, GOOGLE_*, AZURE_*, and at the files they name",
    )


def _endpoint(scheme: str) -> str:
    """Return the address of the store's server that the environment names; empty if it names none."""
    names = {"s3": ("AWS_ENDPOINT_URL_S3", "AWS_ENDPOINT_URL", "AWS_ENDPOINT"), "az": ("AZURE_ENDPOINT",)}
    name = next((name for name in names.get(scheme, ()) if os.environ.get(name)), "")
    endpoint = os.environ.get(name, "").strip()
    if name and not (endpoint.lower().startswith(("http://", "https://")) and host_of(endpoint)):
        raise ConfigError(
            f"{name} is no URL of a server", key=name, origin="environment", hint="such as https://HOST:PORT"
        )
    return endpoint


def _no_redirects(where: StoreUrl) -> dict[str, Any]:
    """Return settings that end redirects to other hosts; none where requests go through the user's proxy."""
    store = server_url(where)
    if any(name.lower().endswith("_proxy") and value for name, value in os.environ.items()):
        from urllib.request import getproxies, proxy_bypass

        proxies = getproxies()
        named = proxies.get(store.partition(":")[0] or "https") or proxies.get("all")
        if named and not proxy_bypass(host_of(store)):
            return {}
    urls = [store, *(os.environ.get(name, "") for name in _ASKED_FOR_CREDENTIALS)]
    hosts = [host for url in urls if (host := host_of(url))]
    return {"proxy_url": f"http://{NOWHERE}", "proxy_excludes": ",".join([*hosts, _HOSTS[where.scheme]])}
