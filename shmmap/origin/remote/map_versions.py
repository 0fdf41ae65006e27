# SPDX-License-Identifier: Apache-2.0
"""The versions of a published map: the root of each version, and the switch from one version to the next.

``CURRENT`` names the version that is served.  Each version has an entry, written before the version becomes
current, which names the version before it.  So earlier versions are found by following the entries back from
``CURRENT``.  An entry outside that chain was never served: its publisher was killed, or another publisher was
quicker.
"""

from __future__ import annotations

import datetime
import json
import re
from collections.abc import Iterator
from hashlib import sha256
from typing import Any, Final, NamedTuple, TypeVar

import msgspec

from shmmap.errors import BadRequest, InstanceBusy, MapDataError, MapMissing
from shmmap.failpoints import step
from shmmap.origin.remote.published_index import MAX_ROOT_BYTES, Root, Shard, unpack_root, unpack_shard
from shmmap.origin.remote.published_object import blob_path
from shmmap.origin.remote.store import ObjectReader, Store, StoreRefused, Tag, put_over
from shmmap.origin.remote.zstd_frame import DAMAGED
from shmmap.processes.request_threads import RequestThreads

CURRENT: Final = "CURRENT"
TIMESTAMP: Final = "timestamp.json"
"""File that names the current version of a signed map, see `shmmap.origin.remote.signed_metadata`."""
MAX_METADATA_BYTES: Final = 512_000
"""Size limit of each object of a signed map's metadata."""
ENTRIES: Final = "versions/"
_ENTRY: Final = re.compile(r"versions/([1-9]\d{0,18})\.json")
_MAX_JSON_BYTES: Final = 64 << 10
_CONCURRENT_READS: Final = 32
_MAX_VERSIONS: Final = 1_000_000
_Named = TypeVar("_Named", bound=msgspec.Struct)


class Current(msgspec.Struct, frozen=True):
    """Content of ``CURRENT``: a version's number, and the SHA-256 and the size of its root's object."""

    version: int
    root: str
    bytes: int


class Entry(msgspec.Struct, frozen=True):
    """Content of ``versions/<n>.json``.

    Attributes
    ----------
    version, root, bytes
        As in `Current`.
    created
        Time at which the entry was made, UTC, in the format of RFC 3339.
    before
        The version that was current at that time; 0: none.
    restored
        The earlier version whose content was restored; 0: the version has its own content.
    """

    version: int
    root: str
    bytes: int
    created: str
    before: int = 0
    restored: int = 0

    @property
    def current(self) -> Current:
        """Content of ``CURRENT`` while this version is served."""
        return Current(self.version, self.root, self.bytes)

    @property
    def created_s(self) -> float:
        """Time at which the entry was made, Unix time."""
        return datetime.datetime.fromisoformat(self.created.replace("Z", "+00:00")).timestamp()


class CurrentState(NamedTuple):
    """The current version, and the tag of ``CURRENT``; None, None if nothing is published yet."""

    current: Current | None
    tag: Tag | None


def entry_path(version: int) -> str:
    """Return the path of a version's entry in the store."""
    return f"{ENTRIES}{version}.json"


def read_current(store: Store) -> CurrentState:
    """Return the current version.

    Raises
    ------
    MapDataError
        ``CURRENT`` is damaged.
    Offline
        ``CURRENT`` cannot be read at present.
    """
    try:
        data, tag = store.get_tagged(CURRENT, _MAX_JSON_BYTES)
    except MapMissing:
        return CurrentState(None, None)
    return CurrentState(unpack_current(data, f"{store.url}/{CURRENT}"), tag)


def require_current(store: Store) -> Current:
    """Return the current version; raise `MapMissing` if nothing is published."""
    found = read_current(store).current
    if found is None:
        raise MapMissing(f"no map is published at {store.url}", hint="shmmap publish MAP URL publishes one")
    return found


def unpack_current(data: bytes | memoryview, name: str = CURRENT) -> Current:
    """Decode ``CURRENT``; raise `MapDataError` if it is damaged."""
    found = _decode(data, Current, name)
    _check(found.version, found.root, found.bytes, name)
    return found


def read_entry(store: Store, version: int) -> Entry:
    """Return the entry of a version.

    Raises
    ------
    MapMissing
        There is no such entry.
    MapDataError
        The entry is damaged.
    """
    path = entry_path(version)
    name = f"{store.url}/{path}"
    entry = _decode(store.get(path, _MAX_JSON_BYTES), Entry, name)
    _check(entry.version, entry.root, entry.bytes, name)
    try:
        entry.created_s  # noqa: B018  raises if it is not a time
        right = entry.version == version and 0 <= entry.before < version and entry.created.endswith("Z")
    except (ValueError, OverflowError):
        right = False
    if not right:
        raise MapDataError("it is no entry of this version", path=name, cause=DAMAGED)
    return entry


def list_entries(store: Store) -> list[int]:
    """Return the numbers of all entries, ascending; the store must support listing."""
    found = (_ENTRY.fullmatch(listed.path) for listed in store.list(ENTRIES))
    return sorted(int(match[1]) for match in found if match is not None)


def earlier_versions(store: Store, current: Current) -> Iterator[Entry]:
    """Yield the entries of the current and earlier versions, latest first, until one is missing."""
    version = current.version
    for _ in range(_MAX_VERSIONS):
        try:
            entry = read_entry(store, version)
        except MapMissing:
            return
        yield entry
        version = entry.before
        if not version:
            return


def read_root(store: ObjectReader, current: Current) -> Root:
    """Return the root of a version, verified.

    Raises
    ------
    MapMissing, MapDataError, Offline
        The root is missing, does not match its hash, or is out of reach.
    """
    return unpack_root(read_root_object(store, current), name=f"{store.url}/{root_path(current)}")


def root_path(current: Current) -> str:
    """Return the path of a version's root object in the store."""
    return blob_path(bytes.fromhex(current.root))


def read_root_object(store: ObjectReader, current: Current) -> bytes:
    """Return the object of a version's root, hash verified; errors are those of `read_root`."""
    path = root_path(current)
    data = bytes(store.get_exactly(path, current.bytes))
    if sha256(data).hexdigest() != current.root:
        raise MapDataError("its SHA-256 is not its name", path=f"{store.url}/{path}", cause=DAMAGED)
    return data


def read_shard_object(store: ObjectReader, root: Root, number: int) -> memoryview:
    """Return the object of a shard; `unpack_shard` verifies its hash."""
    return store.get_exactly(blob_path(root.shard_sha256(number)), int(root.sizes[number]))


def read_shards(store: ObjectReader, root: Root) -> Iterator[Shard]:
    """Yield all shards of a root in order, several read at a time; errors are those of `read_root`."""

    def read(number: int) -> Shard:
        return unpack_shard(read_shard_object(store, root, number), root, number)

    with RequestThreads(_CONCURRENT_READS, "shard") as pool:
        for begin in range(0, len(root.keys), _CONCURRENT_READS):  # few decoded shards in memory at a time
            yield from pool.map(read, range(begin, min(begin + _CONCURRENT_READS, len(root.keys))))


# --- a new version ------------------------------------------------------------------------------------


def new_entry(store: Store, root: str, nbytes: int, before: Current | None, *, restored: int = 0) -> Entry:
    """Write the entry of a new version, which is not served until `add_version` switches to it.

    Raises
    ------
    InstanceBusy
        Other publishers took every number that was tried.
    """
    for _ in range(100):
        highest = max([*list_entries(store), before.version if before is not None else 0], default=0)
        entry = Entry(
            highest + 1, root, nbytes, _now_text(), before.version if before is not None else 0, restored
        )
        if store.put_new(entry_path(entry.version), pack_json(entry)):
            return entry
    raise InstanceBusy(f"other publishers take every number at {store.url}", hint="try again later")


def refuse_if_signed(store: Store, what: str) -> None:
    """Refuse to change a signed map without signing: vehicles that verify would never accept the change.

    Raises
    ------
    BadRequest
        The map is signed.
    """
    try:
        store.get(TIMESTAMP, MAX_METADATA_BYTES)  # whole: a page that answers every request is no signature
    except MapMissing:
        return
    raise BadRequest(f"the map at {store.url} is signed", hint=what)


def new_entry_now(current: Current, before: int) -> Entry:
    """Return an entry of a version with the present time."""
    return Entry(current.version, current.root, current.bytes, _now_text(), before)


def add_version(store: Store, entry: Entry, seen: CurrentState) -> None:
    """Make a new version current, if the version in ``seen`` is still current.

    Raises
    ------
    InstanceBusy
        Another publisher has switched meanwhile; its version stays.
    """
    data = pack_json(entry.current)
    step("version.switch")
    if not put_over(store, CURRENT, data, seen.tag):
        raise changed_meanwhile(store)
    step("version.switched")


def require_served(store: Store, made: Current) -> None:
    """Raise an error if a version that was just made current is not among those that the store returns.

    Raises
    ------
    InstanceBusy
        Another publisher's version is in its place.
    StoreRefused
        The store says that it has written the version, and returns what it had before.
    """
    current = read_current(store).current
    if current is None or current.version < made.version:
        raise StoreRefused(
            f"{store.url}: the store has accepted version {made.version}, and does not return it",
            hint="run the same command again: what was sent is not sent again",
        )
    entries = (entry.current for entry in earlier_versions(store, current))
    found = next((named for named in entries if named.version <= made.version), None)
    if found != made or (current.version == made.version and current != made):
        raise changed_meanwhile(store)


def changed_meanwhile(store: Store) -> InstanceBusy:
    """Return the error for a publisher whose version is not served because another was quicker."""
    return InstanceBusy(
        f"another publisher has changed {store.url} meanwhile: its version stays, this one is not served",
        hint="run the same command again: what was sent is not sent again",
    )


def pack_json(value: Current | Entry) -> bytes:
    """Return the bytes of ``CURRENT`` or of an entry: one line of JSON, keys in the documented order."""
    return (json.dumps(msgspec.to_builtins(value)) + "\n").encode()


def _now_text() -> str:
    now = datetime.datetime.now(datetime.timezone.utc)
    return now.isoformat(timespec="microseconds").replace("+00:00", "Z")


# created at import: msgspec crashes the process if two threads decode a type for the first time at once
_DECODERS: Final[dict[Any, Any]] = {kind: msgspec.json.Decoder(kind) for kind in (Current, Entry)}


def _decode(data: bytes | memoryview, kind: type[_Named], name: str) -> _Named:
    try:
        found: _Named = _DECODERS[kind].decode(data)
        return found
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise MapDataError(f"it is not what it should be: {error}", path=name, cause=DAMAGED) from None


def _check(version: int, root: str, nbytes: int, name: str) -> None:
    if (
        not 1 <= version < 1 << 63
        or not re.fullmatch("[0-9a-f]{64}", root)
        or not 1 <= nbytes <= MAX_ROOT_BYTES
    ):
        raise MapDataError("it names no root", path=name, cause=DAMAGED)
