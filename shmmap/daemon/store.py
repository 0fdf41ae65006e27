# SPDX-License-Identifier: Apache-2.0
"""The map in memory: finds cells, loads what is wanted, publishes, supersedes, evicts.

The store joins the pure books (`residency`) with what does the work: the catalogue, the loader
workers and the shared-memory directory.  It never blocks and knows nothing of sockets: whoever
waits for a key is told through ``on_settled``.
"""

from __future__ import annotations

import logging
import os
from collections import deque
from collections.abc import Callable
from typing import Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from shmmap.daemon import jobs
from shmmap.daemon.reclaim import Outcome, Reclaimer
from shmmap.daemon.residency import Failure, Key, Load, Residency, Resident, Slot
from shmmap.daemon.workers import Worker, WorkerPool
from shmmap.origin.catalogue import Catalogue, CatalogueChange, compare
from shmmap.origin.stamp import Stamp
from shmmap.protocol.codec import encode_handle
from shmmap.protocol.messages import Handle
from shmmap.segment.directory import ShmDirectory, is_full
from shmmap.segment.layout import PublishBlock
from shmmap.segment.names import new_segment_name, segment_prefix
from shmmap.statistics.layout import CellRow
from shmmap.statistics.writer import StatisticsWriter

__all__ = ["Store"]

_log = logging.getLogger(__name__)

FIRST_RETRY_S: Final = 1.0
LAST_RETRY_S: Final = 30.0
BUDGET_RETRY_S: Final = 0.1
START_ATTEMPTS: Final = 3
"""After this many loaders in a row that could not start, loads fail instead of waiting."""
SPACE_CODES: Final = frozenset({"over_budget", "no_space"})
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

    Attributes
    ----------
    history : deque
        For ``since``: map version before a change, ids that changed or appeared, ids that vanished.
    used : set
        Segments handed out since the statistics last showed them.
    warm : dict
        Per layer, catalogue index to resident segment of the cell's *current* version.
    versions : dict
        Per layer, (cells,) uint64: that version, 0 where the cell is not in memory.
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
    ) -> None:
        self.catalogue = catalogue
        self.books = residency
        self.reclaimer = reclaimer
        self.pool = pool
        self.warm: dict[str, dict[int, Resident]] = {}
        self.versions: dict[str, NDArray[np.uint64]] = {}
        self.id_prefix = id_prefix
        self.segment_prefix = segment_prefix(instance)
        self.heights: dict[int, tuple[float, float]] = {}
        self._directory = directory
        self._statistics = statistics
        self._instance = instance
        self._epoch = epoch
        self._mode = mode
        self._gid = gid
        self._on_settled = on_settled
        self._indices: dict[str, int] = {}
        self._jobs: dict[int, Load] = {}
        self._job_numbers = 0
        self._hungry: dict[int, tuple[Worker, int]] = {}
        self.index_of_version: dict[int, int] = {}
        self.used: set[Resident] = set()
        self.history: deque[tuple[int, frozenset[str], tuple[str, ...]]] = deque(maxlen=64)
        reclaimer.on_retired = self._leave
        reclaimer.on_freed = lambda resident: statistics.cell_removed(resident.name)

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
        resident = self.warm.setdefault(layer, {}).get(index)
        if resident is None and self.books.zombies:
            key = Key(self.catalogue.id(index), layer)
            resident = self.reclaimer.revive(key, self.catalogue.version(index), now_s)
            if resident is not None:
                self._enter(resident, index)
        return resident

    def want(self, index: int, layer: str, priority: float, now_s: float) -> Slot:
        """Make sure that a load of a cold cell is under way, unless it failed too recently."""
        key = Key(self.catalogue.id(index), layer)
        slot = self.books.slot(key)
        if (
            slot.load is None
            and slot.failure is not None
            and not self._worth_retrying(key, slot.failure, now_s)
        ):
            return slot
        self.books.want(key, self.estimate(index), priority)
        return slot

    def estimate(self, index: int) -> int:
        """Bytes to reserve before a load: a segment has its file's bytes, plus its header, at most.

        Only for compressed and ASCII files can it be more; their worker asks for it.
        """
        size = self.catalogue.stamp(index).size + _HEADER_ALLOWANCE_BYTES
        return -(-size // _PAGE_BYTES) * _PAGE_BYTES

    def _worth_retrying(self, key: Key, failure: Failure, now_s: float) -> bool:
        if now_s >= failure.retry_at_s:
            return True
        if failure.code in SPACE_CODES:
            return False
        try:
            state = os.stat(key.cell_id)
        except OSError:
            return False
        return (state.st_size, state.st_mtime_ns, state.st_ctime_ns) != failure.stamp

    def pump(self, now_s: float) -> None:
        """Free what is due, hand queued loads to workers as far as memory and workers allow."""
        if self.books.zombies and self.reclaimer.sweep(now_s):
            self.books.clear_failures(SPACE_CODES)
        self._feed_hungry(now_s)
        while self.pool.has_room:
            load = self.books.next_queued()
            if load is None:
                return
            index = self.index_of(load.key.cell_id)
            if index is None:
                self._abandon(load)
                continue
            shortage = self.books.shortage(load.estimate)
            if shortage > 0:
                if self._make_room(load, shortage, now_s):
                    continue
                return
            self.books.start(load, now_s)
            self._job_numbers += 1
            job = jobs.Job(
                self._job_numbers,
                load.key.cell_id,
                self.catalogue.path(index),
                load.key.layer,
                self.catalogue.box(index),
                self.catalogue.frame_id,
                load.estimate,
            )
            if not self.pool.submit(job, now_s):
                self.books.requeue(load)
                return
            self._jobs[job.number] = load
            self._statistics.add("loads_started")

    def _make_room(self, load: Load, shortage: int, now_s: float) -> bool:
        """Whether the load was given up (True) or room is on its way (False)."""
        if load.estimate + self.books.overhead_bytes > self.books.budget_bytes:
            message = f"the cell needs {load.estimate} bytes, the whole budget is {self.books.budget_bytes}"
            self._fail(load, "over_budget", message, None, now_s)
            return True
        if self.reclaimer.free(shortage, now_s) is Outcome.PENDING or self._may_give_back():
            return False
        message = f"{load.estimate} bytes do not fit: the budget of {self.books.budget_bytes} bytes is in use"
        self._fail(load, "over_budget", message, None, now_s)
        return True

    def _may_give_back(self) -> bool:
        """Whether a load runs that will end by itself: it may need less than is reserved for it.

        Loads that wait for room do not end by themselves, nor do those that come after them in the
        same loader's queue.
        """
        return any(worker.queue and next(iter(worker.queue)) not in self._hungry for worker in self.pool)

    def next_event_s(self) -> float:
        """When `pump` has something to do although nothing arrives; infinity for never."""
        return min(self.reclaimer.next_sweep_s(), self.reclaimer.wake_s, self.pool.next_deadline_s())

    # --- what workers say -----------------------------------------------------------------------

    def on_worker(self, worker: Worker, now_s: float) -> bool:
        """Handle one message of a worker; False when there is none left now."""
        try:
            received = self.pool.receive(worker)
        except EOFError:
            self._on_worker_end(worker, now_s)
            return False
        if received is None:
            return False
        message, fd = received
        if fd >= 0 and not isinstance(message, jobs.Segment):
            os.close(fd)
        if isinstance(message, jobs.Ready):
            worker.ready = True
            worker.head_since_s = now_s
            self.pool.failed_starts = 0
            return True
        if isinstance(message, jobs.Segment):
            if worker.segment_fd >= 0:
                os.close(worker.segment_fd)
            worker.segment_fd = fd
            return True
        if isinstance(message, jobs.Need):
            self._hungry[message.number] = (worker, message.bytes)
            self._feed_hungry(now_s)
            return True
        self.pool.finished(worker, message.number, now_s)
        self._hungry.pop(message.number, None)
        load = self._jobs.pop(message.number, None)
        fd, worker.segment_fd = worker.segment_fd, -1
        if isinstance(message, jobs.Failed):
            if fd >= 0:
                os.close(fd)
            if load is not None:
                self._fail(load, message.code, message.message, message.stamp, now_s)
        elif fd >= 0:
            try:
                if load is not None:
                    self._publish(load, message, fd, now_s)
            finally:
                os.close(fd)
        elif load is not None:  # this process had no descriptor left to receive it
            self._fail(load, "load_failed", "the finished segment did not arrive", None, now_s)
        return True

    def _feed_hungry(self, now_s: float) -> None:
        """Grant, hold or refuse the extra bytes that workers asked for."""
        for number, (worker, nbytes) in list(self._hungry.items()):
            load = self._jobs.get(number)
            if load is None:
                del self._hungry[number]
            elif self.books.grow(load, nbytes):
                del self._hungry[number]
                self.pool.answer(worker, jobs.Grant(number))
            else:
                shortage = self.books.shortage(nbytes - load.reserved)
                hopeless = nbytes + self.books.overhead_bytes > self.books.budget_bytes
                outcome = Outcome.IMPOSSIBLE if hopeless else self.reclaimer.free(shortage, now_s)
                if hopeless or (outcome is Outcome.IMPOSSIBLE and not self._may_give_back()):
                    del self._hungry[number]
                    self.pool.answer(worker, jobs.Refuse(number))

    def _on_worker_end(self, worker: Worker, now_s: float) -> None:
        unfinished, how = self.pool.remove(worker)
        self._statistics.add("worker_crashes")
        if not worker.ready:
            self.pool.failed_starts += 1
            _log.error("a loader could not start: %s", how)
        at_fault = worker.ready or self.pool.failed_starts >= START_ATTEMPTS
        for position, job in enumerate(unfinished):
            self._hungry.pop(job.number, None)
            load = self._jobs.pop(job.number, None)
            if load is None:
                continue
            if position == 0 and at_fault:
                _log.error("loader died while it read %s: %s", job.path, how)
                self._fail(load, "load_failed", f"{job.path}: the loader died of it ({how})", None, now_s)
            else:
                self.books.requeue(load)

    def end_overdue(self, now_s: float) -> None:
        """Kill workers whose load took too long; only the cell they worked on fails."""
        for worker in self.pool.overdue(now_s):
            if not worker.ready:
                self._on_worker_end(worker, now_s)
                continue
            number, job = next(iter(worker.queue.items()))
            load = self._jobs.pop(number, None)
            worker.queue.pop(number)
            unfinished, _how = self.pool.remove(worker)
            self._hungry.pop(number, None)
            self._statistics.add("loads_timed_out")
            _log.error("loading %s took too long, its loader was ended", job.path)
            if load is not None:
                self._fail(load, "load_timeout", f"{job.path}: loading took longer than allowed", None, now_s)
            for other in unfinished:
                self._hungry.pop(other.number, None)
                waiting = self._jobs.pop(other.number, None)
                if waiting is not None:
                    self.books.requeue(waiting)

    def _fail(
        self, load: Load, code: str, message: str, stamp: tuple[int, int, int] | None, now_s: float
    ) -> None:
        old = self.books.slot(load.key).failure
        if code in SPACE_CODES:
            delay_s = BUDGET_RETRY_S
            self._statistics.add("refused_over_budget")
        else:
            delay_s = min(2 * old.delay_s, LAST_RETRY_S) if old and old.code == code else FIRST_RETRY_S
            self._statistics.add("loads_failed")
            _log.warning("cannot load %s: %s: %s", load.key.cell_id, code, message)
        failure = Failure(code, message, stamp, now_s + delay_s, delay_s)
        # of a cell that left the map meanwhile nothing is remembered
        self.books.failed(load, failure if self.index_of(load.key.cell_id) is not None else None)
        self._on_settled(load.key)

    def _abandon(self, load: Load) -> None:
        """The cell left the map: nobody asks for this any more, so no failure is remembered."""
        self.books.failed(load, None)
        self._on_settled(load.key)

    # --- publishing -----------------------------------------------------------------------------

    def _publish(self, load: Load, done: jobs.Done, fd: int, now_s: float) -> None:
        index = self.index_of(load.key.cell_id)
        if index is None:
            self._statistics.add("loads_failed")
            self._abandon(load)
            return
        stamp, known = Stamp(*done.stamp), self.catalogue.stamp(index)
        if stamp != known:
            if self._lies_on_disk(index, known):
                self.books.requeue(load)  # it read what a reload has already found replaced
                return
            self._remember({load.key.cell_id}, ())
            self.catalogue.set_stamp(index, stamp)
            self._chill(index)
        version = self.catalogue.version(index)
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
            self._fail(load, code, f"cannot publish: {error.strerror}", None, now_s)
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
        self._enter(resident, index)
        self._statistics.add("loads_finished")
        self._statistics.add("bytes_loaded", nbytes)
        for warning in done.warnings:
            _log.info("%s: %s", load.key.cell_id, warning)
        if done.dropped:
            _log.info("%s: %d points left out, not finite", load.key.cell_id, done.dropped)
        self._on_settled(load.key)

    def _lies_on_disk(self, index: int, stamp: Stamp) -> bool:
        try:
            return Stamp.of(os.stat(self.catalogue.path(index))) == stamp
        except OSError:
            return False

    def _enter(self, resident: Resident, index: int) -> None:
        """A resident can be handed out: encode its handle, find it by index if it is current."""
        self._encode(resident)
        if resident.version == self.catalogue.version(index):
            self.warm.setdefault(resident.key.layer, {})[index] = resident
            versions = self.versions.get(resident.key.layer)
            if versions is None:
                versions = self.versions[resident.key.layer] = np.zeros(len(self.catalogue), np.uint64)
            versions[index] = resident.version
            self.heights[index] = (resident.z_min, resident.z_max)
        self.index_of_version[resident.version] = index
        self._indices[self.wire_id(resident.key.cell_id)] = index
        self._show(resident, "resident" if resident.version == self.catalogue.version(index) else "stale")

    def _leave(self, resident: Resident) -> None:
        """A resident was retired: nobody finds it any more, its bytes still show."""
        self.used.discard(resident)
        index = self.index_of(resident.key.cell_id)
        warm = self.warm.get(resident.key.layer, {})
        if index is not None and warm.get(index) is resident:
            del warm[index]
            self.versions[resident.key.layer][index] = 0
        self._show(resident, "zombie")

    def _encode(self, resident: Resident) -> None:
        handle = Handle(
            self.wire_id(resident.key.cell_id),
            resident.version,
            resident.key.layer,
            resident.name.removeprefix(self.segment_prefix),
            0,
            resident.nbytes,
            resident.points,
            *resident.box,
        )
        resident.handle = encode_handle(handle)
        resident.stale_handle = encode_handle(msgspec.structs.replace(handle, stale=True))

    def _show(self, resident: Resident, state: str = "resident") -> None:
        self._statistics.cell_changed(
            resident.name,
            CellRow(
                id=self.wire_id(resident.key.cell_id),
                layer=resident.key.layer,
                version=resident.version,
                segment=resident.name.removeprefix(self.segment_prefix),
                state=state,
                bytes=resident.nbytes,
                points=resident.points,
                box=resident.box,
                hits=resident.hits,
                last_use_monotonic_ns=int(resident.last_use_s * 1e9),
                load_ns=resident.load_ns,
            ),
        )

    def show_used(self, limit: int) -> None:
        """Bring hits and last use of at most ``limit`` segments in ``used`` up to date in the statistics."""
        for _ in range(min(limit, len(self.used))):
            resident = self.used.pop()
            if self.books.resident_named(resident.name) is resident:
                self._show(resident, "resident" if self.is_current(resident) else "stale")

    def is_current(self, resident: Resident) -> bool:
        """Whether a resident segment is the newest version of its cell."""
        index = self.index_of(resident.key.cell_id)
        return index is not None and self.catalogue.version(index) == resident.version

    # --- leaving --------------------------------------------------------------------------------

    def _chill(self, index: int) -> None:
        """What is resident of this cell is not its current version any more, nor are its heights."""
        self.heights.pop(index, None)
        for layer, warm in self.warm.items():
            if warm.pop(index, None) is not None:
                self.versions[layer][index] = 0

    def evict(self, resident: Resident, now_s: float) -> bool:
        """Retire on request; True if nobody has it mapped."""
        return self.reclaimer.retire(resident, now_s)

    def replace_catalogue(self, new: Catalogue, now_s: float) -> CatalogueChange:
        """Serve another state of the map; takes effect cell by cell as cells are asked for."""
        change = compare(self.catalogue, new)
        renumbered = bool(change.added or change.removed)
        if change:
            self._remember({*change.changed, *change.added, *change.moved}, change.removed)
        self.catalogue = new
        if renumbered:
            self._indices.clear()
            self.warm.clear()
            self.versions.clear()
            self.heights.clear()
            self.index_of_version.clear()
            for zombie in self.books.zombies.values():
                index = self.index_of(zombie.resident.key.cell_id)
                if index is not None:
                    self.index_of_version[zombie.resident.version] = index
        changed = set(change.changed)
        for index in [index for index in self.heights if new.id(index) in changed]:
            self._chill(index)
        gone = set(change.removed)
        moved = set(change.moved)
        for zombie in self.books.zombies.values():
            if zombie.resident.key.cell_id in moved:
                self.reclaimer.never_revive(zombie.resident.key)
        for resident in list(self.books.residents()):
            if resident.key.cell_id in gone:
                self.evict(resident, now_s)
                continue
            index = self.index_of(resident.key.cell_id)
            if index is None or resident.key.cell_id in moved:
                self.evict(resident, now_s)
                self.reclaimer.never_revive(resident.key)  # its header has the old box
                continue
            self._chill(index)
            self._enter(resident, index)
        for key in [key for key in self.books.slots if key.cell_id in gone]:
            self.books.cancel(key)
            self._on_settled(key)
        return change

    def _remember(self, changed: set[str], removed: tuple[str, ...]) -> None:
        self.history.append((self.catalogue.map_version, frozenset(changed), removed))

    def close(self) -> None:
        """End the workers and take every segment's name away."""
        self.pool.close()
        self.reclaimer.remove_all()
