# SPDX-License-Identifier: Apache-2.0
"""Publishing a map: what is new of it is sent, and then all of it becomes the current version at once.

Killed at any moment, the version that was current is whole; run again, what was sent is not sent again.
"""

from __future__ import annotations

import itertools
import re
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from hashlib import sha256
from typing import Final, NamedTuple

import msgspec
import numpy as np

from shmmap.errors import BadRequest, CannotWrite, MapDataError, MapMissing, error_from_wire
from shmmap.failpoints import step
from shmmap.layers.points import LAYER
from shmmap.layers.spec import canonical_layers, layer_spec
from shmmap.layers.versions import LayerVersions
from shmmap.origin.catalogue import Catalogue
from shmmap.origin.remote.map_versions import (
    CurrentState,
    Entry,
    add_version,
    new_entry,
    read_current,
    read_root,
    read_shards,
)
from shmmap.origin.remote.published_index import (
    EXACT,
    LayerObjects,
    Root,
    Shard,
    is_id_prefix,
    map_version_of,
    pack_root,
    pack_shard,
)
from shmmap.origin.remote.published_object import blob_path
from shmmap.origin.remote.store import Store
from shmmap.origin.remote.zstd_frame import pack_frame
from shmmap.prepare.run import Failure, PrepareProgress, neighbours_of
from shmmap.prepare.task_pool import TaskPool
from shmmap.publishing.known_objects import write_known_objects
from shmmap.publishing.messages import CellSent, CellToSend, NotSent, PublishSettings, decode_sent
from shmmap.publishing.sending import send_object
from shmmap.publishing.shards import CellObjects, check_names, divide_into_shards, shard_side
from shmmap.publishing.worker import TASKS_AHEAD

__all__ = ["Published", "publish_map"]

_LONGEST_S: Final = 86_400.0  # what a run reuses must not be as old as what pruning removes
_SENT_AT_ONCE: Final = 16


@dataclass(slots=True)
class Published:
    """What a run came to.

    Attributes
    ----------
    version
        The new version's number; None where nothing has changed or a layer could not be made.
    current
        The number of the version that is current now; 0 where there is none.
    root
        SHA-256 of the root's object.
    objects, sent_objects, sent_bytes
        Objects of the version's layers; what was sent: all objects, and their bytes.
    bytes
        Bytes of the objects of all layers.
    """

    cells: int
    layers: tuple[str, ...]
    id_prefix: str
    version: int | None = None
    current: int = 0
    map_version: int = 0
    root: str = ""
    objects: int = 0
    sent_objects: int = 0
    sent_bytes: int = 0
    bytes: int = 0
    failures: list[Failure] = field(default_factory=list)


@dataclass(slots=True)
class _Before:
    """The version that was current when a run began."""

    state: CurrentState
    root: Root | None = None
    shards: dict[tuple[int, int], tuple[bytes, int]] = field(default_factory=dict)  # key: content, row
    layers: list[LayerObjects] = field(default_factory=list)


class _SentShard(NamedTuple):
    """A shard's row of the root; whether its object was sent now."""

    key: tuple[int, int]
    cells: int
    size: int
    sha256: bytes
    is_new: bool


def publish_map(
    catalogue: Catalogue,
    store: Store,
    layers: Sequence[str],
    *,
    settings: PublishSettings,
    id_prefix: str = "",
    resend: bool = False,
    workers: int,
    progress: PrepareProgress,
) -> Published:
    """Publish a map, and make it current.

    Parameters
    ----------
    store, settings
        Where, and how workers open it; what is known there is filled in here.
    layers
        Specs of layers besides ``points``, in any form.
    id_prefix
        What ids begin with; empty: as before, at first ``/<last part of the URL>/``.
    resend
        Send every object again, as if none were there, and make that a version.
    workers
        How many processes make layers.

    Returns
    -------
    What came of it.  With failures nothing was made current.

    Raises
    ------
    BadRequest
        A layer is unknown, the prefix is not that of the versions before, or the store takes nothing.
    Offline, CannotWrite, MapDataError
        The store does not answer or refuses; its current version is damaged; it took longer than a day.
    InstanceBusy
        Another publisher was quicker: its version is current.
    """
    if store.read_only:
        raise BadRequest(f"{store.url}: {store.read_only}")
    began_s = time.monotonic()
    names = (LAYER, *(name for name in canonical_layers([LAYER, *layers]) if name != LAYER))
    check_names(catalogue)
    before = _read_before(store, progress, resend=resend)
    prefix = _prefix(before.root, id_prefix, store.url)
    result = Published(len(catalogue), names, prefix)
    if before.state.current is not None:
        result.current = before.state.current.version
    side = shard_side(catalogue, len(names), before.root.shard_m if before.root is not None else None)
    with tempfile.NamedTemporaryFile(prefix="shmmap-publish-") as known:
        if write_known_objects(known.name, before.layers):
            settings = msgspec.structs.replace(settings, known=known.name)
        before.layers.clear()
        has_none = before.root is None and next(iter(store.list("blobs/")), None) is None
        look = not (resend or has_none)
        settings = msgspec.structs.replace(settings, is_first=not look)
        objects = _send_cells(catalogue, names, settings, workers, progress, result)
    if result.failures:
        return result
    result.objects = len(catalogue) * len(names)
    result.bytes = objects.nbytes
    root = _send_shards(catalogue, objects, side, store, before, names, prefix, progress, result, look=look)
    unpacked = pack_root(root)
    result.map_version = map_version_of(unpacked)
    if before.root is not None and unpacked == pack_root(before.root) and not resend:
        assert before.state.current is not None  # noqa: S101  where there is a root
        result.root = before.state.current.root
        progress.done(len(catalogue))
        return result
    entry = _send_root(store, unpacked, before.state, began_s, result, look=look)
    add_version(store, entry, before.state)
    result.version = result.current = entry.version
    progress.done(len(catalogue))
    return result


def _read_before(store: Store, progress: PrepareProgress, *, resend: bool) -> _Before:
    before = _Before(read_current(store))
    if before.state.current is None:
        return before
    try:
        before.root = root = read_root(store, before.state.current)
    except (MapMissing, MapDataError):
        if resend:
            return before
        raise
    if resend:
        return before
    progress.stage("read the current version", root.cells)
    for number, shard in enumerate(read_shards(store, root)):
        row, column = root.keys[number].tolist()
        before.shards[row, column] = sha256(pack_shard(shard)).digest(), number
        before.layers += shard.layers.values()
        progress.advance(len(shard))
    return before


def _prefix(before: Root | None, wanted: str, url: str) -> str:
    if wanted and not is_id_prefix(wanted):
        raise BadRequest(f"ids cannot begin with {wanted!r}", hint="a prefix begins and ends with /")
    if before is not None:
        if wanted not in ("", before.id_prefix):
            raise BadRequest(
                f"ids of the map at {url} begin with {before.id_prefix}, in all its versions",
                hint="publish to another URL for other ids",
            )
        return before.id_prefix
    last = re.sub(r"[^\w.-]", "_", url.rpartition("/")[2]) or "map"
    return wanted or f"/{last}/"


def _send_cells(
    catalogue: Catalogue,
    names: tuple[str, ...],
    settings: PublishSettings,
    workers: int,
    progress: PrepareProgress,
    result: Published,
) -> CellObjects:
    """Have the objects of all cells in the store; failures go into the result."""
    objects = CellObjects(len(catalogue), names)
    versions = LayerVersions(lambda: catalogue)

    def tasks() -> Iterator[CellToSend]:
        for index in range(len(catalogue)):
            around, crowded = neighbours_of(catalogue, versions, index, names)
            if crowded:
                result.failures.extend(crowded)
                progress.advance(1)
                continue
            yield CellToSend(
                index,
                catalogue.id(index),
                catalogue.path(index),
                catalogue.box(index),
                catalogue.frame_id,
                tuple(around),
                tuple(around.values()),
            )

    def finished(task: CellToSend, done: CellSent | NotSent) -> None:
        if isinstance(done, CellSent):
            objects.set(task.number, done)
            sent = [layer.sent for layer in done.layers if layer.sent]
            result.sent_objects += len(sent)
            result.sent_bytes += sum(sent)
        elif not done.layer:  # the store refuses: so it would each other cell
            raise error_from_wire(done.code, done.message, done.hint)
        else:
            result.failures.append(Failure(task.cell_id, done.layer, done.message))
        progress.advance(1)

    def died(task: CellToSend, how: str) -> None:
        message = f"{task.path}: the worker died of it ({how})"
        result.failures.append(Failure(task.cell_id, ", ".join(task.layers), message))
        progress.advance(1)

    progress.stage("publish", len(catalogue))
    pool: TaskPool[CellToSend, CellSent | NotSent] = TaskPool(
        "shmmap.publishing.worker",
        [msgspec.json.encode(settings).decode()],
        workers=max(1, workers),
        decode=decode_sent,
        finished=finished,
        died=died,
        ahead=TASKS_AHEAD,
    )
    pool.run(tasks())
    return objects


def _send_shards(
    catalogue: Catalogue,
    objects: CellObjects,
    side: float,
    store: Store,
    before: _Before,
    names: tuple[str, ...],
    prefix: str,
    progress: PrepareProgress,
    result: Published,
    *,
    look: bool,
) -> Root:
    """Send the shards that are new, and return the root."""

    def send(keyed: tuple[tuple[int, int], Shard]) -> _SentShard:
        key, shard = keyed
        unpacked = pack_shard(shard)
        known = before.shards.get(key)
        if known is not None and before.root is not None and known[0] == sha256(unpacked).digest():
            number = known[1]
            size, digest = int(before.root.sizes[number]), before.root.shard_sha256(number)
            return _SentShard(key, len(shard), size, digest, False)
        frame = pack_frame(unpacked)
        digest = sha256(frame).digest()
        step("publish.shard")
        is_new = send_object(store, blob_path(digest), frame, look=look)
        return _SentShard(key, len(shard), len(frame), digest, is_new)

    rows: list[_SentShard] = []
    progress.stage("index", len(catalogue))
    divided = divide_into_shards(catalogue, objects, side)
    with ThreadPoolExecutor(_SENT_AT_ONCE, "shard") as pool:
        while some := list(itertools.islice(divided, _SENT_AT_ONCE)):
            rows += pool.map(send, some)
            progress.advance(sum(len(shard) for _, shard in some))
    result.sent_objects += sum(row.is_new for row in rows)
    result.sent_bytes += sum(row.size for row in rows if row.is_new)
    boxes = catalogue.boxes
    largest_x, largest_y = (boxes[:, 2:] - boxes[:, :2]).max(axis=0).tolist()
    bounds = catalogue.bounds
    assert bounds is not None  # noqa: S101  a catalogue without cells is not loaded
    return Root(
        id_prefix=prefix,
        frame_id=catalogue.frame_id,
        crs=catalogue.frame.crs,
        origin=catalogue.frame.origin,
        unit_m=catalogue.frame.unit_m,
        encoding=EXACT,
        cells=len(catalogue),
        bounds=bounds,
        shard_m=side,
        largest_m=(largest_x, largest_y),
        mean_m=catalogue.mean_size,
        layers={name: layer_spec(name).builder_version for name in names},
        keys=np.array([row.key for row in rows], np.int32),
        counts=np.array([row.cells for row in rows], np.uint32),
        sizes=np.array([row.size for row in rows], np.uint32),
        hashes=np.frombuffer(b"".join(row.sha256 for row in rows), np.uint8).reshape(-1, 32),
    )


def _send_root(
    store: Store, unpacked: bytes, seen: CurrentState, began_s: float, result: Published, *, look: bool
) -> Entry:
    frame = pack_frame(unpacked)
    result.root = sha256(frame).hexdigest()
    step("publish.root")
    if send_object(store, blob_path(bytes.fromhex(result.root)), frame, look=look):
        result.sent_objects += 1
        result.sent_bytes += len(frame)
    if time.monotonic() - began_s > _LONGEST_S:
        raise CannotWrite(
            f"publishing to {store.url} took longer than a day: the version is not made current",
            hint="run the same command again: what was sent within a day is not sent again",
        )
    step("version.entry")
    return new_entry(store, result.root, len(frame), seen.current)
