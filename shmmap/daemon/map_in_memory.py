# SPDX-License-Identifier: Apache-2.0
"""Assembly of the parts that have names in shared memory: cache, loaders, statistics.

Also decides where chunks of live maps are stored, and how much memory they may take besides the cells.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import secrets
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Final, NamedTuple

from shmmap.daemon.cache.cell_cache import CellCache
from shmmap.daemon.cache.ledger import Ledger
from shmmap.daemon.cache.map_switch import MapSwitch
from shmmap.daemon.config import DaemonConfig
from shmmap.daemon.events.log import EventLog
from shmmap.daemon.host.memory import (
    choose_budget,
    loader_bytes,
    memory_limit_bytes,
    room_bytes,
    usable_bytes,
)
from shmmap.daemon.loading.adoption import Adoption
from shmmap.daemon.loading.link import Link
from shmmap.daemon.loading.prepared_parent import Early, PreparedParent
from shmmap.daemon.loading.preparer import DEADLINE, Preparer, refuse_far_reaching
from shmmap.daemon.loading.scheduler import Scheduler
from shmmap.daemon.loading.worker_messages import Job
from shmmap.daemon.loading.worker_pool import WorkerPool
from shmmap.daemon.map.catalogue_view import CatalogueView
from shmmap.daemon.pins.probe import PinSource
from shmmap.daemon.pins.watch import PinWatch
from shmmap.daemon.requests.waiting_list import WaitingList
from shmmap.daemon.transport.sessions import Sessions
from shmmap.daemon.turns import WatchedDescriptors
from shmmap.errors import CannotStart, ConfigError
from shmmap.live_messages import Begin
from shmmap.live_settings import LiveSettings, live_directory
from shmmap.logfmt import log
from shmmap.mounts import mount_of
from shmmap.segment.directory import ShmDirectory, is_full
from shmmap.segment.names import DEFAULT_SHM_DIR, segment_prefix
from shmmap.segment.process_limits import limit_behind
from shmmap.statistics.identity import DaemonIdentity, pid_namespace, start_time_ticks
from shmmap.statistics.writer import StatisticsWriter
from shmmap.version import build_version

CEILING_BYTES: Final = 1 << 30
PART: Final = 8
"""Divisor: by default, live maps get 1/8 of the memory that they share with cells."""
CELLS_WITHOUT_MAP: Final = 4 << 20
"""Budget of cells if no map of points is served: the statistics count towards it."""
FEW_BYTES: Final = 16 << 20
"""A default share of less than this for a map is reported."""
LEAST_BYTES: Final = 4 << 20
"""Minimum budget of a map: some of the largest chunks, half a mebibyte each."""


def share_of_live_maps(
    maps: int, *, cells: ShmDirectory, room: int, shm_dir: str, budget_bytes: int, alone: bool
) -> int:
    """Return the bytes that live maps get in the cells' file system: their budget, or by default a share.

    Parameters
    ----------
    maps
        Number of live maps.
    room
        Bytes of the file system for cells and live maps together.
    shm_dir, budget_bytes
        Settings for live maps; empty and 0 for the defaults.
    alone
        Whether no map of points is served, for which something would have to be left.

    Returns
    -------
    0 if there are no live maps, or if their chunks are in another file system.
    """
    if not maps:
        return 0
    path = shm_dir or _without_huge_pages(cells.path)
    try:
        same = os.stat(path).st_dev == os.stat(cells.path).st_dev
    except OSError:
        same = False  # `place_live_maps` raises the error
    if not same:
        return 0
    return budget_bytes or _default_share(maps, room - CELLS_WITHOUT_MAP if alone else room // PART)


def _default_share(maps: int, most: int) -> int:
    return max(LEAST_BYTES * maps, min(most, usable_bytes(), CEILING_BYTES))


def place_live_maps(
    live: Sequence[LiveSettings],
    *,
    instance: str,
    cells: ShmDirectory,
    cells_budget_bytes: int,
    share_bytes: int,
    shm_dir: str,
    budget_bytes: int,
    gid: int,
    marks_gid: int,
) -> Begin:
    """Decide where live maps are stored and how much memory they may take.

    Parameters
    ----------
    cells, cells_budget_bytes
        Directory and budget of the cells.
    share_bytes
        What `share_of_live_maps` returned.
    shm_dir, budget_bytes
        Settings for live maps; empty and 0 for the defaults.
    gid, marks_gid
        Groups that may read chunks, and that may write to live maps.

    Raises
    ------
    ConfigError
        The directory has huge pages, both budgets do not fit in it, or there is no state directory.
    CannotStart
        The directory cannot be used, or too little memory is free.
    """
    path = shm_dir or _without_huge_pages(cells.path)
    directory = ShmDirectory(path)
    try:
        size, free = directory.size_bytes(), directory.free_bytes()
        used = sum(directory.used_bytes(f"/shmmap-live.{instance}.{one.name}.") for one in live)
        room = room_bytes(directory, used, memory_limit_bytes())
    finally:
        directory.close()
    if huge := mount_of(directory.path).huge_pages:
        raise ConfigError(
            f"{directory.path} has huge pages ({huge}): a chunk of a few KiB would take 2 MiB there",
            key="live_shm_dir",
            hint="name a tmpfs without them, such as /dev/shm",
        )
    same = os.stat(directory.path).st_dev == os.stat(cells.path).st_dev
    beside = cells_budget_bytes if same else 0
    least = LEAST_BYTES * len(live)
    default = max(least, min(share_bytes, free + used - beside)) if same else _default_share(len(live), room)
    budget = budget_bytes or default
    if budget < least:
        raise ConfigError(
            f"{len(live)} live maps share {budget >> 20:,} MiB; each needs {LEAST_BYTES >> 20} MiB",
            key="live_budget",
            hint=f"raise --live-budget to {least >> 20}M at least",
        )
    if budget + beside > size:
        raise ConfigError(
            f"live maps of {budget >> 20:,} MiB and cells of {beside >> 20:,} MiB do not fit in"
            f" {directory.path}, which has {size >> 20:,} MiB",
            key="live_budget",
            hint="lower --live-budget or --budget, or enlarge the tmpfs",
        )
    if budget_bytes and budget > free + used:
        raise CannotStart(
            f"live maps of {budget >> 20:,} MiB do not fit in {directory.path}, which has"
            f" {free + used >> 20:,} MiB free",
            hint="free some, or lower --live-budget",
        )
    if not budget_bytes and budget < FEW_BYTES * len(live):
        log.warning(
            "live maps get little memory: chunks are read from the disk again and again",
            budget=f"{budget >> 20}M",
            directory=directory.path,
            hint="set live_budget and budget, enlarge the tmpfs (docker: --shm-size), or set live_shm_dir",
        )
    maps = tuple(
        dataclasses.replace(one, path=one.path or live_directory(instance, one.name)) for one in live
    )
    marks = os.path.join(directory.path, f"shmmap-live.{instance}.marks")
    return Begin(instance, maps, directory.path, marks, budget, gid, marks_gid)


def _without_huge_pages(path: str) -> str:
    """Return a directory for chunks: that of the cells, unless it has huge pages."""
    return DEFAULT_SHM_DIR if mount_of(path).huge_pages else path


class FetchedFrom(NamedTuple):
    """How loaders fetch cells; by default cells are files.

    Attributes
    ----------
    words
        Arguments of loaders.
    places
        Number of cells that each loader fetches concurrently.
    link
        Budget of the link; None where the map is in a directory.
    needed_bytes
        What a job fetches over the link.
    """

    words: tuple[str, ...] = ()
    places: int = 1
    link: Link | None = None
    needed_bytes: Callable[[Job], int] | None = None


FROM_FILES: Final = FetchedFrom()
"""How loaders get cells that are files."""


class MapInMemory:
    """Parts with names in shared memory: the cache with its loaders, and the statistics.

    A previous run's segments are taken over.  `close` removes the names.

    Attributes
    ----------
    live_bytes
        What `share_of_live_maps` returned.

    Raises
    ------
    ConfigError
        The budget is impossible on this machine, a limit prevents writing to the directory, or a layer to
        prepare would use too many neighbouring cells.
    CannotStart
        The directory is full, or another file has a needed name.
    InstanceBusy
        Another daemon uses these names.
    """

    def __init__(
        self,
        config: DaemonConfig,
        catalogue: CatalogueView,
        directory: ShmDirectory,
        pins: PinWatch,
        socket_path: str,
        mode: int,
        gid: int,
        early: Early | None = None,
        fetched: FetchedFrom = FROM_FILES,
        *,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        refuse_far_reaching(config.prepare, catalogue)
        self.directory = directory
        epoch = secrets.randbits(63) | 1
        self.identity = _identity(config, catalogue, directory.path, socket_path, epoch)
        group_limit = memory_limit_bytes()
        ours = directory.used_bytes(segment_prefix(config.instance))
        if config.live:
            ours += directory.used_bytes(f"/shmmap-live.{config.instance}.")
        self.live_bytes = share_of_live_maps(
            len(config.live),
            cells=directory,
            room=room_bytes(directory, ours, group_limit),
            shm_dir=config.live_shm_dir,
            budget_bytes=config.live_budget_bytes,
            alone=not config.map_path,
        )
        budget = choose_budget(  # may raise: before anything has a name
            config.budget_bytes or (0 if config.map_path else CELLS_WITHOUT_MAP),
            directory,
            ours_bytes=ours,
            beside_bytes=self.live_bytes,
            limit_bytes=group_limit,
        )
        ledger = Ledger(budget)
        with _first_write(directory):
            self.statistics = StatisticsWriter(
                directory,
                config.instance,
                self.identity,
                mode=mode,
                gid=gid,
                starting=True,
            )
        with contextlib.ExitStack() as undo:
            undo.callback(self.statistics.close)  # its name must not stay if a later step fails
            self.statistics.set("pin_source", list(PinSource).index(pins.source))
            self.statistics.set("last_reload_unix_ns", time.time_ns())
            self.statistics.set("map_problems", len(catalogue.problems))
            ledger.overhead_bytes = self.statistics.size_bytes
            self.event_log = EventLog(epoch)
            self.sessions = Sessions()
            self.cache = CellCache(
                catalogue,
                ledger,
                directory,
                self.sessions,
                pins,
                self.statistics,
                self.event_log,
                instance=config.instance,
                mode=mode,
                gid=gid,
            )
            self.watched = WatchedDescriptors()
            settings = (
                directory.path,
                str(loader_bytes(group_limit)),
                config.cache_dir,
                str(config.cache_bytes),
                *fetched.words,
            )
            parent = PreparedParent(settings, self.watched, early)
            parent.start()  # its imports run while this process continues to start
            pool = partial(WorkerPool, directory=directory, parent=parent, watched=self.watched)
            self.map_switch = MapSwitch(self.cache)
            self.waiting = WaitingList(ledger)
            self.scheduler = Scheduler(
                self.cache,
                self.map_switch,
                lambda on_message: pool(
                    limit=config.loaders(),
                    deadline_s=config.load_timeout_s,
                    on_message=on_message,
                    places=fetched.places,
                ),
                self.waiting.load_finished,
                clock=clock,
                prefetch_share=config.prefetch_share,
                outage_tolerance_s=config.outage_tolerance_s,
                link=fetched.link,
                needed_bytes=fetched.needed_bytes,
            )
            self.preparer = _preparer(config, self.cache, self.scheduler, pool, clock)
            self.adoption = Adoption(self.cache, self.scheduler.loads, self.scheduler.misplaced)
            self.adoption.take_over(clock())
            events = self.cache.events
            events.flush()
            self.scheduler.room.watch(self.watched, clock)
            undo.pop_all()

    def close(self, *, keep: bool) -> None:
        """End the loaders, and remove every name; with ``keep`` leave the segments' names to the next run."""
        with contextlib.ExitStack() as stack:  # each step is taken, whatever happens in those before
            stack.callback(self.watched.close)
            stack.callback(self.statistics.close)
            stack.callback(self.cache.close, keep=keep)
            stack.callback(self.adoption.close, keep=keep)
            stack.callback(self.scheduler.pool.close)
            if self.preparer is not None:
                stack.callback(self.preparer.close)
            stack.callback(self.cache.events.close)


def _preparer(
    config: DaemonConfig,
    cache: CellCache,
    scheduler: Scheduler,
    pool: partial[WorkerPool],
    clock: Callable[[], float],
) -> Preparer | None:
    """Return what prepares layers; None if the settings name none."""
    if not config.prepare:
        return None
    deadline_s = DEADLINE * config.load_timeout_s
    return Preparer(
        cache,
        scheduler,
        config.prepare,
        config.cache_bytes,
        lambda on_message: pool(limit=1, deadline_s=deadline_s, on_message=on_message),
        clock=clock,
    )


def _identity(
    config: DaemonConfig, catalogue: CatalogueView, shm_dir: str, socket_path: str, epoch: int
) -> DaemonIdentity:
    return DaemonIdentity(
        pid=os.getpid(),
        start_time_ticks=start_time_ticks(os.getpid()),
        pid_namespace=pid_namespace(),
        epoch=epoch,
        instance=config.instance,
        endpoint=socket_path,
        map_path=config.map_path,
        map_version=catalogue.map_version,
        shm_dir=shm_dir,
        id_prefix=catalogue.id_prefix,
        library_version=build_version(),
        started_unix_ns=time.time_ns(),
        frame_id=catalogue.frame_id,
        prepare=" ".join(config.prepare),
        live=" ".join(one.name for one in config.live),
    )


@contextlib.contextmanager
def _first_write(directory: ShmDirectory) -> Iterator[None]:
    """Explain in the error of the first write to a directory what is wrong with the directory."""
    try:
        yield
    except OSError as error:
        said = f"shared-memory directory {directory.path}: nothing can be written there: {error.strerror}"
        if is_full(error):
            raise CannotStart(said, hint="free some, or enlarge it") from error
        limit = limit_behind(error)
        if limit is not None:
            raise limit from error
        raise ConfigError(said, key="shm_dir") from error
