# SPDX-License-Identifier: Apache-2.0
"""A published map in a bucket (S3, Google, Azure), accessed with obstore.

The text of an obstore error may contain a signed URL.  So our messages repeat only the kind of the error and
the HTTP status.
"""

from __future__ import annotations

import os
import re
from collections.abc import Awaitable, Callable, Iterator, Sequence
from datetime import timedelta
from typing import Any, Final, TypeVar

from shmmap.errors import ConfigError, MapDataError, MapMissing, Offline
from shmmap.lazy_imports import FOR_REMOTE, needed_packages
from shmmap.origin.remote.credentials import clean_variables, find_credentials
from shmmap.origin.remote.event_loop import run_coroutine, within
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
    host_of,
    is_panic,
    refuse_page,
    refuse_plain_http,
    unasked_304,
)

with needed_packages("a map in a bucket", together=FOR_REMOTE):
    import obstore
    from obstore import exceptions
    from obstore.store import AzureStore, GCSStore, S3Store

__all__ = ["BucketStore", "server_url"]

_Answer = TypeVar("_Answer")

_IMMUTABLE: Final = {
    "Cache-Control": "public, max-age=31536000, immutable",
    "Content-Type": "application/zstd",
}
_CHANGES: Final = {"Cache-Control": "no-cache", "Content-Type": "application/json"}
_STATUS: Final = re.compile(r"\b([45]\d\d)\b (?:[A-Z][A-Za-z ]+)|status(?: code)?:? ([45]\d\d)")
_MOVED: Final = re.compile(r"status code: 30[12378]\b")
_UNASKED: Final = re.compile(r"status code: 304\b")
_AGAIN: Final = "try again later"
_SILENT: Final = "is the network up, and the address right? (s3:// has it of AWS_ENDPOINT_URL and AWS_REGION)"
_REGION: Final = "is AWS_REGION that of the bucket?"
_CERTIFICATE: Final = "SSL_CERT_FILE names further authorities; is the clock right?"
_CLOCK: Final = "are the credentials valid, and is the clock right?"
_PANIC: Final = "this is a defect: please report it, with what the log says before"
_TRUE_NAMES: Final = (
    (
        "Content-Length Header missing",
        "its answer has no length",
        f"is it sent in chunks? {BETWEEN}",
    ),
    (
        "ETag Header missing",
        "its answer has no ETag",
        BETWEEN,
    ),
    (
        "invalid list response",
        "its answer is no listing of objects",
        "is it a page, or compressed?",
    ),
    ("list response body", "its listing ended early", BETWEEN),
    ("Parse(", "the answer is no HTTP", "is the address right, and its port?"),
)
"""What is in the text of an obstore error, what it means, and a hint."""
_NOWHERE: Final = "255.255.255.255:1"
"""Where redirects to other hosts are sent: as obstore follows them all, credentials included, its proxy for
all hosts but the store's is an address at which the kernel refuses every connection."""
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
_CODE: Final = re.compile(r"<Code>(\w+)</Code>")
_REASONS: Final = {
    "ExpiredToken": "the credentials have expired",
    "TokenRefreshRequired": "the credentials have expired",
    "InvalidAccessKeyId": "the store knows no such access key",
    "InvalidToken": "the session token is not valid",
    "SignatureDoesNotMatch": "the secret does not belong to the access key",
    "RequestTimeTooSkewed": "this machine's clock differs from the store's",
    "AccessDenied": "no permission",
}
"""Meanings of Amazon's error codes, which other stores use, too."""
_OBJECTS_PER_PAGE: Final = 1000


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
        self._store = _opened(where, timeouts, insecure=insecure_http, instance=instance_credentials)

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
        name = self._name(path)

        async def read() -> tuple[memoryview, Tag]:
            asked = obstore.get_async(
                self._store, path, options={"if_none_match": unless} if unless else None
            )
            result = await within(name, self._limit_s, asked)
            meta, headers = result.meta, result.attributes
            body = Body(
                name,
                meta["size"],
                max_bytes,
                exact=exact,
                media_type=str(headers.get("Content-Type", "")),
                encoding=str(headers.get("Content-Encoding", "")),
            )
            await within(name, answer_limit_s(self._timeouts.read_s, meta["size"]), _fill(body, result))
            named = {key: meta[key] for key in ("e_tag", "version") if meta[key] is not None}
            return body.whole(), named

        more_s = answer_limit_s(self._timeouts.read_s, max_bytes)
        return self._ask(path, read, more_s=more_s, conditional=unless is not None)

    def head(self, path: str) -> Listed | None:
        """Return an object's size and time of writing; None if it does not exist."""

        async def head() -> Listed:
            result = await obstore.get_async(self._store, path, options={"head": True})
            refuse_page(self._name(path), str(result.attributes.get("Content-Type", "")))
            return Listed(path, result.meta["size"], result.meta["last_modified"].timestamp())

        try:
            return self._ask(path, head)
        except MapMissing:
            return None

    def list(self, prefix: str) -> Iterator[Listed]:
        """Yield all objects below a prefix."""
        chunks = obstore.list(self._store, prefix.rstrip("/"), chunk_size=_OBJECTS_PER_PAGE)

        async def next_page() -> Sequence[Any]:
            try:
                return await chunks.__anext__()
            except StopAsyncIteration:
                return ()

        is_empty = True
        while page := self._ask(prefix, next_page, more_s=_BYTES_PER_PAGE / BYTES_PER_S):
            is_empty = False
            for meta in page:
                yield Listed(meta["path"], meta["size"], meta["last_modified"].timestamp())
        if is_empty:  # obstore takes a page for an empty listing
            self.head(f"{prefix}none")

    # --- writing --------------------------------------------------------------------------------

    def put(self, path: str, data: bytes) -> None:
        """Write an object that never changes."""
        self._put(path, data, None, _IMMUTABLE)

    def put_new(self, path: str, data: bytes) -> bool:
        """Write an object if none exists at this path."""
        try:
            self._put(path, data, "create", _CHANGES)
        except (exceptions.AlreadyExistsError, exceptions.PreconditionError):
            return self._has(path, data)
        return True

    def put_if(self, path: str, data: bytes, tag: Tag) -> bool:
        """Replace an object if it is still in the state that ``tag`` names."""
        wanted = dict(tag)
        if self._scheme == "s3":
            wanted["e_tag"] = wanted["e_tag"].strip('"')  # Ceph's gateway needs it bare; Amazon takes both
        try:
            self._put(path, data, wanted, _CHANGES)
        except (exceptions.AlreadyExistsError, exceptions.PreconditionError, MapMissing):
            return self._has(path, data)
        return True

    def _has(self, path: str, data: bytes) -> bool:
        """Whether an object already has ``data``: the reply to an earlier attempt may have been lost."""
        try:
            return bytes(self.get(path, len(data))) == data
        except (MapMissing, MapDataError):
            return False

    def _put(self, path: str, data: bytes, mode: Any, attributes: dict[str, str]) -> None:
        self._ask(
            path,
            lambda: obstore.put_async(
                self._store, path, data, mode=mode, attributes=attributes, use_multipart=False
            ),
            more_s=len(data) / BYTES_PER_S,
            conditional=mode is not None,
        )

    def delete(self, path: str) -> None:
        """Remove an object."""
        try:
            self._ask(path, lambda: obstore.delete_async(self._store, path))
        except MapMissing:
            return

    # --- errors ---------------------------------------------------------------------------------

    def _name(self, path: str) -> str:
        return f"{self.url}/{path}"

    def _ask(
        self,
        path: str,
        ask: Callable[[], Awaitable[_Answer]],
        *,
        more_s: float = 0.0,
        conditional: bool = False,
    ) -> _Answer:
        """Make a request and translate obstore's errors.

        Parameters
        ----------
        ask
            Begins the request; called in the event loop.
        more_s
            Seconds that the request may take beyond those of a small one.
        conditional
            Raise the error of a failed condition unchanged.
        """
        name = self._name(path)

        async def limited() -> _Answer:
            return await within(name, self._limit_s + more_s, ask())

        try:
            return run_coroutine(limited())
        except (exceptions.NotFoundError, FileNotFoundError) as error:
            if "<Code>NoSuchBucket</Code>" in str(error):
                raise MapMissing(f"{self.url}: there is no such bucket") from None
            raise MapMissing(f"{name} is not there") from None
        except (exceptions.AlreadyExistsError, exceptions.PreconditionError):
            if conditional:
                raise
            raise StoreRefused(f"{name}: refused (status 412)", hint=BETWEEN) from None
        except exceptions.NotModifiedError:
            if conditional:
                raise
            raise unasked_304(name) from None
        except BaseException as error:
            if not (is_panic(error) or isinstance(error, exceptions.BaseError | OSError)):
                raise
            self._refuse_bad_credentials(name)
            raise _failure(name, error) from None

    def _refuse_bad_credentials(self, name: str) -> None:
        """Raise why credentials that are read again and again cannot be used any more, if so."""
        try:
            find_credentials(self._scheme, os.environ, instance=self._instance)
        except ConfigError as error:
            raise StoreRefused(f"{name}: {error.message}", hint=error.hint, of_credentials=True) from None


def _failure(name: str, error: BaseException) -> Offline:
    """Return our error for one of obstore; only parts of its text without secrets are repeated."""
    text = str(error)
    if is_panic(error):
        return Offline(f"{name}: the request has made the package obstore fail", hint=_PANIC)
    if isinstance(error, exceptions.PermissionDeniedError | exceptions.UnauthenticatedError):
        return StoreRefused(
            f"{name}: refused, {_reason(text) or 'no permission'}", hint=_CLOCK, of_credentials=True
        )
    return _out_of_reach(name, text)


async def _fill(body: Body, result: obstore.GetResult) -> None:
    """Read the body of an answer; all bytes of objects in buckets come through here."""
    try:
        async for piece in result.stream(min_chunk_size=1):
            body.add(memoryview(piece))
    except (exceptions.BaseError, OSError):
        raise body.cut() from None


def _out_of_reach(name: str, text: str) -> Offline:
    """Return our error for the text of an obstore error; only parts without secrets are repeated."""
    if _NOWHERE in text or _MOVED.search(text):
        return StoreRefused(f"{name}: refused, it is somewhere else", hint=_REGION)
    if _UNASKED.search(text):
        return unasked_304(name)
    for part, says, hint in _TRUE_NAMES:
        if part in text:
            return StoreRefused(f"{name}: {says}", hint=hint)
    found = _STATUS.search(text)
    if found is not None:
        status = found[1] or found[2]
        hint = _CLOCK if status.startswith("4") else _AGAIN
        if why := _reason(text):
            return StoreRefused(f"{name}: refused, {why}", hint=hint, of_credentials=True)
        return StoreRefused(f"{name}: refused (status {status})", hint=hint)
    if "redirect" in text.lower():
        return StoreRefused(f"{name}: refused, it is somewhere else", hint=_REGION)
    if "certificate" in text.lower():
        return StoreRefused(f"{name}: the server's certificate is not accepted", hint=_CERTIFICATE)
    in_time = " in time" if "kind: Timeout" in text else ""
    return Offline(f"{name}: no answer{in_time}", hint=_SILENT)


def _reason(text: str) -> str:
    """Return the reason of a store's refusal if the text has a known error code; else an empty string."""
    found = _CODE.search(text)
    return _REASONS.get(found[1], "") if found is not None else ""


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


def _opened(where: StoreUrl, timeouts: Timeouts, *, insecure: bool, instance: bool) -> Any:
    endpoint = _endpoint(where.scheme)
    refuse_plain_http(where, endpoint, insecure_http=insecure)
    client: dict[str, Any] = {
        "connect_timeout": timedelta(seconds=timeouts.connect_s),
        "read_timeout": timedelta(seconds=timeouts.read_s),
        "timeout": timedelta(days=1),  # each request has a limit of its own
        "allow_http": endpoint.lower().startswith("http://"),
        "user_agent": "shmmap",
        **_no_redirects(where),
    }
    retry: dict[str, Any] = {
        "max_retries": timeouts.retries,
        "retry_timeout": timedelta(seconds=timeouts.retry_s),
        "backoff": {
            "init_backoff": timedelta(milliseconds=50),
            "max_backoff": timedelta(seconds=5),
            "base": 2,
        },
    }
    given: dict[str, Any] = {"client_options": client, "retry_config": retry}
    try:
        os.environ.update(clean_variables(os.environ))  # obstore reads them by itself
        found = find_credentials(where.scheme, os.environ, instance=instance)
        if found.provider is not None:
            given["credential_provider"] = found.provider
        kind: Any = {"s3": S3Store, "gs": GCSStore, "az": AzureStore}[where.scheme]
        return kind.from_url(where.text, config=found.settings, **given)
    except ConfigError:
        raise
    except (exceptions.BaseError, ValueError, TypeError, OSError):
        raise ConfigError(
            f"{where.text} cannot be opened with the settings and credentials given",
            hint="look at the variables AWS_*, GOOGLE_*, AZURE_*, and at the files they name",
        ) from None


def _endpoint(scheme: str) -> str:
    names = {"s3": ("AWS_ENDPOINT_URL_S3", "AWS_ENDPOINT_URL", "AWS_ENDPOINT"), "az": ("AZURE_ENDPOINT",)}
    return next((os.environ[name] for name in names.get(scheme, ()) if os.environ.get(name)), "")


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
    return {"proxy_url": f"http://{_NOWHERE}", "proxy_excludes": ",".join([*hosts, _HOSTS[where.scheme]])}
