# SPDX-License-Identifier: Apache-2.0
"""Makes an earlier version's content current again, under a new number."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Final, NamedTuple

from shmmap.errors import BadRequest, MapDataError, MapMissing
from shmmap.failpoints import step
from shmmap.origin.remote.map_versions import (
    Current,
    Entry,
    earlier_versions,
    new_entry,
    read_entry,
    read_root,
    read_shards,
)
from shmmap.origin.remote.published_index import Root
from shmmap.origin.remote.published_object import blob_path
from shmmap.origin.remote.store import Store
from shmmap.processes.request_threads import RequestThreads
from shmmap.progress import Progress
from shmmap.publishing.new_version import CONCURRENT_REQUESTS, absent_objects, begin_version, switch_version

if TYPE_CHECKING:
    from shmmap.publishing.signing import MapSigner

_NAMED: Final = 3


class Restored(NamedTuple):
    """Result: number of the new version (None: that content is already current), and of checked objects."""

    version: int | None
    restored: int
    current: int
    objects: int


def restore_version(
    store: Store, version: int, progress: Progress, signer: MapSigner | None = None
) -> Restored:
    """Make the content of an earlier version current again; all its objects must still exist.

    Raises
    ------
    MapMissing
        Nothing is published, or the version does not exist (any more).
    BadRequest
        The version was never served.
    MapDataError
        Some objects of the version are missing.
    InstanceBusy
        Another publisher has switched meanwhile.
    """
    seen = begin_version(store, signer, "go back")
    if seen.current is None:
        raise MapMissing(f"no map is published at {store.url}")
    served = {entry.version: entry for entry in earlier_versions(store, seen.current)}
    old = served.get(version)
    if old is None:
        try:
            read_entry(store, version)
        except MapMissing:
            raise MapMissing(
                f"there is no version {version} at {store.url}", hint="`shmmap versions URL` lists them"
            ) from None
        raise BadRequest(
            f"version {version} was never served: its publisher did not finish",
            hint="`shmmap versions URL` says which were",
        )
    if old.root == seen.current.root:
        return Restored(None, version, seen.current.version, 0)
    step("restore.entry")
    # from here on pruning spares the objects; if it began earlier, the old entry is missing now
    entry = new_entry(store, old.root, old.bytes, seen.current, restored=version)
    _require_entry(store, old)
    objects = _look_for_objects(store, old.current, progress)
    step("restore.looked")
    switch_version(store, entry, seen, signer)
    return Restored(entry.version, version, entry.version, objects)


def _require_entry(store: Store, entry: Entry) -> None:
    try:
        read_entry(store, entry.version)
    except MapMissing:
        raise MapMissing(f"version {entry.version} at {store.url} has just been pruned") from None


def _look_for_objects(store: Store, current: Current, progress: Progress) -> int:
    root = read_root(store, current)
    progress.stage("look for objects", root.cells)
    missing: list[str] = []
    looked = 0

    with RequestThreads(CONCURRENT_REQUESTS, "head") as threads:
        for shard in read_shards(store, root):  # reading shows that the shards exist
            objects = {named for layer in shard.layers.values() for named in layer.objects()}
            missing += map(blob_path, absent_objects(store, sorted(objects), threads))
            looked += len(objects)
            progress.advance(len(shard))
    progress.done(root.cells)
    if missing:
        named = ", ".join(missing[:_NAMED])
        raise MapDataError(
            f"{len(missing):,} objects of version {current.version} are not there: {named}",
            path=store.url,
            hint="publish its map again",
        )
    return looked


def objects_of(store: Store, current: Current) -> Iterator[bytes]:
    """Yield the hashes of all objects of a version: its root, shards, and layers.

    Raises
    ------
    MapMissing, MapDataError, Offline
        The root or a shard cannot be read.
    """
    root: Root = read_root(store, current)
    yield bytes.fromhex(current.root)
    for number in range(len(root.keys)):
        yield root.shard_sha256(number)
    for shard in read_shards(store, root):
        for layer in shard.layers.values():
            yield from (digest for digest, _ in layer.objects())
