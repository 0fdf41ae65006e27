# SPDX-License-Identifier: Apache-2.0
"""The map in memory: finds, publishes, supersedes, adopts and evicts cells.

The cache joins the ledger, which does no I/O, with the catalogue, the index of warm cells and the
shared-memory directory.  It never blocks, and uses neither loaders nor sockets: absent cells are requested
from `shmmap.daemon.loading.scheduler`, which publishes here.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, Final

import numpy as np

from shmmap.daemon.cache.evictor import Evictor
from shmmap.daemon.cache.holders import Holders, Survey
from shmmap.daemon.cache.ledger import Ledger
from shmmap.daemon.cache.lost_segments import LostSegments
from shmmap.daemon.cache.reclaimer import Reclaimer
from shmmap.daemon.cache.warm_index import Heights, WarmIndex
from shmmap.daemon.events.cell_events import CellEvents, PressureEvents
from shmmap.daemon.events.log import EventLog
from shmmap.daemon.map.catalogue_view import CatalogueView, Pages
from shmmap.daemon.pins.watch import PinWatch
from shmmap.daemon.records import Absent, Key, Resident
from shmmap.daemon.transport.sessions import Session, Sessions
from shmmap.failpoints import step
from shmmap.geometry import Area
from shmmap.large_tables import ShardedDict
from shmmap.layers.points import LAYER
from shmmap.layers.spec import layer_spec
from shmmap.layers.versions import LayerVersions
from shmmap.logfmt import log
from shmmap.origin.catalogue import CatalogueChange
from shmmap.segment.directory import ShmDirectory
from shmmap.segment.header import PublishBlock
from shmmap.segment.names import new_segment_name, segment_prefix
from shmmap.statistics.writer import StatisticsWriter

_PAGE_BYTES: Final = 4096
_HEADER_ALLOWANCE_BYTES: Final = 2 * _PAGE_BYTES
CHECKED_PER_TURN: Final = 16
"""Handed-out segments that are checked in one turn: 0.1 ms."""


class CellCache:
    """All cells of one map that are in memory.

    Parameters
    ----------
    instance
        Part of every segment's name.
    mode, gid
        Access of published segments; ``gid`` -1 leaves the group alone.

    Attributes
    ----------
    catalogue
        The state of the map that is served; replaced by a reload.
    layers
        Versions of the layers of its cells.
    evictor, reclaimer
        Make room; give memory back.
    holders, survey
        Find the processes that map a segment, and how much each process maps in total.
    events
        Reports what happens to cells.
    warm
        Cells in memory at their current version.
    heights
        Heights of the cells that were loaded since they last changed.
    lost
        Finds segments that other programs removed or truncated.
    unentered : int
        Number of segments not yet checked against the state of the map that is served now.
    """

    def __init__(
        self,
        catalogue: CatalogueView,
        ledger: Ledger,
        directory: ShmDirectory,
        sessions: Sessions,
        pins: PinWatch,
        statistics: StatisticsWriter,
        event_log: EventLog,
        *,
        instance: str,
        mode: int,
        gid: int,
    ) -> None:
        self.catalogue = catalogue
        self.ledger = ledger
        self.directory = directory
        self.sessions = sessions
        self.statistics = statistics
        self.instance = instance
        self.epoch = event_log.epoch
        self.mode = mode
        self.gid = gid
        self.id_prefix = catalogue.id_prefix
        self.segment_prefix = segment_prefix(instance)
        self.layers = LayerVersions(lambda: self.catalogue)
        self.reclaimer = Reclaimer(ledger, directory, sessions, pins, self)
        self.evictor = Evictor(self.reclaimer)
        self.holders = Holders(self.reclaimer)
        self.survey = Survey(self.holders, in_service=self.is_in_service)
        self.lost = LostSegments(self.reclaimer, self.segment_prefix)
        self.events = CellEvents(
            event_log,
            statistics,
            PressureEvents(event_log, self._memory, sessions.largest_holder),
            id_prefix=self.id_prefix,
        )
        self.warm = WarmIndex()
        self.heights = Heights(len(catalogue))
        self.unentered = 0
        self._used: set[Resident] = set()  # handed out since they were last checked

    # --- the map --------------------------------------------------------------------------------

    def index_of(self, cell: str) -> int | None:
        """Return the catalogue index of an id: complete, without the prefix, or a unique base name."""
        index = self.catalogue.find(cell)
        if index is None and not cell.startswith("/"):
            index = self.catalogue.find(self.id_prefix + cell)
        return index

    def wire_id(self, cell_id: str) -> str:
        """Return an id as replies carry it: without the prefix, or unchanged if it has none."""
        return cell_id.removeprefix(self.id_prefix)

    def key(self, index: int, layer: str) -> Key:
        """Return the key of a layer of a cell."""
        return Key(self.catalogue.id(index), layer)

    @property
    def pages(self) -> Pages | None:
        """Pages of the list of cells; None if the list is complete."""
        return self.catalogue.pages

    def pages_around(self, area: Area, layers: Iterable[str]) -> Sequence[int]:
        """Return the pages that list an area's cells and the neighbouring cells that these layers read."""
        pages = self.pages
        if pages is None:
            return ()
        return pages.of_area(area.around(*area.center, self.layers.halo_m(layers)))

    def estimate(self, index: int, layer: str) -> int:
        """Return the bytes to reserve before a load: the origin's number, or else an estimate.

        `points` takes at most its file's size plus the header.  Only compressed and ASCII files can need
        more; then the worker asks for it, and so does the worker of a computed layer.
        """
        ready = self.catalogue.ready(index, layer)
        if ready is not None:
            size = ready.nbytes
        else:
            share = 1.0 if layer == LAYER else layer_spec(layer).kind.bytes_ratio
            size = int(self.catalogue.source_bytes(index) * share) + _HEADER_ALLOWANCE_BYTES
        return -(-size // _PAGE_BYTES) * _PAGE_BYTES

    def absent(self, index: int, layer: str) -> Absent:
        """Return what a load of a layer of a cell begins with."""
        return Absent(index, self.key(index, layer), self.estimate(index, layer))

    # --- finding --------------------------------------------------------------------------------

    def find_warm(self, index: int, layer: str, now_s: float) -> Resident | None:
        """Return the current version of a cell if it is in memory; a retired one returns to service."""
        resident = self.warm.get(index, layer)
        if resident is None and self.unentered:
            resident = self.ledger.by_key.get(self.key(index, layer))
            if resident is not None and not self.enter_if_current(resident, index):
                resident = None
        if resident is None and self.ledger.retired:
            key = self.key(index, layer)
            if self.reclaimer.retired_of(key) is not None:
                resident = self.reclaimer.revive(key, self.layers.version(index, layer), now_s)
            if resident is not None:
                self._enter(resident, index)
                self.events.emit(self.events.revived, resident)
        return resident

    def is_current(self, resident: Resident) -> bool:
        """Whether a resident segment is the newest version of its cell."""
        index = self.index_of(resident.key.cell_id)
        return index is not None and self.layers.version(index, resident.key.layer) == resident.version

    def is_in_service(self, resident: Resident) -> bool:
        """Whether requests for a segment's cell are answered with this segment."""
        return self.ledger.resident_named(resident.name) is resident and self.is_current(resident)

    def resident(self, key: Key) -> Resident | None:
        """Return the segment of a key that can be handed out, whether current or not."""
        resident = self.ledger.by_key.get(key)
        return resident if resident is not None and resident.checked else None

    def replaced_bytes(self, session: Session, key: Key) -> int:
        """Return the bytes of an old version that a session holds and will drop for the new one."""
        for known in (self.ledger.by_key.get(key), self.reclaimer.retired_of(key)):
            if known is not None and session.slot in known.sessions and not self.is_current(known):
                return known.nbytes
        return 0

    # --- coming ---------------------------------------------------------------------------------

    def publish(self, fd: int, header_bytes: int, resident: Resident, index: int, now_s: float) -> int:
        """Name a finished segment and hand it out from now on; return the version it supersedes, or 0.

        ``resident`` describes it; its name and bytes are set here.

        Raises
        ------
        OSError
            The segment cannot be published, for example for lack of memory.
        """
        resident.name = new_segment_name(self.instance)
        block = PublishBlock(self.epoch, resident.version)
        resident.nbytes = self.directory.publish(
            fd, resident.name, block=block, header_bytes=header_bytes, mode=self.mode, gid=self.gid
        )
        old = self.ledger.enter(resident)
        if old is not None:
            self.reclaimer.superseded(old, now_s)
        step("daemon.catalogue")
        self._enter(resident, index)
        return old.version if old is not None else 0

    def adopt(self, resident: Resident, index: int) -> None:
        """Take over a segment of a previous run; it is handed out once a loader has checked it."""
        self.ledger.enter(resident)
        self._enter(resident, index)
        self.statistics.add("adopted")

    def accept(self, resident: Resident) -> bool:
        """Hand out an adopted segment from now on; return False if it has left service in the meantime."""
        index = self.index_of(resident.key.cell_id)
        if index is None or self.ledger.resident_named(resident.name) is not resident:
            return False
        step("daemon.accept")
        self.ledger.checked(resident)
        self._enter(resident, index)
        return True

    def reject(self, resident: Resident, why: str, now_s: float) -> None:
        """Take an adopted segment that failed its check out of service, if it is still in service."""
        if self.ledger.resident_named(resident.name) is resident:
            self.statistics.add("adoptions_failed")
            log.warning("leftover segment rejected", segment=resident.name, reason=why)
            self.reclaimer.retire(resident, now_s, "damaged")

    def _enter(self, resident: Resident, index: int) -> None:
        """Encode a segment's handle, and index the segment if it is current.

        An unchecked segment is only listed: a client that holds its version does not have to get it again.
        """
        self.warm.note_version(resident)
        if resident.checked:
            segment = resident.name.removeprefix(self.segment_prefix)
            self.warm.encode(resident, self.wire_id(resident.key.cell_id), segment)
            self.enter_if_current(resident, index)

    def enter_if_current(self, resident: Resident, index: int) -> bool:
        """Index a segment if it has its cell's current version; return whether it has."""
        if not resident.checked or resident.version != self.layers.version(index, resident.key.layer):
            return False
        self.warm.enter(resident, index, len(self.catalogue))
        self.heights.learn(index, resident.z_min, resident.z_max)
        return True

    def serve(self, new: CatalogueView, change: CatalogueChange) -> list[ShardedDict[int, Any] | object]:
        """Serve another state of the map, of which any number of cells may have changed.

        No cell is warm in the new state until `find_warm` or `MapSwitch.run_step` has found it in the ledger.
        Returned are the tables that are not used any more: freeing them takes long.
        """
        left = [self.heights, *self.warm.tables.values(), *self.warm.layers.values(), *self.layers.forget()]
        self.catalogue = new
        self.warm = self.warm.successor()
        if change.same_numbers:
            self.heights.forget(change.touched)
        else:
            self.heights = Heights(len(new))
        return left

    def serve_with_few_changes(self, new: CatalogueView, change: CatalogueChange) -> list[Resident]:
        """Serve another state of the map, whose cells have the same numbers and of which few have changed.

        All others stay warm.  Returned are the segments of the changed cells, for `MapSwitch.run_step`.
        """
        for index in change.touched.tolist():
            self.invalidate(index)
        self.catalogue = new
        for index in change.moved.tolist():
            self.invalidate(index)  # the cells around its new place
        ids = map(new.id, change.touched.tolist())
        return [resident for cell_id in ids for resident in self.ledger.of_cell(cell_id)]

    # --- being used -----------------------------------------------------------------------------

    def hand_out(self, residents: Sequence[Resident], now_s: float) -> None:
        """Note that segments are handed out: each is spared from eviction for as long as opening it takes."""
        first_used = 0
        for resident in residents:
            resident.last_use_s = now_s
            if not resident.hits:
                first_used += resident.nbytes
                if resident.prefetched:
                    self.ledger.asked_for(resident)
                    self.statistics.add("prefetch_used")
            resident.hits += 1
            resident.spare = False
        self.statistics.add("bytes_used", first_used)
        self._used.update(residents)

    def check_used(self, now_s: float) -> bool:
        """Check some of the segments that were handed out; return whether more are left.

        A segment that another program truncated is retired: clients cannot read it, and its cell is loaded
        again.
        """
        for _ in range(min(CHECKED_PER_TURN, len(self._used))):
            self.lost.retire_if_lost(self._used.pop(), now_s)
        return bool(self._used)

    def report(self, now_s: float) -> None:
        """Publish and log periodic reports, a few times a second."""
        self.events.step(now_s)
        self.lost.report(now_s)

    def measure(self) -> None:
        """Update the gauges of memory and of the map."""
        ledger, statistics, pages = self.ledger, self.statistics, self.pages
        ledger.overhead_bytes = statistics.size_bytes
        found = ledger.unchecked_count + len(self.warm) + self.unentered
        for name, value in (
            ("cells_resident", ledger.resident_count),
            ("stale_cells", max(0, ledger.resident_count - found)),
            ("bytes_resident", ledger.resident_bytes),
            ("zombies", len(ledger.retired)),
            ("bytes_zombie", ledger.retired_bytes),
            ("bytes_pinned", self.survey.usage.nbytes),
            ("segments_pinned", self.survey.usage.count),
            ("bytes_reserved", ledger.reserved_bytes),
            ("bytes_statistics", statistics.size_bytes),
            ("bytes_prefetched", ledger.prefetched_bytes),
            ("budget_bytes", ledger.budget_bytes),
            ("evictions", self.evictor.evicted_count),
            ("map_cells", len(self.catalogue)),
            ("map_cells_known", len(self.catalogue) if pages is None else pages.known_cells),
            ("map_pages", 0 if pages is None else len(pages)),
            ("map_pages_known", 0 if pages is None else pages.known_pages),
        ):
            statistics.set(name, value)

    def _memory(self) -> tuple[int, int, int, int]:
        """Return budget, used, pinned and retired bytes."""
        ledger, pinned = self.ledger, self.statistics.values["bytes_pinned"]
        return ledger.budget_bytes, ledger.used_bytes, pinned, ledger.retired_bytes

    # --- leaving --------------------------------------------------------------------------------

    def invalidate(self, index: int) -> None:
        """Note that a cell has changed: its segments are not current, and its heights are unknown.

        The same applies to its neighbours in layers that read this cell.
        """
        self.heights.forget(np.array([index]))
        self.layers.cell_changed(index)
        for layer, cells in self.layers.dependents(index, list(self.warm.layers)):
            for cell in cells:
                self.warm.leave(cell, layer)

    def segment_retired(self, resident: Resident, why: str) -> None:
        """Remove a segment from the indices; its bytes still count."""
        self.events.emit(self.events.retired, resident, why)
        self._used.discard(resident)
        self.statistics.add("prefetch_in_vain", resident.prefetched)
        self.warm.note_retired(resident)
        index = self.index_of(resident.key.cell_id)
        if index is not None and self.warm.get(index, resident.key.layer) is resident:
            self.warm.leave(index, resident.key.layer)

    def reclaim(self, now_s: float) -> bool:
        """Free some retired segments that are due, check for lost ones; return whether more may fit now."""
        freed = bool(self.reclaimer.due) and self.reclaimer.sweep(now_s) > 0
        return (not self.lost.to_check.is_done and self.lost.check_some(now_s)) or freed

    def next_reclaim_s(self) -> float:
        """Return when `reclaim` or an eviction is worth another try although nothing has changed."""
        return min(self.reclaimer.next_sweep_s(), self.evictor.wake_s)

    def close(self, *, keep: bool = False) -> None:
        """Remove every segment's name, or with ``keep`` leave the names to the next run."""
        if not keep:
            self.reclaimer.remove_all()
        self.reclaimer.close()
        self.lost.close()
