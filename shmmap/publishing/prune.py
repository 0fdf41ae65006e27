# SPDX-License-Identifier: Apache-2.0
"""Removes versions that have not been current for a long time, and objects that no version has.

Entries of old versions are removed first, and metadata that signed them.  Then the entries are listed again,
and only old objects that none of the remaining versions has are removed.  So versions that are published,
restored or read meanwhile keep their objects.  Equally old parts of slices were never joined, and are removed
as well.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

from shmmap.errors import BadRequest, MapDataError, MapMissing
from shmmap.failpoints import step
from shmmap.origin.remote.map_versions import (
    MAX_METADATA_BYTES,
    TIMESTAMP,
    Current,
    Entry,
    earlier_versions,
    entry_path,
    list_entries,
    read_entry,
    require_current,
)
from shmmap.origin.remote.slice_part import PARTS
from shmmap.origin.remote.store import Store, refuse_read_only
from shmmap.progress import Progress
from shmmap.publishing.restore import objects_of

KEEP_DAYS: Final = 30.0
LEAST_KEEP_DAYS: Final = 7.0
_DAY_S: Final = 86_400.0
_BLOBS: Final = "blobs/"


@dataclass(slots=True)
class Pruned:
    """Result of pruning: removed versions, objects, bytes and parts of slices, and what was kept."""

    versions: list[int] = field(default_factory=list)
    objects: int = 0
    bytes: int = 0
    parts: int = 0
    kept_versions: list[int] = field(default_factory=list)
    kept_objects: int = 0
    kept_bytes: int = 0


def prune_versions(store: Store, *, keep_days: float = KEEP_DAYS, progress: Progress) -> Pruned:
    """Remove versions that have not been current for ``keep_days``, and objects that only they have.

    Parameters
    ----------
    keep_days
        Days, 7 or more.

    Raises
    ------
    BadRequest
        ``keep_days`` is too small, the store is read-only, or the signed version is not the current one.
    MapMissing, MapDataError, Offline
        Nothing is published there, or a version to keep cannot be read, so that its objects are unknown.
    """
    refuse_read_only(store)
    if not keep_days >= LEAST_KEEP_DAYS:
        raise BadRequest(f"versions are kept for {LEAST_KEEP_DAYS:g} days at least")
    old_s = time.time() - keep_days * _DAY_S
    current = require_current(store)
    _require_signed(store, current)
    result = Pruned()
    for version in _old_versions(store, current, old_s):
        step("prune.entry")
        store.delete(entry_path(version))
        result.versions.append(version)
    _remove_metadata(store, old_s)
    step("prune.listed")
    needed = _needed(store, progress, result)
    result.parts = _remove_parts(store, old_s)
    _remove_objects(store, needed, old_s, progress, result)
    return result


def _require_signed(store: Store, current: Current) -> None:
    """Refuse if a signed map's metadata, which is not verified here, names another version."""
    if (signed := _signed_now(store)) is None:
        return
    if signed.map_version != current.version:
        raise BadRequest(
            f"version {signed.map_version} of {store.url} is signed, and CURRENT says {current.version}",
            hint="correct that: shmmap versions URL --refresh --sign KEYDIR",
        )


class _Signed(NamedTuple):
    """Numbers of the metadata that a map's timestamp names, and of the version of the map."""

    snapshot: int
    targets: int
    map_version: object


def _signed_now(store: Store) -> _Signed | None:
    """Return what is signed; None if the map is not."""

    def read(path: str) -> dict[str, Any]:
        signed: dict[str, Any] = json.loads(bytes(store.get(path, MAX_METADATA_BYTES)))["signed"]
        return signed

    if store.head(TIMESTAMP) is None:
        return None
    try:
        snapshot = int(read(TIMESTAMP)["meta"]["snapshot.json"]["version"])
        targets = int(read(f"{snapshot}.snapshot.json")["meta"]["targets.json"]["version"])
        version = read(f"{targets}.targets.json")["targets"]["root"]["custom"]["map_version"]
    except (KeyError, TypeError, ValueError, MapMissing) as error:
        raise MapDataError(f"what is signed cannot be read: {error}", path=store.url) from None
    return _Signed(snapshot, targets, version)


def _remove_metadata(store: Store, old_s: float) -> None:
    """Remove old snapshots and targets before those that the timestamp names; roots stay, a chain."""
    if (signed := _signed_now(store)) is None:
        return
    for kind, number in (("snapshot", signed.snapshot), ("targets", signed.targets)):
        before: list[str] = []
        while number > 1 and store.head(f"{number - 1}.{kind}.json") is not None:
            number -= 1
            before.append(f"{number}.{kind}.json")
        for path in reversed(before):  # so that none is left below a gap if this is killed
            step("prune.metadata")
            _remove_if_old(store, path, old_s)


def _old_versions(store: Store, current: Current, old_s: float) -> list[int]:
    """Return versions not current since ``old_s``, or made before it and never served; ascending."""
    old: list[int] = []
    replaced_s: float | None = None  # time at which the following version was made
    served: set[int] = set()
    for entry in earlier_versions(store, current):
        served.add(entry.version)
        if replaced_s is not None and replaced_s < old_s:
            old.append(entry.version)
        replaced_s = entry.created_s
    for version in list_entries(store):
        if version not in served and version != current.version:
            unserved = _entry(store, version)
            if unserved is not None and unserved.created_s < old_s:
                old.append(version)
    return sorted(old)


def _entry(store: Store, version: int) -> Entry | None:
    try:
        return read_entry(store, version)
    except MapMissing:  # pruned by another process
        return None


def _needed(store: Store, progress: Progress, result: Pruned) -> set[bytes]:
    """Return the hashes of all objects of the versions that are listed or current now."""
    roots: dict[str, Current] = {}
    for version in list_entries(store):
        if (entry := _entry(store, version)) is not None:
            roots[entry.root] = entry.current
            result.kept_versions.append(version)
    current = require_current(store)
    roots[current.root] = current
    served = {current.root, *(entry.root for entry in earlier_versions(store, current))}
    progress.stage("read versions", len(roots))
    needed: set[bytes] = set()
    for named in roots.values():
        try:
            needed.update(objects_of(store, named))
        except MapMissing:  # a version that was never served may be incomplete
            if named.root in served:
                raise
        progress.advance(1)
    return needed


def _remove_parts(store: Store, old_s: float) -> int:
    """Remove old parts of slices, and return their number."""
    old = [found.path for found in store.list(PARTS) if found.modified_s < old_s]
    removed = 0
    for path in old:
        step("prune.part")
        removed += _remove_if_old(store, path, old_s)
    return removed


def _remove_objects(
    store: Store, needed: set[bytes], old_s: float, progress: Progress, result: Pruned
) -> None:
    names = {digest.hex() for digest in needed}
    needed.clear()
    listed = list(store.list(_BLOBS))
    progress.stage("look at objects", len(listed))
    for found in listed:
        if found.path.rpartition("/")[2] not in names and found.modified_s < old_s:
            step("prune.object")
            removed = _remove_if_old(store, found.path, old_s)
        else:
            removed = False
        result.objects += removed
        result.bytes += found.size * removed
        result.kept_objects += not removed
        result.kept_bytes += found.size * (not removed)
        progress.advance(1)
    progress.done(len(listed))


def _remove_if_old(store: Store, path: str, old_s: float) -> bool:
    """Remove an old object, unless a publisher has sent it again since it was listed."""
    found = store.head(path)
    if found is None or found.modified_s >= old_s:
        return False
    store.delete(path)
    return True
