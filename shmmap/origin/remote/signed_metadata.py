# SPDX-License-Identifier: Apache-2.0
"""The signed metadata of a published map, which names the current version.

The metadata follows TUF (The Update Framework) and is read and written with python-tuf; ORIGIN.md has the
rules that TUF leaves open.  Importing this module takes a third of a second and 35 MB, so a daemon uses it
only in a separate process, `shmmap.origin.remote.verify_apart`.
"""

from __future__ import annotations

from typing import Final, NamedTuple, TypeVar

from tuf.api.exceptions import RepositoryError, UnsignedMetadataError
from tuf.api.metadata import Metadata, Root, Snapshot, TargetFile, Targets, Timestamp
from tuf.api.serialization import DeserializationError

from shmmap.errors import MapDataError, MapMissing
from shmmap.origin.remote.map_versions import MAX_METADATA_BYTES, TIMESTAMP, Current
from shmmap.origin.remote.published_index import MAX_ROOT_BYTES
from shmmap.origin.remote.store import Store, Tag

TARGET: Final = "root"
_MAX_ROTATIONS: Final = 256
_NUMBER: Final = "map_version"

UNSIGNED: Final = "unsigned"
OLDER: Final = "older"
EXPIRED: Final = "expired"
ALTERED: Final = "altered"
FOREIGN_ROOT: Final = "foreign_root"

_Role = TypeVar("_Role", Root, Timestamp, Snapshot, Targets)


class SignedState(NamedTuple):
    """Signed state of a store: each role's metadata, and the tag of the timestamp."""

    timestamp: Metadata[Timestamp]
    tag: Tag
    snapshot: Metadata[Snapshot]
    targets: Metadata[Targets]

    @property
    def current(self) -> Current:
        """The version that the signed metadata names."""
        return current_of(self.targets.signed.targets.get(TARGET))


def metadata_path(role: str, number: int) -> str:
    """Return the path of a role's metadata with this number."""
    return f"{number}.{role}.json"


def refused(url: str, cause: str, why: str, hint: str = "") -> MapDataError:
    """Return the error that refuses a store's signed metadata; ``cause`` is one of the names above."""
    named = cause.replace("_", " ")
    if not hint and cause == ALTERED:
        hint = "was it damaged, or changed on its way? `shmmap versions URL --trust ROOT.json` looks again"
    return MapDataError(f"what is offered is refused, {named}: {why}", path=url, cause=cause, hint=hint)


def target_of(current: Current) -> TargetFile:
    """Return TUF's only target: the root object of a version."""
    return TargetFile(current.bytes, {"sha256": current.root}, TARGET, {"custom": {_NUMBER: current.version}})


def current_of(target: TargetFile | None) -> Current:
    """Return the version that a target names.

    Raises
    ------
    ValueError
        The target names no version.
    """
    if target is None:
        raise ValueError(f"there is no target {TARGET!r}")
    number = target.custom.get(_NUMBER) if isinstance(target.custom, dict) else None
    digest = target.hashes.get("sha256")
    if (
        not isinstance(number, int)
        or isinstance(number, bool)
        or not 1 <= number < 1 << 63
        or not isinstance(digest, str)
        or len(digest) != 64
        or not set(digest) <= set("0123456789abcdef")
        or not 1 <= target.length <= MAX_ROOT_BYTES
    ):
        raise ValueError("it names no root of a map")
    return Current(number, digest, target.length)


def newest_root(store: Store, trusted: bytes) -> Metadata[Root]:
    """Return the newest root of trust; each root is signed by the keys of the previous one.

    Expiry is not checked.

    Raises
    ------
    MapDataError
        A root is damaged, or lacks a required signature.
    """
    root = _parse(Root, trusted, "the trusted root", None)
    for _ in range(_MAX_ROTATIONS):
        path = metadata_path(Root.type, root.signed.version + 1)
        try:
            data = bytes(store.get(path, MAX_METADATA_BYTES))
        except MapMissing:
            break
        name = f"{store.url}/{path}"
        following = _parse(Root, data, name, root)
        if following.signed.version != root.signed.version + 1:
            raise refused(name, ALTERED, f"its number is {following.signed.version}")
        _check_signed(following, following, name)
        root = following
    return root


def read_signed_state(store: Store, root: Metadata[Root]) -> SignedState | None:
    """Return a store's signed state, which the next signature replaces; None if nothing is signed yet.

    Signatures are verified; expiry is not checked.

    Raises
    ------
    MapDataError
        Some metadata is missing, damaged, or signed by other keys.
    """
    try:
        data, tag = store.get_tagged(TIMESTAMP, MAX_METADATA_BYTES)
    except MapMissing:
        return None
    timestamp = _parse(Timestamp, bytes(data), f"{store.url}/{TIMESTAMP}", root)
    snapshot = _read_numbered(store, Snapshot, timestamp.signed.snapshot_meta.version, root)
    named = snapshot.signed.meta.get(f"{Targets.type}.json")
    if named is None:
        raise refused(store.url, ALTERED, "its snapshot names no targets")
    targets = _read_numbered(store, Targets, named.version, root)
    try:
        current_of(targets.signed.targets.get(TARGET))
    except ValueError as error:
        raise refused(store.url, ALTERED, f"targets: {error}") from None
    return SignedState(timestamp, tag, snapshot, targets)


def is_foreign(store: Store, trusted: bytes) -> bool:
    """Whether a store's root with the trusted root's number differs from the trusted root."""
    root: Metadata[Root] = Metadata.from_bytes(trusted)
    try:
        found = store.get(metadata_path(Root.type, root.signed.version), MAX_METADATA_BYTES)
    except (MapMissing, MapDataError):
        return False
    return bytes(found) != trusted


def _read_numbered(store: Store, kind: type[_Role], number: int, root: Metadata[Root]) -> Metadata[_Role]:
    path = metadata_path(kind.type, number)
    name = f"{store.url}/{path}"
    try:
        data = bytes(store.get(path, MAX_METADATA_BYTES))
    except MapMissing:
        raise refused(name, ALTERED, "it is not there") from None
    found = _parse(kind, data, name, root)
    if found.signed.version != number:
        raise refused(name, ALTERED, f"its number is {found.signed.version}")
    return found


def _parse(kind: type[_Role], data: bytes, name: str, root: Metadata[Root] | None) -> Metadata[_Role]:
    try:
        found: Metadata[_Role] = Metadata.from_bytes(data)
    except DeserializationError:
        raise refused(name, ALTERED, "it is no TUF metadata") from None
    if not isinstance(found.signed, kind):
        raise refused(name, ALTERED, f"it is of {found.signed.type}, not of {kind.type}")
    if root is not None:
        _check_signed(found, root, name)
    return found


def _check_signed(found: Metadata[_Role], root: Metadata[Root], name: str) -> None:
    try:
        root.signed.verify_delegate(found.signed.type, found.signed_bytes, found.signatures)
    except (UnsignedMetadataError, RepositoryError, ValueError):
        raise refused(
            name,
            FOREIGN_ROOT,
            "it is not signed by the keys that the trusted root names",
        ) from None
