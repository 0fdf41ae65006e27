# SPDX-License-Identifier: Apache-2.0
"""The map in memory: finds cells, publishes, supersedes, adopts, evicts.

The cache joins the pure ledger with what does the work: the catalogue, the index of warm cells and the
shared-memory directory.  It never blocks, and knows neither loaders nor sockets: what is absent is asked
of `shmmap.daemon.loading.scheduler`, which publishes here.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from itertools import islice
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap.daemon.cache.cell_rows import CellRows
from shmmap.daemon.cache.evictor import Evictor
from shmmap.daemon.cache.holders import Holders
from shmmap.daemon.cache.segment_name_watch import LostSegments, SegmentNameWatch
from shmmap.daemon.cache.survey import Survey
from shmmap.daemon.cache.warm_index import Heights, WarmIndex
from shmmap.daemon.events.cell_events import CellEvents
from shmmap.daemon.events.log import EventLog, PressureEvents
from shmmap.daemon.map.catalogue_view import CatalogueView
from shmmap.daemon.records import Key, Resident
from shmmap.failpoints import step
from shmmap.large_tables import ShardedDict
from shmmap.layers.points import LAYER
from shmmap.layers.spec import layer_spec
from shmmap.layers.versions import LayerVersions
from shmmap.logfmt import log
from shmmap.segment.header import PublishBlock
from shmmap.segment.names import new_segment_name, segment_prefix
from shmmap.statistics.writer import StatisticsWriter

__all__ = ["CellCache"]

_PAGE_BYTES: Final = 4096
_HEADER_ALLOWANCE_BYTES: Final = 2 * _PAGE_BYTES
LOOKS_FOR_NAMES: Final = 64
"""Names looked for per turn of the serving loop: a tenth of a millisecond."""


class CellCache:
    """All cells of one map that are in memory.

    Parameters
    ----------
    instance
        Part of every segment's name.
    mode, gid
        Access of published segments; ``gid`` -1 leaves the group alone.
    event_log
        Told what happens to cells.

    Attributes
    ----------
    events, rows
        Tells what happens to cells; shows segments to operators.
    used : set
        Segments handed out since the statistics last showed them.
    holders, survey
        Who maps a segment; who maps how much in all.
    warm
        The cells that are in memory at their current version.
    heights
        Of cells that were loaded since they changed.
    lost
        Counts segments that other programs removed or cut short.
    unentered : int
        How many segments are still to be looked for in the state of the map that is served now.
    """

    def __init__(
        self,
        catalogue: CatalogueView,
        evictor: Evictor,
        statistics: StatisticsWriter,
        event_log: EventLog,
        *,
        instance: str,
        mode: int,
        gid: int,
    ) -> None:
        self.catalogue = catalogue
        self.evictor = evictor
        self.reclaimer = reclaimer = evictor.reclaimer
        self.ledger = reclaimer.ledger
        self.directory = reclaimer.directory
        self.layers = LayerVersions(lambda: self.catalogue)
        self.holders = Holders(reclaimer)
        self.survey = Survey(self.ledger, self.holders, in_service=self.is_in_service)
        self.warm = WarmIndex()
        self.id_prefix = catalogue.id_prefix
        self.segment_prefix = segment_prefix(instance)
        self.heights = Heights(len(catalogue))
        self.unentered = 0
        self.names = SegmentNameWatch(self.directory.path, self.segment_prefix)
        self.lost = LostSegments()
        pressure = PressureEvents(event_log, self._memory, reclaimer.sessions.largest_holder)
        self.events = CellEvents(event_log, statistics, self.wire_id, pressure)
        self.rows = CellRows(statistics, self.id_prefix, self.segment_prefix)
        self.used: set[Resident] = set()
        self.statistics = statistics
        self.instance = instance
        self.epoch = event_log.epoch
        self.mode = mode
        self.gid = gid
        self._unsure: Iterator[Resident] = iter(())
        self._untold: deque[tuple[Callable[..., None], tuple[Any, ...]]] = deque()
        reclaimer.on_retired = self._on_retired
        reclaimer.on_gone = lambda name: self.tell(self.rows.hide, name)

    # --- names --------------------------------------------------------------------------------

    def index_of(self, cell: str) -> int | None:
        """Catalogue index of an id: whole, without the prefix, or a unique base name."""
        index = self.catalogue.find(cell)
        if index is None and not cell.startswith("/"):
            index = self.catalogue.find(self.id_prefix + cell)
        return index

    def wire_id(self, cell_id: str) -> str:
        """An id as replies carry it: without the prefix, whole where it does not start with it."""
        return cell_id[len(self.id_prefix) :] if cell_id.startswith(self.id_prefix) else cell_id

    # --- finding --------------------------------------------------------------------------------

    def find_warm(self, index: int, layer: str, now_s: float) -> Resident | None:
        """The current version of a cell, if it is in memory (retired ones are put back in service)."""
        resident = self.warm.get(index, layer)
        if resident is None and self.unentered:
            resident = self.ledger.by_key.get(Key(self.catalogue.id(index), layer))
            if resident is not None and not self.enter_if_current(resident, index):
                resident = None
        if resident is None and self.ledger.retired:
            key = Key(self.catalogue.id(index), layer)
            if self.reclaimer.may_revive(key):
                resident = self.reclaimer.revive(key, self.layers.version(index, layer), now_s)
            if resident is not None:
                self.enter(resident, index)
                self.tell(self.events.revived, resident)
        return resident

    def at_height(self, indices: list[int], z: tuple[float, float] | None) -> list[int]:
        """Leave out cells whose heights, known once they were loaded, lie outside the range."""
        if z is None:
            return indices
        return self.heights.overlapping(indices, z)

    def estimate(self, index: int, layer: str) -> int:
        """Bytes to reserve before a load: what the origin says, or else a guess.

        `points` has its file's bytes, plus its header, at most.  Only for compressed and ASCII files can it
        be more; their worker asks for it, as does that of a computed layer.
        """
        ready = self.catalogue.ready(index, layer)
        if ready is not None:
            size = ready.nbytes
        else:
            share = 1.0 if layer == LAYER else layer_spec(layer).kind.bytes_ratio
            size = int(self.catalogue.source_bytes(index) * share) + _HEADER_ALLOWANCE_BYTES
        return -(-size // _PAGE_BYTES) * _PAGE_BYTES

    def is_current(self, resident: Resident) -> bool:
        """Whether a resident segment is the newest version of its cell."""
        index = self.index_of(resident.key.cell_id)
        return index is not None and self.layers.version(index, resident.key.layer) == resident.version

    def is_in_service(self, resident: Resident) -> bool:
        """Whether a segment is handed out to whoever asks for its cell."""
        return self.ledger.resident_named(resident.name) is resident and self.is_current(resident)

    # --- coming ---------------------------------------------------------------------------------

    def publish(self, fd: int, header_bytes: int, resident: Resident, index: int, now_s: float) -> int:
        """Name a finished segment and hand it out from now on; returns the version it supersedes, 0 for none.

        ``resident`` describes it; its name and bytes are known once it is published.

        Raises
        ------
        OSError
            It cannot be published, for lack of memory, say.
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
        self.enter(resident, index)
        return old.version if old is not None else 0

    def adopt(self, resident: Resident, index: int) -> None:
        """Take a segment of an earlier life; it is handed out once a loader has checked it."""
        self.ledger.enter(resident)
        self.enter(resident, index)
        self.statistics.add("adopted")

    def accept(self, resident: Resident) -> bool:
        """Hand out an adopted segment from now on; False if it has left service meanwhile."""
        index = self.index_of(resident.key.cell_id)
        if index is None or self.ledger.resident_named(resident.name) is not resident:
            return False
        step("daemon.accept")
        self.ledger.checked(resident)
        self.enter(resident, index)
        return True

    def reject(self, resident: Resident, why: str, now_s: float) -> None:
        """Take an adopted segment that is not what it should be out of service, if it still is in it."""
        if self.ledger.resident_named(resident.name) is resident:
            self.statistics.add("adoptions_failed")
            log.warning("segment of an earlier daemon not used", segment=resident.name, reason=why)
            self.reclaimer.retire(resident, now_s, "damaged")

    def enter(self, resident: Resident, index: int) -> None:
        """A resident can be handed out: encode its handle, find it by index if it is current.

        One that is not checked yet only shows: who holds its version need not be sent it again.
        """
        self.warm.note_version(resident)
        current = True
        if resident.checked:
            segment = resident.name.removeprefix(self.segment_prefix)
            self.warm.encode(resident, self.wire_id(resident.key.cell_id), segment)
            current = self.enter_if_current(resident, index)
        self.tell(self.rows.show, resident, "resident" if current else "stale")

    def enter_if_current(self, resident: Resident, index: int) -> bool:
        """Whether a segment is of its cell's current version; then it is found by index from now on."""
        if not resident.checked or resident.version != self.layers.version(index, resident.key.layer):
            return False
        self.warm.enter(resident, index, len(self.catalogue))
        self.heights.learn(index, resident.z_min, resident.z_max)
        return True

    def serve(self, new: CatalogueView, changed: NDArray[np.intp] | None) -> list[ShardedDict[int, Any]]:
        """Serve another state of the map.

        Nothing is warm in it before `find_warm` or `MapSwitch.run_step` has found it in the ledger.

        Parameters
        ----------
        changed
            Indices of cells that have changed; None where indices mean other cells.

        Returns
        -------
        list
            Tables that are not used any more; to free many entries at once takes long.
        """
        left: list[ShardedDict[int, Any]] = [*self.warm.layers.values(), *self.layers.forget()]
        self.catalogue = new
        self.warm = self.warm.successor()
        if changed is None:
            self.heights = Heights(len(new))
        else:
            self.heights.forget(changed)
        return left

    # --- telling --------------------------------------------------------------------------------

    def tell(self, how: Callable[..., None], *what: Any) -> None:
        """Have listeners told of something once nobody waits for the loop, see `tell_all`."""
        self._untold.append((how, what))

    def tell_all(self) -> None:
        """Tell what happened since the last time, in that order."""
        while self.tell_next():
            pass

    def tell_next(self) -> bool:
        """Tell the first thing that happened and was not told yet; False if there is none."""
        if not self._untold:
            return False
        how, what = self._untold.popleft()
        how(*what)
        return True

    @property
    def untold(self) -> bool:
        """Whether something is to be told."""
        return bool(self._untold)

    def _memory(self) -> tuple[int, int, int, int]:
        """Budget, used, pinned and retired bytes."""
        ledger, pinned = self.ledger, self.statistics.values["bytes_pinned"]
        return ledger.budget_bytes, ledger.used_bytes, pinned, ledger.retired_bytes

    # --- leaving --------------------------------------------------------------------------------

    def chill(self, index: int) -> None:
        """What is resident of this cell is not its current version any more, nor are its heights.

        The same goes for its neighbours in layers that look into it.
        """
        self.heights.forget(np.array([index]))
        self.layers.cell_changed(index)
        for layer, cells in self.layers.dependents(index, list(self.warm.layers)):
            for cell in cells:
                self.warm.leave(cell, layer)

    def _on_retired(self, resident: Resident, why: str) -> None:
        """Nobody finds it any more; its bytes still show."""
        self.tell(self.events.retired, resident, why)
        self.used.discard(resident)
        self.statistics.add("prefetch_in_vain", resident.prefetched)
        self.warm.note_retired(resident)
        index = self.index_of(resident.key.cell_id)
        if index is not None and self.warm.get(index, resident.key.layer) is resident:
            self.warm.leave(index, resident.key.layer)
        self.tell(self.rows.show, resident, "zombie")

    def names_vanished(self, now_s: float) -> bool:
        """Retire segments whose names others removed; True if that released memory."""
        names = self.names.gone()
        if names is None:
            self._unsure = self.ledger.segments.walk()
            return False
        return self._retire_lost(names, now_s)

    def look_for_some(self, now_s: float) -> bool:
        """Look for a few segments, after more names vanished than the kernel reported."""
        return self._retire_lost([one.name for one in islice(self._unsure, LOOKS_FOR_NAMES)], now_s)

    def _retire_lost(self, names: Iterable[str], now_s: float) -> bool:
        residents = map(self.ledger.resident_named, names)
        return sum(self.retire_if_lost(one, now_s) for one in residents if one is not None) > 0

    def retire_if_lost(self, resident: Resident, now_s: float) -> bool:
        """Retire a segment that others removed or cut short, so that its cell is loaded again."""
        size = self.directory.size_of(resident.name)
        if size >= resident.nbytes:
            return False
        self.lost.add(resident, removed=size < 0, now_s=now_s)
        self.reclaimer.retire(resident, now_s, "damaged")
        self.reclaimer.never_revive(resident.key)
        return True

    def close(self, *, keep: bool = False) -> None:
        """Take every segment's name away, or leave the names to the next life."""
        if not keep:
            self.reclaimer.remove_all()
        self.reclaimer.close()
        self.names.close()
