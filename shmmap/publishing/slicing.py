# SPDX-License-Identifier: Apache-2.0
"""Makes one slice of a run: computes and sends layers of a published map's cells, and lists them in its part.

A slice does not depend on other slices: it reads the version, and the neighbours of its cells in other
slices.  A slice made again gives the same bytes; objects that exist are neither computed nor sent again.
"""

from __future__ import annotations

import contextlib
from collections import OrderedDict
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace
from hashlib import sha256
from itertools import pairwise
from time import time
from typing import Final, NamedTuple

import msgspec
import numpy as np

from shmmap.errors import BadRequest, InstanceBusy, MapDataError, MapMissing
from shmmap.failpoints import step
from shmmap.layers.disk_cache import LayerCache
from shmmap.layers.points import LAYER
from shmmap.layers.spec import canonical_layers, layer_spec
from shmmap.layers.versions import LayerVersions
from shmmap.origin.catalogue import Catalogue
from shmmap.origin.remote.map_versions import Current, read_root_object, read_shard_object, require_current
from shmmap.origin.remote.object_tier import KeptObjects, ObjectTier
from shmmap.origin.remote.published_index import (
    MAX_LAYERS,
    MAX_ROOT_BYTES,
    MAX_SHARD_BYTES,
    Root,
    Shard,
    pack_shard,
    unpack_root,
    unpack_shard,
)
from shmmap.origin.remote.published_object import POINTS, STAMP_BYTES, LayerSource, pack_source
from shmmap.origin.remote.slice_part import (
    MAX_PART_BYTES,
    MAX_SLICES,
    Part,
    RunName,
    pack_part,
    run_of,
    slice_of_shards,
    unpack_part,
    with_parts,
)
from shmmap.origin.remote.store import Store, Tag, put_over, refuse_read_only
from shmmap.origin.remote.zstd_frame import DAMAGED, unpack_frame
from shmmap.prepare.run import Failure, task_of
from shmmap.prepare.task_pool import CellTask
from shmmap.processes.request_threads import RequestThreads
from shmmap.progress import Progress
from shmmap.publishing.messages import CellSent, NotSent, SliceSettings
from shmmap.publishing.new_version import (
    CONCURRENT_REQUESTS,
    SentObject,
    absent_objects,
    run_workers,
    send_packed,
)
from shmmap.publishing.shards import CellObjects
from shmmap.segment.version import Source

_THERE_S: Final = 4 * 86_400.0  # maximum age of a slice that is not made again; joining accepts six days
_SHARDS_HELD: Final = 16
_STRIP_CELLS: Final = 4
_MAX_TRIES: Final = 100


class BaseVersion(NamedTuple):
    """The version that a run adds layers to; ``content`` is the content digest of its root."""

    current: Current
    root: Root
    content: bytes


def read_base(store: Store, current: Current) -> BaseVersion:
    """Read the root of a version; errors are those of `read_root`."""
    frame = read_root_object(store, current)
    root = unpack_root(frame, name=f"{store.url}: root of version {current.version}")
    return BaseVersion(current, root, sha256(unpack_frame(frame, MAX_ROOT_BYTES, name="root")).digest())


def changed_layers(before: Shard, after: Shard, allowed: Collection[str], *, name: str) -> list[str]:
    """Return the layers of a shard that are new or have changed.

    Parameters
    ----------
    allowed
        Layers that may be new or may have changed.
    name
        Name of the part with the later shard, for messages.

    Raises
    ------
    MapDataError
        The shard's cells or a layer that is not allowed differ (cause ``damaged``).
    """
    same = before.names == after.names and _are_equal(before, after, ("boxes", "z", "points"))
    if not same:
        raise MapDataError("a shard has other cells than the version has", path=name, cause=DAMAGED)
    changed = [
        layer
        for layer, objects in after.layers.items()
        if layer not in before.layers
        or not _are_equal(before.layers[layer], objects, ("sizes", "raws", "hashes", "contents"))
    ]
    foreign = sorted(set(changed).difference(allowed))
    if foreign:
        raise MapDataError(f"a shard has another layer {foreign[0]}", path=name, cause=DAMAGED)
    return changed


def new_objects(root: Root, number: int, shard: Shard, changed: Collection[str]) -> set[tuple[bytes, int]]:
    """Return hash and size of the objects of a shard's changed layers, and of the shard if any changed."""
    if not changed:
        return set()
    found = {one for name in changed for one in shard.layers[name].objects()}
    return found | {(root.shard_sha256(number), int(root.sizes[number]))}


def _are_equal(one: object, other: object, columns: Sequence[str]) -> bool:
    """Whether columns have the same bytes, which also works for NaN heights."""
    return all(getattr(one, column).tobytes() == getattr(other, column).tobytes() for column in columns)


@dataclass(slots=True)
class Sliced:
    """Result of making a slice.

    Attributes
    ----------
    version
        Number of the version to which layers are added.
    layers
        Specs of the run's layers.
    there
        Whether the slice already existed complete, so that nothing was done.
    kept, made
        Layers of cells that the version already has; layers made now, those from the cache included.
    sent_objects, sent_bytes
        Number and bytes of the objects that were sent, shards included.
    """

    version: int
    run: RunName
    slice: int
    layers: tuple[str, ...]
    shards: int
    cells: int
    there: bool = False
    kept: int = 0
    made: int = 0
    bytes: int = 0
    sent_objects: int = 0
    sent_bytes: int = 0
    failures: list[Failure] = field(default_factory=list)


def prepare_slice(
    store: Store,
    layers: Sequence[str],
    *,
    number: int,
    slices: int,
    settings: SliceSettings,
    current: Current | None = None,
    workers: int,
    progress: Progress,
) -> Sliced:
    """Make a slice and send its objects, shards and part to the store.

    Parameters
    ----------
    layers
        Specs of the layers, in any form; ``points`` is ignored.
    number, slices
        Number of the slice, from 1, and number of slices.
    settings
        Settings by which workers open the store and keep layers.
    current
        The current version, if it was verified; None: the one in ``CURRENT``.
    workers
        Number of processes that make layers.

    Returns
    -------
    The result.  If it has failures, no part was written.

    Raises
    ------
    BadRequest
        A layer is unknown, no layer or no valid slice is given, or the store is read-only.
    MapMissing, MapDataError, Offline, CannotWrite
        Nothing is published there, the map is damaged, the store does not answer or refuses, or the cache
        directory cannot be written.
    """
    refuse_read_only(store)
    if not 1 <= number <= slices <= MAX_SLICES:
        raise BadRequest(
            f"there is no slice {number} of {slices}", hint=f"1/N to N/N, N at most {MAX_SLICES:,}"
        )
    names = tuple(name for name in canonical_layers(layers) if name != LAYER)
    if not names:
        raise BadRequest("name at least one layer", hint="such as --layer 'ndt(leaf=2.0)'")
    store.require_conditions()
    base = read_base(store, current or require_current(store))
    if len(base.root.layers.keys() | set(names)) > MAX_LAYERS:
        raise BadRequest(f"a published map has at most {MAX_LAYERS} layers")
    if settings.cache_bytes:
        LayerCache(settings.cache_dir, limit_bytes=settings.cache_bytes).make()
    return _Slice(store, base, names, number, slices, settings, progress).run(max(1, workers))


@dataclass(slots=True)
class _Making:
    """A shard whose cells are being made; ``left`` counts the cells that are not done."""

    shard: Shard
    objects: CellObjects
    left: int


class _Cells(Catalogue):
    """The cells of a shard and of the shards around it."""

    def __init__(self, root: Root, shards: Sequence[Shard]) -> None:
        places = [(name, shard, row) for shard in shards for row, name in enumerate(shard.names)]
        places.sort(key=lambda place: place[0])
        if any(one == other for (one, *_), (other, *_) in pairwise(places)):
            raise MapDataError("two shards have a cell of one name", cause=DAMAGED)
        self._places = [(shard, row) for _, shard, row in places]
        self._builder_version = root.layers[POINTS]
        self.frame_id = root.frame_id
        stamps = b"".join(
            shard.layers[POINTS].contents[row, :STAMP_BYTES].tobytes() for shard, row in self._places
        )
        super().__init__(
            id_prefix=root.id_prefix,
            names=np.array([name for name, _, _ in places], np.bytes_),
            boxes=np.array([shard.boxes[row] for shard, row in self._places], np.float64),
            stamps=np.frombuffer(stamps, "<i8").reshape(-1, STAMP_BYTES // 8).astype(np.int64),
        )

    def source(self, index: int) -> Source:
        """Return the source of a cell: the object of its points."""
        shard, row = self._places[index]
        points = LayerSource(*shard.layers[POINTS].name(row), self._builder_version)
        return pack_source(self.id(index), {POINTS: points})

    def rows_of(self, shard: Shard) -> list[tuple[int, int]]:
        """Return index and row of each cell of a shard, in an order that keeps neighbours close."""
        found = [(index, row) for index, (other, row) in enumerate(self._places) if other is shard]
        x, y = np.floor(shard.boxes[:, :2] / [size or 1.0 for size in self.mean_size]).T
        strips = np.floor(x / _STRIP_CELLS)  # narrow enough that the previous row's cells are still held
        return sorted(found, key=lambda one: (strips[one[1]], y[one[1]], x[one[1]]))


class _Slice:
    """Makes one slice."""

    def __init__(
        self,
        store: Store,
        base: BaseVersion,
        names: tuple[str, ...],
        number: int,
        slices: int,
        settings: SliceSettings,
        progress: Progress,
    ) -> None:
        self._store = store
        self._base = base
        self._root = root = base.root
        self._progress = progress
        self._layers = {name: layer_spec(name).builder_version for name in names}
        self._lacking = tuple(name for name, built in self._layers.items() if root.layers.get(name) != built)
        self._halo_m = max((layer_spec(name).halo_m for name in self._lacking), default=0.0)
        self._settings = msgspec.structs.replace(settings, keep_points=self._halo_m > 0)
        tier = (
            ObjectTier(settings.cache_dir, limit_bytes=settings.cache_bytes) if settings.cache_bytes else None
        )
        self._pages = KeptObjects(store, tier, is_index=True, keep=self._halo_m > 0)
        self._numbers = np.flatnonzero(slice_of_shards(root, slices) == number)
        self._first = root.first_indices
        self._held: OrderedDict[int, Shard] = OrderedDict()
        self._making: dict[int, _Making] = {}
        self._rows: dict[int, SentObject] = {}
        self._result = Sliced(
            base.current.version,
            run_of(base.content, names, slices),
            number,
            names,
            len(self._numbers),
            int(root.counts[self._numbers].sum(dtype=np.uint64)),
        )

    def run(self, workers: int) -> Sliced:
        result = self._result
        path = result.run.part_path(result.slice)
        before, tag = self._part_there(path)
        self._store.require_conditions(tag)
        if before is not None and self._is_whole(before):
            result.there = True
            self._progress.done(result.cells)
            return result
        result.kept = result.cells * (len(self._layers) - len(self._lacking))
        self._progress.stage("prepare", result.cells)
        if self._lacking:
            self._make(workers)
        else:
            for number in self._numbers.tolist():
                sha, size = self._root.shard_sha256(number), int(self._root.sizes[number])
                self._rows[number] = SentObject(sha, size, 0)
        if not result.failures:
            self._put_part(path, tag)
            self._progress.done(result.cells)
        return result

    # --- the part -------------------------------------------------------------------------------

    def _part_there(self, path: str) -> tuple[Part | None, Tag | None]:
        """Return the existing part (None if there is no valid one) and the tag of its object."""
        tag = None
        try:
            frame, tag = self._store.get_tagged(path, MAX_PART_BYTES)
            return unpack_part(frame, self._result.run, self._result.slice), tag
        except MapMissing:
            return None, None
        except MapDataError:
            if tag is None:  # the object is too large for a part
                self._store.delete(path)
            return None, tag

    def _is_whole(self, part: Part) -> bool:
        """Whether a part equals one made now, and all objects that it names exist and are recent."""
        if part.layers != self._layers:
            return False
        since_s = time() - _THERE_S
        self._progress.stage("look for objects", self._result.cells)
        with (
            RequestThreads(CONCURRENT_REQUESTS, "head") as threads,
            contextlib.suppress(MapMissing, MapDataError),
        ):
            root = with_parts(self._root, [part])
            for number in self._numbers.tolist():
                shard = unpack_shard(read_shard_object(self._store, root, number), root, number)
                changed = changed_layers(self._shard(number), shard, self._lacking, name="")
                if sorted(changed) != sorted(self._lacking):
                    return False
                new = new_objects(root, number, shard, changed)
                if absent_objects(self._store, sorted(new), threads, since_s=since_s):
                    return False
                self._progress.advance(len(shard))
            return True
        return False

    def _put_part(self, path: str, tag: Tag | None) -> None:
        numbers = self._numbers
        rows = [self._rows[number] for number in numbers.tolist()]
        part = Part(
            version=self._base.current.version,
            root_content=self._base.content,
            slice=self._result.slice,
            slices=self._result.run.slices,
            layers=self._layers,
            keys=self._root.keys[numbers],
            counts=self._root.counts[numbers],
            sizes=np.array([row.size for row in rows], np.uint32),
            hashes=np.frombuffer(b"".join(row.sha256 for row in rows), np.uint8).reshape(-1, 32),
        )
        data = pack_part(part)
        step("slice.part")
        for _ in range(_MAX_TRIES):
            if put_over(self._store, path, data, tag):
                step("slice.made")
                return
            tag = self._part_there(path)[1]  # another process has made the same slice meanwhile
        raise InstanceBusy(f"other programs keep writing {self._store.url}/{path}", hint="try again later")

    # --- cells ----------------------------------------------------------------------------------

    def _make(self, workers: int) -> None:
        tasks = (task for number in self._numbers.tolist() for task in self._tasks_of(number))
        module = "shmmap.publishing.slice_worker"
        run_workers(module, self._settings, tasks, workers, finished=self._finished, died=self._died)

    def _tasks_of(self, number: int) -> Iterator[CellTask]:
        shard = self._shard(number)
        cells = _Cells(self._root, self._around(number, shard))
        versions = LayerVersions(lambda: cells)
        self._making[number] = _Making(shard, CellObjects(len(shard), self._lacking), len(shard))
        for index, row in cells.rows_of(shard):
            task, crowded = task_of(cells, versions, index, self._lacking)
            task.number = int(self._first[number]) + row
            if crowded:
                self._failed(task, crowded)
            else:
                yield task

    def _around(self, number: int, shard: Shard) -> list[Shard]:
        """Return a shard, and the shards with neighbours that its cells' layers may use."""
        if not self._halo_m:
            return [shard]
        low, high = shard.boxes[:, :2].min(axis=0), shard.boxes[:, 2:].max(axis=0)
        (min_x, min_y), (max_x, max_y) = (low - self._halo_m).tolist(), (high + self._halo_m).tolist()
        near = self._root.shards_near((min_x, min_y, max_x, max_y)).tolist()
        return [shard, *(self._shard(other) for other in near if other != number)]

    def _shard(self, number: int) -> Shard:
        found = self._held.get(number)
        if found is None:
            found = unpack_shard(read_shard_object(self._pages, self._root, number), self._root, number)
            self._held[number] = found
            if len(self._held) > _SHARDS_HELD:
                self._held.popitem(last=False)
        self._held.move_to_end(number)
        return found

    def _finished(self, task: CellTask, done: CellSent | NotSent) -> None:
        if isinstance(done, NotSent):
            self._failed(task, [Failure(task.cell_id, done.layer, done.message)])
            return
        making = self._making[self._number_of(task)]
        making.objects.set(task.number - int(self._first[self._number_of(task)]), done)
        result = self._result
        for layer in done.layers:
            result.bytes += layer.size
            self._count(layer.sent)
        result.made += len(done.layers)
        self._done(task)

    def _died(self, task: CellTask, how: str) -> None:
        message = f"{task.cell_id}: the worker died of it ({how})"
        self._failed(task, [Failure(task.cell_id, ", ".join(task.layers), message)])

    def _failed(self, task: CellTask, failures: Sequence[Failure]) -> None:
        self._result.failures += failures
        self._done(task)

    def _done(self, task: CellTask) -> None:
        number = self._number_of(task)
        making = self._making[number]
        making.left -= 1
        self._progress.advance(1)
        if not making.left:
            del self._making[number]
            if not self._result.failures:
                self._rows[number] = self._send_shard(making)

    def _number_of(self, task: CellTask) -> int:
        """Return the number of the shard that contains a task's cell."""
        return int(np.searchsorted(self._first, task.number, side="right")) - 1

    def _send_shard(self, making: _Making) -> SentObject:
        shard = replace(making.shard, layers={**making.shard.layers, **making.objects.layers})
        unpacked = pack_shard(shard)
        if len(unpacked) > MAX_SHARD_BYTES:
            raise MapDataError(
                f"a part of its index would have {len(unpacked):,} bytes, more than {MAX_SHARD_BYTES:,}",
                path=self._store.url,
                cause="too_large",
                hint="publish the map with these layers in one go: shmmap publish MAP URL --layer ...",
            )
        step("slice.shard")
        sent = send_packed(self._store, unpacked)
        self._count(sent.sent_bytes)
        return sent

    def _count(self, sent_bytes: int) -> None:
        self._result.sent_objects += sent_bytes > 0
        self._result.sent_bytes += sent_bytes
