# SPDX-License-Identifier: Apache-2.0
"""Program that verifies which version of a signed map is current, with TUF's client.

``python -m shmmap.origin.remote.verify_version CHANNEL_FD PARENT_PID SETTINGS`` answers with one packet, see
`shmmap.origin.remote.verify_apart`.
"""

from __future__ import annotations

import os
import socket
import sys
import tempfile
from collections.abc import Iterator
from datetime import datetime, timezone
from hashlib import sha256
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec

from shmmap.errors import MapDataError, MapMissing, ShmmapError
from shmmap.formats.durable_file import locked_file, writing_errors
from shmmap.lazy_imports import TO_SIGN, needed_packages
from shmmap.origin.reading_apart import Outcome
from shmmap.origin.remote.map_versions import MAX_METADATA_BYTES, TIMESTAMP
from shmmap.origin.remote.opened_store import open_store
from shmmap.origin.remote.store import LONG_RUN, SERVING, StoreRefused
from shmmap.origin.remote.verify_apart import (
    Verified,
    VerifyReply,
    VerifySettings,
    memory_directory,
    no_root_of_trust,
    read_trusted_root,
)
from shmmap.private_directory import require_private
from shmmap.processes.end_with_parent import die_with
from shmmap.processes.request_threads import leave
from shmmap.quantities import format_utc

if TYPE_CHECKING:
    from tuf.ngclient import Updater

    from shmmap.origin.remote.store import Store

_URL = "map:///"  # the updater names objects by URL; the rest of the URL is a path at the store
_ROLES: Final = ("timestamp", "snapshot", "targets", "root")
_NICE: Final = 5


class _Asked(NamedTuple):
    """Record of a store's errors, and of the newest metadata that it returned, by role."""

    failed: list[ShmmapError]
    found: dict[str, bytes]


def verify_version(store: Store, trusted: bytes, state_dir: str, trust: str = "") -> Verified:
    """Return the signed version; errors are those of `shmmap.origin.remote.verify_apart`.

    Expiry is compared with this machine's clock or the signing time of the timestamp, whichever is later.
    """
    from tuf.api.exceptions import DownloadError, RepositoryError

    from shmmap.origin.remote.signed_metadata import ALTERED, TARGET, current_of, refused

    memory = memory_directory(state_dir, store.url, trusted)
    with writing_errors(memory):
        require_private(memory)
        with locked_file(os.path.join(memory, ".lock")):
            _remove_interim(memory)
            updater, asked = _updater(store, trusted, memory, trust)
            try:
                updater.refresh()
                target = updater.get_targetinfo(TARGET)
            except (RepositoryError, DownloadError) as error:
                raise _named(store, trusted, error, asked, memory) from None
            try:
                current = current_of(target)
            except ValueError as error:
                raise refused(store.url, ALTERED, f"targets: {error}") from None
            signed_s, expires = _times(memory)
    role = min(expires, key=lambda role: expires[role])
    if expires[role].timestamp() <= signed_s:  # still valid by this machine's clock, which is behind
        raise _expired(
            store, role, expires[role], f"the timestamp was signed on {format_utc(signed_s)}, and "
        )
    return Verified(current, sha256(trusted).hexdigest(), signed_s, expires[role].timestamp())


def _updater(store: Store, trusted: bytes, memory: str, trust: str) -> tuple[Updater, _Asked]:
    """Return TUF's client for a store, and a record of what the store returns to it."""
    from tuf.api.exceptions import DownloadHTTPError, RepositoryError
    from tuf.ngclient import FetcherInterface, Updater, UpdaterConfig

    asked = _Asked([], {})

    class Fetcher(FetcherInterface):
        def _fetch(self, url: str) -> Iterator[bytes]:
            path = url.removeprefix(_URL)
            try:
                data = bytes(store.get(path, MAX_METADATA_BYTES))
            except MapMissing as error:
                asked.failed.append(error)
                raise DownloadHTTPError(path, 404) from None
            except ShmmapError as error:
                is_refused = isinstance(error, StoreRefused) and error.of_credentials
                if is_refused and path.endswith(f".{_ROLES[-1]}.json"):
                    raise DownloadHTTPError(path, 403) from None  # some stores send it for a missing object
                asked.failed.append(error)
                raise
            asked.found[path.removesuffix(".json").rpartition(".")[2]] = data
            return iter([data])

    config = UpdaterConfig(
        root_max_length=MAX_METADATA_BYTES,
        timestamp_max_length=MAX_METADATA_BYTES,
        snapshot_max_length=MAX_METADATA_BYTES,
        targets_max_length=MAX_METADATA_BYTES,
    )
    try:
        return Updater(memory, _URL, fetcher=Fetcher(), config=config, bootstrap=trusted), asked
    except RepositoryError as error:
        raise no_root_of_trust(trust, str(error)) from None


def _named(store: Store, trusted: bytes, error: Exception, asked: _Asked, memory: str) -> ShmmapError:
    """Translate an error of TUF's client into the error that names the cause."""
    from tuf.api import exceptions

    from shmmap.origin.remote.signed_metadata import (
        ALTERED,
        FOREIGN_ROOT,
        OLDER,
        UNSIGNED,
        is_foreign,
        refused,
    )

    if isinstance(error, exceptions.DownloadHTTPError):
        if str(error) == TIMESTAMP:
            return refused(
                store.url,
                UNSIGNED,
                f"{TIMESTAMP} is not there",
                "shmmap publish MAP URL --sign KEYDIR signs it",
            )
        return refused(f"{store.url}/{error}", ALTERED, "it is not there")
    if isinstance(error, exceptions.DownloadError):
        failed = asked.failed
        if failed and not isinstance(failed[-1], MapMissing) and failed[-1].code != "bad_map_data":
            return failed[-1]
        return refused(store.url, ALTERED, failed[-1].message if failed else str(error))
    if is_foreign(store, trusted):
        return refused(
            store.url,
            FOREIGN_ROOT,
            "it is signed under another root than the one that is trusted",
            "is it the right URL, and the ROOT.json of the keys that sign it?",
        )
    if isinstance(error, exceptions.ExpiredMetadataError):
        role = next(role for role in _ROLES if role in str(error))
        if role == "root" or role not in asked.found:
            with open(os.path.join(memory, f"{role}.json"), "rb") as file:
                asked.found[role] = file.read()
        return _expired(store, role, _expires(asked.found[role]))
    if isinstance(error, exceptions.BadVersionNumberError):
        return refused(
            store.url, OLDER, f"{error}", "an older state is offered than one that was seen signed here"
        )
    return refused(store.url, ALTERED, f"{error}")


def _expired(store: Store, role: str, expires: datetime, after: str = "") -> MapDataError:
    from shmmap.origin.remote.signed_metadata import EXPIRED, refused

    now = datetime.now(timezone.utc)
    return refused(
        store.url,
        EXPIRED,
        f"{role}.json was valid until {expires:%Y-%m-%d %H:%M} UTC; {after}this machine's clock says"
        f" {now:%Y-%m-%d %H:%M} UTC",
        "is the clock right? `shmmap versions URL --refresh --sign KEYDIR` signs it again",
    )


def _expires(data: bytes) -> datetime:
    from tuf.api.metadata import Metadata

    found: Any = Metadata.from_bytes(data)
    expires: datetime = found.signed.expires
    return expires


def _times(memory: str) -> tuple[float, dict[str, datetime]]:
    """Return when the timestamp was signed, and when the metadata of each role expires."""
    from tuf.api.metadata import Metadata

    found: dict[str, Any] = {
        role: Metadata.from_file(os.path.join(memory, f"{role}.json")).signed for role in _ROLES
    }
    signed = found["timestamp"].unrecognized_fields.get("signed")
    try:
        signed_s = datetime.fromisoformat(signed.replace("Z", "+00:00")).timestamp()
    except (AttributeError, ValueError, OverflowError):
        signed_s = 0.0
    return signed_s, {role: one.expires for role, one in found.items()}


def _remove_interim(memory: str) -> None:
    """Remove half-written files of a killed TUF client."""
    for name in os.listdir(memory):
        if name.startswith(tempfile.gettempprefix()):
            os.unlink(os.path.join(memory, name))


def main() -> int:
    """Verify the current version and send the reply."""
    die_with(int(sys.argv[2]))
    settings = msgspec.json.decode(sys.argv[3], type=VerifySettings)
    if settings.is_serving:
        os.nice(_NICE)
    reply = VerifyReply()
    with socket.socket(fileno=int(sys.argv[1])) as channel:
        try:
            with needed_packages("--trust", together=TO_SIGN):
                import tuf.ngclient  # noqa: F401

                from shmmap.origin.remote import signed_metadata  # noqa: F401

                store = open_store(
                    settings.url,
                    timeouts=SERVING if settings.is_serving else LONG_RUN,
                    insecure_http=settings.insecure_http,
                    instance_credentials=settings.instance_credentials,
                )
            trusted = read_trusted_root(settings.trust)
            reply.verified = verify_version(store, trusted, settings.state_dir, settings.trust)
        except ShmmapError as error:
            reply.error = Outcome.of(error)
        channel.sendall(msgspec.json.encode(reply))
    return 0


if __name__ == "__main__":
    leave(main())
