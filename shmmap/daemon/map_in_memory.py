# SPDX-License-Identifier: Apache-2.0
"""The parts of one run that have names in shared memory, put together: cache, loaders, statistics."""

from __future__ import annotations

import contextlib
import os
import secrets
import time
from collections.abc import Iterator
from functools import partial
from typing import NamedTuple

from shmmap.daemon.cache.cell_cache import CellCache
from shmmap.daemon.cache.ledger import Ledger
from shmmap.daemon.cache.map_switch import MapSwitch
from shmmap.daemon.config import DaemonConfig
from shmmap.daemon.events.log import EventLog
from shmmap.daemon.host.memory import choose_budget, loader_bytes, memory_limit_bytes
from shmmap.daemon.live.place import bytes_beside_cells
from shmmap.daemon.loading.adoption import Adoption
from shmmap.daemon.loading.prepared_parent import Early, PreparedParent
from shmmap.daemon.loading.scheduler import Scheduler
from shmmap.daemon.loading.worker_pool import WorkerPool
from shmmap.daemon.map.catalogue_view import CatalogueView
from shmmap.daemon.pins.probe import PinSource
from shmmap.daemon.pins.watch import PinWatch
from shmmap.daemon.requests.pending_request import WaitingList
from shmmap.daemon.transport.sessions import Sessions
from shmmap.daemon.transport.watched_descriptors import WatchedDescriptors
from shmmap.errors import CannotStart, ConfigError
from shmmap.segment.directory import ShmDirectory, is_full
from shmmap.segment.names import segment_prefix
from shmmap.segment.process_limits import limit_behind
from shmmap.statistics.identity import DaemonIdentity, pid_namespace, start_time_ticks
from shmmap.statistics.writer import StatisticsWriter
from shmmap.version import __version__

__all__ = ["FetchedFrom", "MapInMemory"]


class FetchedFrom(NamedTuple):
    """Where loaders fetch cells: their arguments for it, and how many cells each fetches at once."""

    words: tuple[str, ...]
    places: int


class MapInMemory:
    """What has names in shared memory: the cache with its loaders, and the statistics.

    Leftovers of a previous run are taken over.  `close` takes the names away again.

    Raises
    ------
    ConfigError
        The budget cannot work on this machine, or a limit lets nothing be written to the directory.
    CannotStart
        The directory is full, or something is in the way of a name.
    InstanceBusy
        Another daemon has these names.
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
        origin: FetchedFrom | None = None,
    ) -> None:
        self.directory = directory
        epoch = secrets.randbits(63) | 1
        self.identity = _identity(config, catalogue, directory.path, socket_path, epoch)
        group_limit = memory_limit_bytes()
        budget = choose_budget(  # may refuse: before anything has a name
            config.budget_bytes,
            directory,
            ours_bytes=directory.used_bytes(segment_prefix(config.instance)),
            beside_bytes=bytes_beside_cells(
                len(config.live),
                cells=directory,
                shm_dir=config.live_shm_dir,
                budget_bytes=config.live_budget_bytes,
            ),
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
                reserve=ledger.add_overhead,
            )
        with contextlib.ExitStack() as undo:
            undo.callback(self.statistics.close)  # its name must not stay when something else fails
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
                *(origin.words if origin is not None else ()),
            )
            parent = PreparedParent(settings, self.watched, early)
            parent.start()  # it imports what loaders need while this process gets ready
            pool = partial(
                WorkerPool,
                config.loaders(),
                directory,
                parent,
                config.load_timeout_s,
                self.watched,
                places=origin.places if origin is not None else 1,
            )
            self.map_switch = MapSwitch(self.cache)
            self.waiting = WaitingList(ledger)
            self.scheduler = Scheduler(
                self.cache,
                self.map_switch,
                pool,
                self.waiting,
                clock=time.monotonic,
                prefetch_share=config.prefetch_share,
                outage_tolerance_s=config.outage_tolerance_s,
            )
            self.adoption = Adoption(self.cache, self.scheduler.loads, self.scheduler.misplaced)
            self.adoption.take_over(time.monotonic())
            events = self.cache.events
            events.flush()
            self.scheduler.room.watch(self.watched, time.monotonic)
            undo.pop_all()

    def close(self, *, keep: bool) -> None:
        """End the loaders, and remove every name, or leave those of the segments to the next run."""
        self.scheduler.pool.close()
        self.adoption.close(keep=keep)
        self.cache.close(keep=keep)
        self.statistics.close()
        self.watched.close()


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
        library_version=__version__,
        started_unix_ns=time.time_ns(),
        frame_id=catalogue.frame_id,
    )


@contextlib.contextmanager
def _first_write(directory: ShmDirectory) -> Iterator[None]:
    """Say in errors of the first write to a directory what is wrong with it."""
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
