# SPDX-License-Identifier: Apache-2.0
"""Runs loads from the queue to their end: frees memory, gives jobs to workers, handles their messages.

However a load ends, only its own cell is affected: a worker that dies or takes too long is replaced, and the
jobs queued after the one that it died of return to the queue.  Only workers read files: reading may take
long.
"""

from __future__ import annotations

import math
import os
from collections import deque
from collections.abc import Callable, Hashable, Iterator
from itertools import islice
from typing import Final

from shmmap.daemon.cache.cell_cache import CellCache
from shmmap.daemon.cache.map_switch import MapSwitch
from shmmap.daemon.loading.link import Link
from shmmap.daemon.loading.loads import (
    COMPUTED,
    FETCHED,
    Attempt,
    FailedFileCheck,
    LeftoverCheck,
    Load,
    Loads,
    Purpose,
    kind_of,
)
from shmmap.daemon.loading.lost_workers import LostWorkers
from shmmap.daemon.loading.prefetcher import Prefetcher
from shmmap.daemon.loading.room import Room
from shmmap.daemon.loading.worker_messages import (
    Arrived,
    Begun,
    Check,
    Checked,
    Compiling,
    Done,
    Failed,
    FromWorker,
    Job,
    Need,
)
from shmmap.daemon.loading.worker_pool import NOT_OPENED, Opened, Worker, WorkerPool
from shmmap.daemon.map.catalogue_view import CatalogueView
from shmmap.daemon.records import SPACE_CODES, Absent, Failure, Key, Resident, failure_code
from shmmap.daemon.turns import Walk
from shmmap.errors import Replaced
from shmmap.failpoints import step
from shmmap.installed import RESTART, is_replaced
from shmmap.large_tables import ShardedDict
from shmmap.layers.points import LAYER
from shmmap.layers.sources import Neighbour
from shmmap.logfmt import log
from shmmap.segment.process_limits import limit_behind
from shmmap.segment.version import Stamp

LOOKS_PER_PUMP: Final = 16
"""Loads, and misplaced cells, that one `pump` checks for having left the map."""


class MisplacedCells:
    """Cells with points outside their box: the cell moved, or the map's metadata belongs to another map.

    Each cell is logged once per version; the number of cells is counted.
    """

    def __init__(self, cache: CellCache) -> None:
        self._cache = cache
        self._versions: ShardedDict[str, int] = ShardedDict()  # of the cell when it was loaded
        self._to_check: Iterator[str] = iter(())

    def note(self, cell_id: str, index: int, outside: int) -> None:
        """Note how many points of a loaded or adopted segment lie outside its cell's box."""
        if not outside:
            self._forget(cell_id)
            return
        version = self._cache.catalogue.version(index)
        if self._versions.get(cell_id) != version:
            self._versions[cell_id] = version
            self._count()
            log.warning(
                "points outside the cell's box",
                cell=cell_id,
                points=outside,
                box=self._cache.catalogue.box(index),
                hint="was the cell moved, and its metadata not?",
            )

    def map_changed(self) -> None:
        """Let `check_some` check all cells again: they may have changed, or left the map."""
        self._to_check = self._versions.walk()

    def check_some(self, most: int) -> None:
        """Check at most ``most`` cells, and forget those that have changed or left the map."""
        for cell_id in islice(self._to_check, most):
            index = self._cache.catalogue.find(cell_id)
            if index is None or self._cache.catalogue.version(index) != self._versions.get(cell_id):
                self._forget(cell_id)

    def _forget(self, cell_id: str) -> None:
        if self._versions.pop(cell_id, 0):
            self._count()

    def _count(self) -> None:
        self._cache.statistics.set("cells_outside_box", len(self._versions))


def job_of(cache: CellCache, number: int, index: int, layer: str, granted: int) -> Job:
    """Return a worker's job for a layer of a cell."""
    catalogue = cache.catalogue
    ready = catalogue.ready(index, layer)
    points = cache.warm.get(index, LAYER) if layer != LAYER else None
    return Job(
        number,
        catalogue.id(index),
        catalogue.source(index),
        layer,
        catalogue.box(index),
        catalogue.frame_id,
        granted,
        points=points.name if points is not None else "",
        neighbours=tuple(
            Neighbour.of(catalogue.id(near), catalogue.source(near), catalogue.box(near))
            for near in cache.layers.neighbours(index, layer)
        ),
        ready=ready.version if ready is not None else 0,
    )


def opened_of(catalogue: CatalogueView) -> Opened:
    """Return the directory through which files of a map are read."""
    if catalogue.opened is None:
        return NOT_OPENED
    return catalogue.opened.innermost(catalogue.id_prefix.rstrip("/"))


class Scheduler:
    """Runs loads.

    Parameters
    ----------
    make_pool
        Makes the pool, given the function to call with a worker that has sent a message.
    load_finished
        Called with the key of a load that has ended, successful or not.
    clock
        The serving loop's clock, seconds.
    prefetch_share, outage_tolerance_s
        See `Prefetcher`.
    link, needed_bytes
        Budget of the link to a remote origin, and what a job fetches over it; None if cells are files.

    Attributes
    ----------
    loads
        Loads that are wanted, queued and running, and those that failed.
    prefetcher, room, misplaced, lost
        Loads cells before they are requested; frees memory for loads; counts cells with points outside their
        box; replaces workers.
    unfinished : bool
        Whether `pump` may have more to do at once.
    """

    def __init__(
        self,
        cache: CellCache,
        map_switch: MapSwitch,
        make_pool: Callable[[Callable[[Worker], None]], WorkerPool],
        load_finished: Callable[[Key], None],
        *,
        clock: Callable[[], float],
        prefetch_share: float = 0.0,
        outage_tolerance_s: float = 0.0,
        link: Link | None = None,
        needed_bytes: Callable[[Job], int] | None = None,
    ) -> None:
        self._cache, self._map_switch, self._load_finished = cache, map_switch, load_finished
        self._clock, self._ledger, self._layers = clock, cache.ledger, cache.layers
        self._events, self._statistics = cache.events, cache.statistics
        self.link, self._needed_bytes, self._link_s = link, needed_bytes, math.inf
        self.loads = Loads(cache.ledger, link)
        self.pool = pool = make_pool(self._on_worker)
        self._jobs: dict[int, Load] = {}
        self._to_recheck: deque[Key] = deque()
        self._for_pages: dict[Load, None] = {}  # loads that wait until the cells they read are known
        self._job_numbers, self.unfinished = 0, False
        self.prefetcher = Prefetcher(
            cache, self.loads, pool, link, share=prefetch_share, outage_tolerance_s=outage_tolerance_s
        )
        self.room = Room(
            cache.ledger, cache.evictor, cache.reclaimer, cache.lost, self.loads, pool, self.prefetcher
        )
        self.misplaced = MisplacedCells(cache)
        self.lost = LostWorkers(pool, self._jobs, self.loads, self.room, cache.statistics, self._fail)

    # --- requests -------------------------------------------------------------------------------

    def want(self, absent: Absent, priority: float, now_s: float, asker: Hashable = None) -> Load | None:
        """Make sure that an absent cell is being loaded; return None if its load failed too recently.

        A cell that failed too recently is loaded only if its file has changed since.  A worker checks that,
        if the state of the file that failed is known.
        """
        key, failure = absent.key, self.loads.failures.get(absent.key)
        if failure is not None and key not in self.loads.by_key and now_s >= failure.retry_at_s:
            self._events.emit(self._events.retried, key, failure)
            failure = None
        if failure is None or key in self.loads.by_key:
            kind = kind_of(self._cache, absent.cell, key.layer)
            return self.loads.want(key, absent.nbytes, priority, asker, kind=kind)
        if failure.code in SPACE_CODES or failure.stamp is None:
            return None
        return self.loads.check_failed_file(key, priority, asker, failure.stamp)

    def want_spare(self, absent: Absent, now_s: float, asker: Hashable) -> Load | None:
        """Load an absent cell for a spare request if that costs no client anything now; else return None.

        A load that another request or a forecast has begun is returned, too.
        """
        key = absent.key
        load, failure = self.loads.by_key.get(key), self.loads.failures.get(key)
        if load is not None and (load.is_running or load.work is not Purpose.WISH):
            return load
        if len(self.loads) or self.pool.free_places <= self.prefetcher.kept_places:
            return None
        if self._ledger.shortage(absent.nbytes) > 0:
            return None
        if any(one.work is Purpose.SPARE for one in self._jobs.values()):
            return None
        if self.link is not None and not self.link.may_begin(now_s, ahead=True):
            return None
        if failure is not None and now_s < failure.retry_at_s:
            return None
        kind = kind_of(self._cache, absent.cell, key.layer)
        return self.loads.spare(key, absent.nbytes, asker, kind=kind)

    def map_changed(self) -> None:
        """Handle another state of the map: loads of cells that left it are ended, some in each `pump`."""
        self._to_recheck = deque([*self.loads.by_key, *self.loads.failures])
        self.pages_finished()
        self.misplaced.map_changed()
        self.pool.read_through(opened_of(self._cache.catalogue))

    def pages_finished(self) -> None:
        """Start loads that waited for pages which have arrived, or request the pages still missing."""
        waiting, self._for_pages = self._for_pages, {}
        for load in waiting:
            if self.loads.by_key.get(load.key) is load:
                self.loads.requeue(load)
        self.prefetcher.restart()

    def _waits_for_pages(self, load: Load, index: int, now_s: float) -> bool:
        """Whether a load cannot start because the cells it reads are not known yet."""
        pages = self._cache.pages
        if pages is None or not isinstance(load.work, Purpose):
            return False
        area = self._layers.looks_into(index, load.key.layer)
        absent = [] if area is None else [page for page in pages.of_area(area) if not pages.is_here(page)]
        if not absent:
            return False
        pages.want(absent, load.priority)
        if any(map(pages.is_out_of_reach, absent)):
            why = "which cells lie around it cannot be found out at present"
            self._fail(load, "offline", why, None, now_s)
        else:
            self.loads.defer(load)
            self._for_pages[load] = None
        return True

    def note_origin(self, *, unreachable: bool, back: bool) -> None:
        """Note whether the origin is unreachable; if it is ``back``, failed loads may be retried."""
        self.prefetcher.health.unreachable = unreachable
        if back:
            self.prefetcher.health.answers()
            self.loads.forget_failures()
            self.prefetcher.restart()

    def _drop_some(self) -> None:
        for _ in range(min(LOOKS_PER_PUMP, len(self._to_recheck))):
            key = self._to_recheck.popleft()
            index, failure = self._cache.index_of(key.cell_id), self.loads.failures.get(key)
            if index is None:
                self.loads.cancel(key)
                self._load_finished(key)
            elif failure is not None and failure.stamp not in (None, self._cache.catalogue.stamp(index)):
                self.loads.forget_failure(key)  # another state of the source

    # --- handing out jobs -----------------------------------------------------------------------

    def free(self, now_s: float) -> None:
        """Free the retired segments that are due: loads refused for lack of memory may fit now."""
        if self._cache.reclaim(now_s):
            self.loads.forget_refusals()

    def pump(self, now_s: float) -> None:
        """Give a queued load to a worker if memory and workers allow it; see `unfinished`."""
        if self._cache.evictor.wake_s <= now_s:
            self.room.wake()
        if self.room.awaiting_grant:
            self.room.grant(self._jobs, now_s)
        self._drop_some()
        self.misplaced.check_some(LOOKS_PER_PUMP)
        if self.link is not None:
            self.link.update(now_s)
        self._link_s = math.inf
        self.unfinished = len(self.loads) > 0 and self._hand_out_next(now_s)

    def _hand_out_next(self, now_s: float) -> bool:
        """Give the next load to a worker, or settle it otherwise; return whether to go on with the one after.

        If not, there is none, or the next one waits for a worker, for memory or for the link.
        """
        if self.room.waited_for and self.room.still_waited_for(len(self._jobs), now_s):
            return False
        points, layers = self.pool.has_room(computed=False), self.pool.has_room(computed=True)
        if not (points or layers):
            return False
        load = self.loads.queue.choose(points=points, layers=layers)
        if load is not None and load.kind & FETCHED and not self._may_fetch(load, now_s):
            # what needs no link goes on
            load = self.loads.queue.choose(points=points, layers=layers, link=False)
        if load is None:
            return False
        index = self._cache.index_of(load.key.cell_id)
        if index is None:  # its cell left the map
            self._end(load)
            return True
        if isinstance(load.work, LeftoverCheck):
            resident = load.work.resident
            if self._ledger.resident_named(resident.name) is not resident:  # it was retired
                self._load_after_all(load)
                return True
        if load.kind & COMPUTED and self._waits_for_pages(load, index, now_s):
            return True
        shortage = self._ledger.shortage(load.estimate) if load.estimate else 0
        if shortage > 0:
            why_not = self.room.why_not(load, shortage, self.loads.queue.bytes_behind(), now_s)
            if why_not:
                self._fail(load, "over_budget", why_not, None, now_s)
                return True
            self.room.wait(len(self._jobs), now_s)
            return False
        return self._start(load, index, now_s)

    def _start(self, load: Load, index: int, now_s: float) -> bool:
        """Give a load for which there is room to a worker; as `_hand_out_next`."""
        layers, layer, attempt = self._layers, load.key.layer, Attempt(now_s)
        if isinstance(load.work, Purpose):
            sources = map(self._cache.catalogue.stamp, (index, *layers.neighbours(index, layer)))
            attempt.sources, attempt.version = tuple(sources), layers.version(index, layer)
        job = self._job(load, index, self._job_numbers + 1)
        link_bytes = 0
        if self._needed_bytes is not None and isinstance(job, Job):
            link_bytes = self._needed_bytes(job)
        self.loads.start(load, attempt, link_bytes)
        self._job_numbers += 1
        is_wish = load.work is Purpose.WISH
        try:
            taken = self.pool.submit(job, now_s, prefetch=is_wish, opened=opened_of(self._cache.catalogue))
        except Replaced:
            message = f"{job.source.name}: no loader can start: {RESTART}"
            self._fail(load, "load_failed", message, None, now_s)
            return True
        except OSError as error:
            self._fail(load, failure_code(error), f"no file for a segment: {error.strerror}", None, now_s)
            return True
        if not taken:
            self.loads.requeue(load)
            return False
        self._jobs[job.number] = load
        if is_wish:
            self.prefetcher.started(load)
        self._statistics.add("loads_started", isinstance(job, Job))
        return True

    def _may_fetch(self, load: Load, now_s: float) -> bool:
        """Whether the link, if there is one, has room for a load that needs it."""
        if self.link is None or self.link.may_begin(now_s, ahead=load.is_ahead):
            return True
        # a wish waits for what is under way: whatever comes of that wakes the loop
        self._link_s = self.link.rests_until_s if load.is_ahead else self.link.next_s()
        return False

    def _job(self, load: Load, index: int, number: int) -> Job | Check:
        """Return a worker's job for a load."""
        catalogue = self._cache.catalogue
        match load.work:
            case FailedFileCheck(stamp):
                return Check(number, catalogue.source(index), "", stamp)
            case LeftoverCheck(resident):
                return Check(number, catalogue.source(index), resident.name, catalogue.stamp(index))
            case Purpose():
                return job_of(self._cache, number, index, load.key.layer, load.estimate)

    def next_event_s(self) -> float:
        """Return when there is something to do if nothing arrives; infinity for never."""
        if self._to_recheck or self.unfinished:
            return 0.0
        return min(self._cache.next_reclaim_s(), self.pool.next_deadline_s(), self._link_s)

    # --- messages of workers -----------------------------------------------------------------------

    def _on_worker(self, worker: Worker) -> None:
        """Handle a worker's messages that are here, for a step's time."""
        try:
            for message in Walk(self.pool.messages(worker, self._clock)).for_a_step():
                self._on_message(worker, message, self._clock())
        except EOFError as error:
            self.lost.ended(worker, str(error), self._clock())

    def _on_message(self, worker: Worker, message: FromWorker, now_s: float) -> None:
        if isinstance(message, Begun):
            self.pool.works_on(worker, message.number, now_s)
        elif isinstance(message, Arrived):
            if self.link is not None:
                self.link.arrived(message.bytes, now_s, message.delays_s)
                self.link.end(self._jobs.get(message.fetched), message.fetched_bytes)
        elif isinstance(message, Compiling):
            worker.compiling = True
        elif isinstance(message, Need):
            self.room.ask(worker, message)
            self.room.grant(self._jobs, now_s)
        elif isinstance(message, Done | Checked | Failed):
            self._on_end(worker, message, now_s)

    def _on_end(self, worker: Worker, message: Done | Checked | Failed, now_s: float) -> None:
        """Handle the end of a job, successful or not."""
        fd, spent_s = self.pool.finished(worker, message.number, now_s)
        if not isinstance(message, Checked) and message.objects:
            self._statistics.add_objects_read(message.objects)
        if self.room.awaiting_grant:
            self.room.forget(message.number)
        load = self._jobs.pop(message.number, None)
        try:
            if load is None or (attempt := load.attempt) is None:
                return
            attempt.spent_s = spent_s
            attempt.took_s = now_s - attempt.started_s if worker.fetches else spent_s
            if isinstance(message, Checked):
                self._on_checked(load, message, now_s)
            elif isinstance(message, Failed):
                if message.message.endswith(RESTART):
                    is_replaced()  # so that the daemon notices, as its loader did
                unread = message.unread
                self._fail(load, message.code, message.message, message.stamp, now_s, unread=unread)
            elif fd >= 0:
                step("daemon.received")
                self._publish(load, attempt, message, fd, now_s)
            else:  # the job was only a check
                self._fail(load, "load_failed", "the loader says it has a segment", None, now_s)
        finally:
            if fd >= 0:
                os.close(fd)

    def _publish(self, load: Load, attempt: Attempt, done: Done, fd: int, now_s: float) -> None:
        """Publish a finished segment."""
        cache, catalogue, key = self._cache, self._cache.catalogue, load.key
        index = cache.index_of(key.cell_id)
        if index is None:
            self._statistics.add("loads_failed")
            self._end(load)
            return
        if done.version != self._layers.version(index, key.layer):
            # its file, a neighbour's file or the map changed while it was made
            reads = (done.stamp, *done.neighbours)
            if reads == attempt.sources and done.version != attempt.version:
                message = f"the loader builds {key.layer} otherwise than the daemon knows: restart it"
                self._fail(load, "load_failed", message, None, now_s)
                return
            cells = (index, *self._layers.neighbours(index, key.layer))
            self._map_switch.catch_up(cells, reads, attempt.sources)
            if done.version != self._layers.version(index, key.layer):
                self.loads.requeue(load)
                return
        resident = Resident(
            name="",
            key=key,
            version=done.version,
            nbytes=0,
            points=done.points,
            box=catalogue.box(index),
            z_min=done.z_min,
            z_max=done.z_max,
            last_use_s=0.0 if load.work is Purpose.SPARE else now_s,
            load_ns=done.load_ns,
            prefetched=load.work is Purpose.WISH,
            spare=load.work is Purpose.SPARE,
        )
        try:
            replaces = cache.publish(fd, done.header_bytes, resident, index, now_s)
        except OSError as error:
            code = failure_code(error)
            limit = limit_behind(error) if code not in SPACE_CODES else None  # else memory is full
            why = f"{limit.message} ({limit.hint})" if limit is not None else str(error.strerror)
            self._fail(load, code, f"its segment cannot be published: {why}", None, now_s)
            return
        self.misplaced.note(key.cell_id, index, done.outside)
        took_ns = int((now_s - attempt.started_s) * 1e9)
        self._events.emit(self._events.loaded, resident, took_ns, replaces, done.cached, resident.prefetched)
        for warning in done.warnings:
            log.info("loaded with a warning", cell=key.cell_id, layer=key.layer, warning=warning)
        if done.dropped:
            log.info("points dropped", cell=key.cell_id, count=done.dropped, reason="not finite")
        self._end(load)

    def _on_checked(self, load: Load, message: Checked, now_s: float) -> None:
        """Handle the result of a check."""
        match load.work:
            case LeftoverCheck(resident):
                self._on_leftover_checked(load, resident, message, now_s)
            case FailedFileCheck():
                self._on_failed_file_checked(load, message)

    def _on_leftover_checked(self, load: Load, resident: Resident, message: Checked, now_s: float) -> None:
        """Hand out a segment of a previous run from now on, or reject it."""
        if not message.wrong and self._cache.accept(resident):
            self._end(load)
            return
        if message.wrong:
            self._cache.reject(resident, message.wrong, now_s)
        self._load_after_all(load)

    def _on_failed_file_checked(self, load: Load, message: Checked) -> None:
        """If the state of a file that failed has changed, load it at once."""
        failure = self.loads.failures.get(load.key)
        if not message.wrong:
            self._end(load, failure)
            return
        index = self._cache.index_of(load.key.cell_id)
        if failure is not None:
            self._events.emit(self._events.retried, load.key, failure)
        if index is not None and message.stamp is not None:
            self._map_switch.learn(index, message.stamp)
        self._load_after_all(load)

    def _load_after_all(self, load: Load) -> None:
        """After a check, load the cell if a client has asked for it."""
        index = self._cache.index_of(load.key.cell_id)
        is_asked_for = not isinstance(load.work, LeftoverCheck) or load.work.is_asked_for
        if is_asked_for and index is not None:
            load.work, load.estimate = Purpose.DEMAND, self._cache.estimate(index, load.key.layer)
            load.kind = kind_of(self._cache, index, load.key.layer)
            self.loads.requeue(load)
        else:
            self._end(load)

    def _fail(
        self,
        load: Load,
        code: str,
        message: str,
        stamp: Stamp | None,
        now_s: float,
        *,
        unread: bool = False,
    ) -> None:
        """End a load without a segment; the back-off doubles if the previous failure had the same reason.

        ``unread``: its source could not be read.
        """
        if not isinstance(load.work, Purpose):
            is_leftover = isinstance(load.work, LeftoverCheck)
            self._on_checked(load, Checked(0, message if is_leftover else ""), now_s)
            return
        if code in SPACE_CODES:
            if load.work is Purpose.WISH:
                self.prefetcher.full(now_s)
            if load.is_ahead:
                self._end(load)
                return
            self._statistics.add("refused_over_budget")
        else:
            self._statistics.add("loads_failed")
            cell, layer = load.key
            if code != "offline" or not self.prefetcher.health.unreachable:  # an outage is logged once
                log.warning("load failed", cell=cell, layer=layer, code=code, message=message)
        if self._cache.index_of(load.key.cell_id) is None:  # the cell left the map: its failure is not kept
            self._end(load)
            return
        failure = self.loads.failure(load.key, code, message, stamp, now_s)
        self._events.emit(self._events.failed, load.key, failure, now_s)
        self._end(load, failure, out=unread or code == "load_timeout")

    def _end(self, load: Load, failure: Failure | None = None, *, out: bool = False) -> None:
        """End a load; ``out``: its source did not answer."""
        self.prefetcher.note_end(load, out=out)
        self.loads.finish(load, failure)
        self._load_finished(load.key)
