# SPDX-License-Identifier: Apache-2.0
"""A published map in a bucket (S3, Google, Azure) or behind a web server, accessed with obstore.

The text of an obstore error may contain a signed URL.  So our messages repeat only the kind of the error and
the HTTP status.
"""

from __future__ import annotations

import os
import re
import threading
from collections.abc import Callable, Iterator
from datetime import timedelta
from hashlib import sha256
from typing import Any, Final, TypeVar
from urllib.parse import urlsplit

from shmmap.errors import BadRequest, ConfigError, MapDataError, MapMissing, Offline
from shmmap.lazy_imports import FOR_REMOTE, needed_packages
from shmmap.origin.remote.conditions import (
    ASKED,
    Seen,
    ask_conditions,
    asked_content,
    refuse_foreign,
    refuse_unsafe_tag,
)
from shmmap.origin.remote.credentials import find_credentials
from shmmap.origin.remote.store import (
    WEB_SCHEMES,
    Listed,
    NoBucket,
    NoTag,
    StoreRefused,
    StoreUrl,
    Tag,
    Timeouts,
    is_loopback,
    refuse_read_only,
)
from shmmap.origin.remote.zstd_frame import DAMAGED

with needed_packages("a map in a bucket or at a web server", together=FOR_REMOTE):
    import obstore
    from obstore import exceptions
    from obstore.store import AzureStore, GCSStore, HTTPStore, S3Store

__all__ = ["BucketStore", "SolePublisherStore", "server_url"]

_Answer = TypeVar("_Answer")

_IMMUTABLE: Final = {
    "Cache-Control": "public, max-age=31536000, immutable",
    "Content-Type": "application/zstd",
}
_CHANGES: Final = {"Cache-Control": "no-cache", "Content-Type": "application/json"}
_STATUS: Final = re.compile(r"\b([45]\d\d)\b (?:[A-Z][A-Za-z ]+)|status(?: code)?:? ([45]\d\d)")
_AGAIN: Final = "try again later"
_SILENT: Final = "is the network up, and the address right? (s3:// has it of AWS_ENDPOINT_URL and AWS_REGION)"
_REGION: Final = "is AWS_REGION that of the bucket?"
_CERTIFICATE: Final = "SSL_CERT_FILE names further authorities; is the clock right?"
_CLOCK: Final = "are the credentials valid, and is the clock right?"
_ELSEWHERE: Final = "the bucket is in another region"
_CODE: Final = re.compile(r"<Code>(\w+)</Code>")
_REASONS: Final = {
    "ExpiredToken": "the credentials have expired",
    "TokenRefreshRequired": "the credentials have expired",
    "InvalidAccessKeyId": "the store knows no such access key",
    "InvalidToken": "the session token is not valid",
    "SignatureDoesNotMatch": "the secret does not belong to the access key",
    "RequestTimeTooSkewed": "this machine's clock differs from the store's",
    "AccessDenied": "no permission",
    "AllAccessDisabled": "the bucket's owner has disabled it",
    "AccountProblem": "the account is closed or not paid for",
    "InvalidBucketName": "no bucket can have this name",
    "PermanentRedirect": _ELSEWHERE,
    "TemporaryRedirect": _ELSEWHERE,
    "AuthorizationHeaderMalformed": _ELSEWHERE,
    "IllegalLocationConstraintException": _ELSEWHERE,
    "AuthenticationFailed": "the account's key or token is not valid",
    "AuthorizationFailure": "no permission",
    "AuthorizationPermissionMismatch": "no permission",
    "InsufficientAccountPermissions": "no permission",
    "NoAuthenticationInformation": "it takes no requests without credentials",
    "PublicAccessNotPermitted": "it takes no requests without credentials",
    "ContainerBeingDeleted": "the container is being deleted",
    "AccountIsDisabled": "the account is closed or not paid for",
}
"""Meanings of Amazon's error codes, which Google and others use, too, and of Azure's."""
_HINTS: Final = {
    _ELSEWHERE: _REGION,
    "no permission": "may this account use this bucket? Its policy, or the account's roles, say so",
    "the container is being deleted": _AGAIN,
}
"""Hints for reasons that are none of the credentials."""
_NO_BUCKET: Final = re.compile(
    r"<Code>(NoSuchBucket|ContainerNotFound)</Code>|The specified (bucket|container) does not exist"
)
"""In the answers of Amazon and Google (XML and JSON), and of Azure."""
_NO_TAG: Final = "ETag Header missing"
_OBJECTS_PER_PAGE: Final = 1000
_MAX_LOOK_BYTES: Final = 1 << 16


class BucketStore:
    """A `shmmap.origin.remote.store.Store` below a URL; `opened_store.open_store` makes it.

    After the first request to any store, a forked process cannot make requests: obstore's threads are
    missing in it.
    """

    def __init__(
        self, where: StoreUrl, *, timeouts: Timeouts, insecure_http: bool, instance_credentials: bool
    ) -> None:
        self.url = where.text
        self._scheme = where.scheme
        self.read_only = (
            "a web server cannot be written to: publish to its directory, or to the bucket behind it"
            if where.scheme in WEB_SCHEMES
            else ""
        )
        self._store = _opened(where, timeouts, insecure=insecure_http, instance=instance_credentials)
        self._asking = threading.Lock()
        self._is_asked = False

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
        def read() -> tuple[Any, Tag]:
            result = obstore.get(self._store, path, options={"if_none_match": unless} if unless else None)
            meta = result.meta
            size = meta["size"]
            if size > max_bytes or (exact and size != max_bytes):
                limit = f"not {max_bytes:,}" if exact else f"at most {max_bytes:,} are read"
                raise MapDataError(f"it has {size:,} bytes, {limit}", path=self._name(path), cause=DAMAGED)
            return result.bytes(), _named(meta)

        data, tag = self._ask(path, read)
        return memoryview(data), tag

    def head(self, path: str) -> Listed | None:
        """Return an object's size and time of writing; None if it does not exist."""
        try:
            meta = self._ask(path, lambda: obstore.head(self._store, path))
        except MapMissing:
            return None
        return Listed(path, meta["size"], meta["last_modified"].timestamp())

    def list(self, prefix: str) -> Iterator[Listed]:
        """Yield all objects below a prefix."""
        refuse_read_only(self)
        stream = self._ask(
            prefix, lambda: obstore.list(self._store, prefix.rstrip("/"), chunk_size=_OBJECTS_PER_PAGE)
        )
        chunks = iter(stream)
        while (chunk := self._ask(prefix, lambda: next(chunks, None))) is not None:
            for meta in chunk:
                yield Listed(meta["path"], meta["size"], meta["last_modified"].timestamp())

    # --- writing --------------------------------------------------------------------------------

    def put(self, path: str, data: bytes) -> None:
        """Write an object that never changes."""
        self._put(path, data, None, _IMMUTABLE)

    def require_conditions(self, tag: Tag | None = None) -> None:
        """Ask the store once whether it writes on conditions; see `conditions.ask_conditions`."""
        refuse_read_only(self)
        with self._asking:
            if not self._is_asked:
                ask_conditions(self)
                self._is_asked = True
        if tag is not None:
            refuse_unsafe_tag(self.url, tag)

    def put_new(self, path: str, data: bytes) -> bool:
        """Write an object if none exists at this path."""
        return self.write(path, data, create=True) is not None or self._has(path, data)

    def put_if(self, path: str, data: bytes, tag: Tag) -> bool:
        """Replace an object if it is still in the state that ``tag`` names."""
        refuse_unsafe_tag(self.url, tag)
        try:
            return self.write(path, data, tag) is not None or self._has(path, data)
        except MapMissing:
            return False

    def _has(self, path: str, data: bytes) -> bool:
        """Whether an object already has ``data``: the reply to an earlier attempt may have been lost."""
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
        """Return what the store returns for an object, however large it says that this is."""

        def read() -> Seen:
            result = obstore.get(self._store, path)
            data = result.bytes() if result.meta["size"] <= _MAX_LOOK_BYTES else b""
            return Seen(bytes(data), _named(result.meta), result.attributes.get("Content-Type", ""))

        return self._ask(path, read)

    def _put(self, path: str, data: bytes, mode: Any, attributes: dict[str, str]) -> Any:
        refuse_read_only(self)
        return self._ask(
            path,
            lambda: obstore.put(
                self._store, path, data, mode=mode, attributes=attributes, use_multipart=False
            ),
            conditional=mode is not None,
        )

    def delete(self, path: str) -> None:
        """Remove an object."""
        refuse_read_only(self)
        try:
            self._ask(path, lambda: obstore.delete(self._store, path))
        except MapMissing:
            return

    # --- errors ---------------------------------------------------------------------------------

    def _name(self, path: str) -> str:
        return f"{self.url}/{path}"

    def _ask(self, path: str, ask: Callable[[], _Answer], *, conditional: bool = False) -> _Answer:
        """Make a request and translate obstore's errors.

        With ``conditional``, the error of a failed condition is raised unchanged.
        """
        try:
            return ask()
        except (exceptions.NotFoundError, FileNotFoundError) as error:
            if _NO_BUCKET.search(str(error)):
                raise NoBucket(f"{self._name(path)}: there is no such bucket", status=404) from None
            raise MapMissing(f"{self._name(path)} is not there") from None
        except (exceptions.AlreadyExistsError, exceptions.PreconditionError):
            if conditional:
                raise
            raise StoreRefused(f"{self._name(path)}: refused (status 412)") from None
        except exceptions.NotModifiedError:  # only `get_if_changed` sets this condition
            raise
        except (exceptions.PermissionDeniedError, exceptions.UnauthenticatedError) as error:
            why = _reason(str(error))
            hint = _HINTS.get(why, _CLOCK)
            raise StoreRefused(
                f"{self._name(path)}: refused, {why or 'no permission'}",
                hint=hint,
                of_credentials=True,
                status=403,
            ) from None
        except (exceptions.BaseError, OSError) as error:
            raise _out_of_reach(self._name(path), str(error)) from None


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


def _out_of_reach(name: str, text: str) -> Offline:
    """Return our error for the text of an obstore error; only parts without secrets are repeated."""
    if _NO_BUCKET.search(text):
        return NoBucket(f"{name}: there is no such bucket", status=404)
    if _NO_TAG in text:
        return NoTag(f"{name}: the answer has no ETag, is that a store?")
    found = _STATUS.search(text)
    if found is not None:
        status = int(found[1] or found[2])
        hint = _CLOCK if 400 <= status < 500 else _AGAIN
        if why := _reason(text):
            hint = _HINTS.get(why, hint)
            return StoreRefused(f"{name}: refused, {why}", hint=hint, of_credentials=True, status=status)
        return StoreRefused(f"{name}: refused (status {status})", hint=hint, status=status)
    if "redirect" in text.lower():
        return StoreRefused(f"{name}: refused, it is somewhere else", hint=_REGION)
    if "certificate" in text.lower():
        return StoreRefused(f"{name}: the server's certificate is not accepted", hint=_CERTIFICATE)
    return Offline(f"{name}: no answer", hint=_SILENT)


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
    endpoint = where.text if where.scheme in WEB_SCHEMES else _endpoint(where.scheme)
    plain = endpoint.lower().startswith("http://")
    if plain and not insecure and not is_loopback(_host(endpoint)):
        raise BadRequest(
            f"{where.text}: plain http:// can be read and changed in transit",
            hint="use https://, or --insecure-http"
            + (", or --trust ROOT.json where the map is signed" if where.scheme in WEB_SCHEMES else ""),
        )
    client: dict[str, Any] = {
        "connect_timeout": timedelta(seconds=timeouts.connect_s),
        "read_timeout": timedelta(seconds=timeouts.read_s),
        "timeout": timedelta(days=1),  # for a whole body, whose length is not known beforehand
        "allow_http": plain,
        "user_agent": "shmmap",
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
        if where.scheme in WEB_SCHEMES:
            return HTTPStore.from_url(where.text, **given)
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


def _host(url: str) -> str:
    try:
        return urlsplit(url).hostname or ""
    except ValueError:
        return ""
