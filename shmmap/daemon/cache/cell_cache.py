# SPDX-License-Identifier: Apache-2.0
"""The map in memory: finds cells, has loaded what is wanted, publishes, supersedes, evicts.

The store joins the pure books (`residency`) with what does the work: the catalogue, the loads
(`loading`) and the shared-memory directory.  It never blocks and knows nothing of sockets: whoever
waits for a key is told through ``on_settled``.
"""

from __future__ import annotations

import logging
import os
from collections import deque
from collections.abc import Callable, Hashable
from typing import Final

from shmmap.daemon.cache.encoded_handles import cell_row, encode_handles
from shmmap.daemon.cache.ledger import Failure, Key, Load, Residency, Resident, Slot
from shmmap.daemon.cache.reclaimer import Reclaimer
from shmmap.daemon.cache.segment_name_watch import NameWatch
from shmmap.daemon.cache.warm_index import WarmCells
from shmmap.daemon.events.cell_events import CellEvents
from shmmap.daemon.events.log import EventLog
from shmmap.daemon.loading import worker_messages
from shmmap.daemon.loading.scheduler import Loading
from shmmap.daemon.loading.worker_pool import WorkerPool
from shmmap.failpoints import step
from shmmap.geometry import ZRange
from shmmap.layers.points import LAYER
from shmmap.layers.spec import layer_spec
from shmmap.layers.versions import MAX_NEIGHBOURS, LayerVersions
from shmmap.origin.catalogue import Catalogue, CatalogueChange, compare
from shmmap.origin.stamp import Stamp
from shmmap.segment.directory import ShmDirectory, is_full
from shmmap.segment.names import new_segment_name, segment_prefix
from shmmap.segment.publish_block import PublishBlock
from shmmap.statistics.writer import StatisticsWriter

__all__ = ["Store"]

_log = logging.getLogger(__name__)

_PAGE_BYTES: Final = 4096
_HEADER_ALLOWANCE_BYTES: Final = 2 * _PAGE_BYTES


class Store:
    """All cells of one map, on disk and in memory.

    Parameters
    ----------
    instance, epoch
        Part of every segment's name; part of its publish block.
    mode, gid
        Access of published segments; ``gid`` -1 leaves the group alone.
    on_settled
        Called with a key when its load ended, in whichever way.
    event_log
        Told what happens to cells.

    Attributes
    ----------
    events
        Tells what happens to cells.
    loads
        What is being loaded.
    history : deque
        For ``since``: map version before a change, ids that changed or appeared, ids that vanished.
    used : set
        Segments handed out since the statistics last showed them.
    warm
        The cells that are in memory at their current version.
    heights : dict
        Catalogue indices to lowest and highest z, metres, of cells that were loaded since they changed.
    index_of_version : dict
        Versions handed out (current and earlier ones) to catalogue indices.
    """

    def __init__(
        self,
        catalogue: Catalogue,
        residency: Residency,
        reclaimer: Reclaimer,
        pool: WorkerPool,
        directory: ShmDirectory,
        statistics: StatisticsWriter,
        *,
        instance: str,
        epoch: int,
        id_prefix: str,
        mode: int,
        gid: int,
        on_settled: Callable[[Key], None],
        event_log: EventLog,
    ) -> None:
        self.catalogue = catalogue
        self.books = residency
        self.reclaimer = reclaimer
        self.layers = LayerVersions(lambda: self.catalogue)
        self.loads = Loading(self, residency, reclaimer, pool, statistics, on_settled)
        self.warm = WarmCells(lambda: len(self.catalogue))
        self.id_prefix = id_prefix
        self.segment_prefix = segment_prefix(instance)
        self.heights: dict[int, tuple[float, float]] = {}
        self.names = NameWatch(directory.path, self.segment_prefix)
        self._directory = directory
        self._statistics = statistics
        self._instance = instance
        self._epoch = epoch
        self._mode = mode
        self._gid = gid
        self._on_settled = on_settled
        self.events = CellEvents(event_log, residency, statistics, self.wire_id)
        self._indices: dict[str, int] = {}
        self.index_of_version: dict[int, int] = {}
        self.used: set[Resident] = set()
        self.history: deque[tuple[int, frozenset[str], tuple[str, ...]]] = deque(maxlen=64)
        reclaimer.on_retired = self._leave
        reclaimer.on_freed = lambda resident: statistics.cell_removed(resident.name)
        reclaimer.on_renamed = statistics.cell_removed

    # --- names --------------------------------------------------------------------------------

    def index_of(self, cell: str) -> int | None:
        """Catalogue index of an id: whole, without the prefix, or a unique base name."""
        index = self._indices.get(cell)
        if index is None:
            index = self.catalogue.find(cell)
            if index is None and not cell.startswith("/"):
                index = self.catalogue.find(self.id_prefix + cell)
            if index is not None and len(self._indices) < 1 << 20:
                self._indices[cell] = index
        return index

    def wire_id(self, cell_id: str) -> str:
        """An id as replies carry it: without the prefix, whole where it does not start with it."""
        return cell_id[len(self.id_prefix) :] if cell_id.startswith(self.id_prefix) else cell_id

    # --- wanting ------------------------------------------------------------------------------

    def find_warm(self, index: int, layer: str, now_s: float) -> Resident | None:
        """The current version of a cell, if it is in memory (retired ones are put back in service)."""
        resident = self.warm.get(index, layer)
        if resident is None and self.books.zombies:
            key = Key(self.catalogue.id(index), layer)
            resident = self.reclaimer.revive(key, self.layers.version(index, layer), now_s)
            if resident is not None:
                self._enter(resident, index)
                self.events.revived(resident)
        return resident

    def at_height(self, indices: list[int], z: ZRange | None) -> list[int]:
        """Leave out cells whose heights, known once they were loaded, lie outside the range."""
        if z is None:
            return indices
        heights = self.heights
        return [i for i in indices if (known := heights.get(i)) is None or z.overlaps(*known)]

    def want(self, index: int, layer: str, priority: float, now_s: float, asker: Hashable = None) -> Slot:
        """Make sure that a load of a cold cell is under way, unless it failed too recently."""
        key = Key(self.catalogue.id(index), layer)
        slot = self.books.slot(key)
        if (
            slot.load is None
            and slot.failure is not None
            and not self.loads.may_retry(key, slot.failure, now_s)
        ):
            return slot
        if slot.load is None and slot.failure is not None:
            self.events.retried(key, slot.failure)
        self.books.want(key, self.estimate(index, layer), priority, asker)
        return slot

    def estimate(self, index: int, layer: str) -> int:
        """Bytes to reserve before a load: `points` has its file's bytes, plus its header, at most.

        Only for compressed and ASCII files can it be more; their worker asks for it, as does that of
        a computed layer, of which this is a guess.
        """
        share = 1.0 if layer == LAYER else layer_spec(layer).kind.bytes_ratio
        size = int(self.catalogue.stamp(index).size * share) + _HEADER_ALLOWANCE_BYTES
        return -(-size // _PAGE_BYTES) * _PAGE_BYTES

    # --- publishing -----------------------------------------------------------------------------

    def job(self, load: Load, number: int) -> worker_messages.Job | worker_messages.Check | None:
        """What a worker has to do for a load; None if its cell left the map, or nobody wants it any more."""
        index = self.index_of(load.key.cell_id)
        if index is None:
            return None
        if load.adopted is not None:
            if self.books.resident_named(load.adopted.name) is load.adopted:
                stamp = self.catalogue.stamp(index)
                return worker_messages.Check(number, self.catalogue.path(index), load.adopted.name, stamp)
            load.adopted = None  # it was retired before its turn came
            if not load.wanted:
                return None
            load.estimate = self.estimate(index, load.key.layer)
        layer = load.key.layer
        points = self.warm.get(index, LAYER) if layer != LAYER else None
        return worker_messages.Job(
            number,
            load.key.cell_id,
            self.catalogue.path(index),
            layer,
            self.catalogue.box(index),
            self.catalogue.frame_id,
            load.estimate,
            points.name if points is not None else "",
            tuple(map(self.catalogue.path, self.layers.neighbours(index, layer)[: MAX_NEIGHBOURS + 1])),
        )

    def publish(self, load: Load, done: worker_messages.Done, fd: int, now_s: float) -> None:
        """Name a finished segment and hand it out from now on."""
        index = self.index_of(load.key.cell_id)
        if index is None:
            self._statistics.add("loads_failed")
            self.loads.abandon(load)
            return
        if not self._catch_up(index, load.key.layer, done):
            self.books.requeue(load)
            return
        version = self.layers.version(index, load.key.layer)
        name = new_segment_name(self._instance)
        try:
            nbytes = self._directory.publish(
                fd,
                name,
                block=PublishBlock(self._epoch, version),
                header_bytes=done.header_bytes,
                mode=self._mode,
                gid=self._gid,
            )
        except OSError as error:
            code = "no_space" if is_full(error) else "load_failed"
            self.loads.fail(load, code, f"cannot publish: {error.strerror}", None, now_s)
            return
        resident = Resident(
            name=name,
            key=load.key,
            version=version,
            nbytes=nbytes,
            points=done.points,
            box=self.catalogue.box(index),
            z_min=done.z_min,
            z_max=done.z_max,
            last_use_s=now_s,
            load_ns=done.load_ns,
        )
        old = self.books.loaded(load, resident)
        if old is not None:
            self.reclaimer.superseded(old, now_s)
        step("daemon.catalogue")
        self._enter(resident, index)
        took_ns = int((now_s - load.started_s) * 1e9)
        self.events.loaded(resident, took_ns, replaces=old.version if old is not None else 0)
        self._statistics.add("loads_from_cache", done.cached)
        self._statistics.add("layers_computed", not done.cached and resident.key.layer != LAYER)
        for warning in done.warnings:
            _log.info("%s: %s", load.key.cell_id, warning)
        if done.dropped:
            _log.info("%s: %d points left out, not finite", load.key.cell_id, done.dropped)
        self._on_settled(load.key)

    def adopt(self, resident: Resident, index: int) -> None:
        """Take a segment of an earlier life; it is handed out once a worker has checked it."""
        self.books.adopt(resident)
        self._enter(resident, index)
        self._statistics.add("adopted")

    def accept(self, load: Load, resident: Resident) -> bool:
        """Hand out an adopted segment from now on; False if it has left service meanwhile."""
        index = self.index_of(load.key.cell_id)
        if index is None or self.books.resident_named(resident.name) is not resident:
            return False
        step("daemon.accept")
        self.books.checked(load, resident)
        self._enter(resident, index)
        return True

    def reject(self, resident: Resident, why: str, now_s: float) -> None:
        """Take an adopted segment that is not what it should be out of service, if it still is in it."""
        if self.books.resident_named(resident.name) is resident:
            self._statistics.add("adoptions_failed")
            _log.warning("%s of an earlier daemon is not used: %s", resident.name, why)
            self.reclaimer.retire(resident, now_s, "damaged")

    def estimate_of(self, key: Key) -> int:
        """Bytes to reserve before loading a key."""
        index = self.index_of(key.cell_id)
        return self.estimate(index, key.layer) if index is not None else 0

    def failed(self, key: Key, failure: Failure, now_s: float) -> None:
        """Hear that a load ended without a segment."""
        self.events.failed(key, failure, now_s)

    def _catch_up(self, index: int, layer: str, done: worker_messages.Done) -> bool:
        """Take over the states of the files that a worker has read; False if the map has newer ones."""
        around = self.layers.neighbours(index, layer)
        if len(around) != len(done.neighbours):
            return False  # the map has got or lost a neighbour meanwhile
        for cell, read in zip((index, *around), (done.stamp, *done.neighbours), strict=True):
            stamp, known = Stamp(*read), self.catalogue.stamp(cell)
            if stamp == known:
                continue
            if self._lies_on_disk(cell, known):
                return False  # it read what a reload has already found replaced
            self._remember({self.catalogue.id(cell)}, ())
            self.catalogue.set_stamp(cell, stamp)
            self._chill(cell)
            self.events.changed(self.catalogue.id(cell), self.catalogue.version(cell))
        return True

    def _lies_on_disk(self, index: int, stamp: Stamp) -> bool:
        try:
            return Stamp.of(os.stat(self.catalogue.path(index))) == stamp
        except OSError:
            return False

    def _enter(self, resident: Resident, index: int) -> None:
        """A resident can be handed out: encode its handle, find it by index if it is current.

        One that is not checked yet only shows: who holds its version need not be sent it again.
        """
        if not resident.checked:
            self.index_of_version[resident.version] = index
            self._show(resident)
            return
        encode_handles(resident, *self._names_of(resident))
        current = resident.version == self.layers.version(index, resident.key.layer)
        if current:
            self.warm.enter(resident, index)
            self.heights[index] = (resident.z_min, resident.z_max)
        self.index_of_version[resident.version] = index
        self._indices[self.wire_id(resident.key.cell_id)] = index
        self._show(resident, "resident" if current else "stale")

    def _leave(self, resident: Resident, why: str) -> None:
        """A resident was retired: nobody finds it any more, its bytes still show."""
        self.events.retired(resident, why)
        self.used.discard(resident)
        index = self.index_of(resident.key.cell_id)
        if index is not None and self.warm.get(index, resident.key.layer) is resident:
            self.warm.leave(index, resident.key.layer)
        self._show(resident, "zombie")

    def _show(self, resident: Resident, state: str = "resident") -> None:
        self._statistics.cell_changed(resident.name, cell_row(resident, *self._names_of(resident), state))

    def _names_of(self, resident: Resident) -> tuple[str, str]:
        """Cell id and segment name without their prefixes."""
        return self.wire_id(resident.key.cell_id), resident.name.removeprefix(self.segment_prefix)

    def show_used(self, limit: int) -> None:
        """Bring hits and last use of at most ``limit`` segments in ``used`` up to date in the statistics."""
        for _ in range(min(limit, len(self.used))):
            resident = self.used.pop()
            if self.books.resident_named(resident.name) is resident:
                self._show(resident, "resident" if self.is_current(resident) else "stale")

    def is_current(self, resident: Resident) -> bool:
        """Whether a resident segment is the newest version of its cell."""
        index = self.index_of(resident.key.cell_id)
        return index is not None and self.layers.version(index, resident.key.layer) == resident.version

    def is_in_service(self, resident: Resident) -> bool:
        """Whether a segment is handed out to whoever asks for its cell."""
        return self.books.resident_named(resident.name) is resident and self.is_current(resident)

    # --- leaving --------------------------------------------------------------------------------

    def _chill(self, index: int) -> None:
        """What is resident of this cell is not its current version any more, nor are its heights.

        The same goes for its neighbours in layers that look into it.
        """
        self.heights.pop(index, None)
        self.layers.forget()
        for layer in list(self.warm.layers):
            for cell in (index, *self.layers.neighbours(index, layer)):
                self.warm.leave(cell, layer)

    def evict(self, resident: Resident, now_s: float, why: str = "request") -> bool:
        """Retire on request; True if nobody has it mapped."""
        return self.reclaimer.retire(resident, now_s, why)

    def hear_of_names(self, now_s: float) -> None:
        """Names vanished from the directory: what somebody else removed is handed out no more."""
        names = self.names.gone()
        residents = self.books.residents() if names is None else map(self.books.resident_named, names)
        for resident in [r for r in residents if r is not None and not self._directory.exists(r.name)]:
            _log.warning("%s of %s was removed by somebody else", resident.name, resident.key.cell_id)
            self.reclaimer.retire(resident, now_s, "damaged")

    def replace_catalogue(self, new: Catalogue, now_s: float) -> CatalogueChange:
        """Serve another state of the map; takes effect cell by cell as cells are asked for."""
        change = compare(self.catalogue, new)
        renumbered = bool(change.added or change.removed)
        if change:
            self._remember({*change.changed, *change.added, *change.moved}, change.removed)
        self.catalogue = new
        self.layers.forget()
        if renumbered:
            self._indices.clear()
            self.warm.clear()
            self.heights.clear()
            self.index_of_version.clear()
            for zombie in self.books.zombies.values():
                index = self.index_of(zombie.resident.key.cell_id)
                if index is not None:
                    self.index_of_version[zombie.resident.version] = index
        changed, gone, moved = set(change.changed), set(change.removed), set(change.moved)
        for index in [index for index in self.heights if new.id(index) in changed]:
            self._chill(index)
        for zombie in self.books.zombies.values():
            if zombie.resident.key.cell_id in moved:
                self.reclaimer.never_revive(zombie.resident.key)
        for resident in list(self.books.residents()):
            if resident.key.cell_id in gone:
                self.evict(resident, now_s, "map")
                continue
            index = self.index_of(resident.key.cell_id)
            if index is None or resident.key.cell_id in moved:
                self.evict(resident, now_s, "map")
                self.reclaimer.never_revive(resident.key)  # its header has the old box
                continue
            self.warm.leave(index, resident.key.layer)
            if not resident.checked and not self.is_current(resident):
                self.evict(resident, now_s, "map")
                continue
            self._enter(resident, index)
        for key in [key for key in self.books.slots if key.cell_id in gone]:
            self.books.cancel(key)
            self._on_settled(key)
        return change

    def _remember(self, changed: set[str], removed: tuple[str, ...]) -> None:
        self.history.append((self.catalogue.map_version, frozenset(changed), removed))

    def close(self, *, keep: bool = False) -> None:
        """End the workers and take every segment's name away, or leave the names to the next life."""
        self.loads.pool.close()
        if not keep:
            self.reclaimer.remove_all()
        self.reclaimer.close()
        self.names.close()
