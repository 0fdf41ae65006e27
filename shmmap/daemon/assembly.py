# SPDX-License-Identifier: Apache-2.0
"""Assembly of one run of the daemon: sockets, requests and the loop on top of the map in memory."""

from __future__ import annotations

import contextlib
import ctypes
import dataclasses
import gc
import os
import signal
import socket
import time
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Final

from shmmap.daemon.config import DaemonConfig
from shmmap.daemon.events.log import event_listener, events_path
from shmmap.daemon.host.instance import InstanceLock, make_runtime_dir, take_away
from shmmap.daemon.host.scheduling import SERVING_SLICE_NS, take_slices
from shmmap.daemon.host.signals import (
    KEEP_SIGNAL,
    RELOAD_SIGNAL,
    STOP_SIGNALS,
    ServingSignals,
    StartSignals,
    ignore_signals,
)
from shmmap.daemon.live_relay import LiveRelay, NoLiveMaps
from shmmap.daemon.map.catalogue_reload import Reloader, Reread
from shmmap.daemon.map.file_watch import FileWatch, directories_of
from shmmap.daemon.map_in_memory import MapInMemory
from shmmap.daemon.requests.cell_requests import CellRequests
from shmmap.daemon.requests.dispatch import Defects, Dispatch
from shmmap.daemon.requests.handshake import Handshake
from shmmap.daemon.requests.map_change import MapChange
from shmmap.daemon.requests.map_queries import MapQueries
from shmmap.daemon.requests.operators.operator_pins import OperatorPins
from shmmap.daemon.requests.operators.operator_requests import Authorization, OperatorRequests
from shmmap.daemon.requests.paging import Paging
from shmmap.daemon.service_manager import ActivatedSocket, ServiceManager, status_line
from shmmap.daemon.serving_loop import BackgroundTask, ServingLoop
from shmmap.daemon.telemetry.sampler import PublishedGauges, Sampler
from shmmap.daemon.transport.connection import Connections, Listener
from shmmap.daemon.transport.inbox import Inbox
from shmmap.daemon.transport.socket_file import SocketFile
from shmmap.errors import ShmmapError
from shmmap.failpoints import step
from shmmap.installed import RESTART, is_installed, was_noticed
from shmmap.logfmt import log
from shmmap.protocol.codec import MAX_REQUEST_BYTES
from shmmap.protocol.events import Epoch

if TYPE_CHECKING:
    from shmmap.daemon.map.published_origin import PublishedOrigin

LOOK_S: Final = 1.0
"""Interval of checking whether the sockets' files still exist."""
LAST_WORDS_S: Final = 0.2
"""Time for delivering the last messages when the daemon stops."""


class Service:
    """The daemon as clients and the service manager see it: sockets, requests, signals and status.

    Attributes
    ----------
    replaced : bool
        Whether shmmap was replaced, and a process was needed that the new version cannot be.

    Raises
    ------
    ConfigError
        The group of administrators does not exist.
    """

    def __init__(
        self,
        config: DaemonConfig,
        memory: MapInMemory,
        live: LiveRelay | NoLiveMaps,
        reloader: Reloader,
        manager: ServiceManager,
        socket_path: str,
        gid: int,
        signals: StartSignals,
        activated: ActivatedSocket | None,
        lock: InstanceLock,
        elsewhere: PublishedOrigin | None = None,
    ) -> None:
        self._config = config
        self._memory = memory
        self._live = live
        self._reloader = reloader
        self._manager = manager
        self._socket_path = socket_path
        self._gid = gid
        self._signals = signals
        self._activated = activated
        self._lock = lock
        self._elsewhere = elsewhere
        self._file_watch: FileWatch | None = None
        self.replaced = False
        authorization = Authorization(config.admin_group)
        take_slices(SERVING_SLICE_NS)
        self._connections = Connections()
        self._sockets: list[tuple[SocketFile, Listener]] = []
        self._published = PublishedGauges(memory.statistics)
        self._look_s = 0.0
        cache, sessions, statistics = memory.cache, memory.sessions, memory.statistics
        scheduler, watched = memory.scheduler, memory.watched
        survey, events, ledger = cache.survey, cache.events, cache.ledger
        quota, budget = config.session_quota, ledger.budget_bytes
        self._inbox = Inbox(statistics)
        cells = CellRequests(
            cache,
            scheduler,
            memory.waiting,
            quota_bytes=int(quota * budget) if quota <= 1 else int(quota),
            due=self._inbox.add_work,
            clock=time.monotonic,
        )
        sampler = Sampler(
            cache, survey, scheduler, statistics, memory.event_log, sessions, watched, cells, self._beat
        )
        self._pins = OperatorPins(cache, scheduler)
        queries = MapQueries(
            config,
            cache,
            sessions,
            self._pins,
            memory.map_switch,
            scheduler.loads,
            memory.event_log,
            events_path(socket_path),
        )
        self._operators = operators = OperatorRequests(cache, self._pins, reloader)
        handshake = Handshake(
            sessions,
            cells,
            statistics,
            memory.event_log,
            operators,
            survey,
            live.on_disconnect,
            events.minutes,
        )
        paging = Paging(
            cache, scheduler, memory.map_switch, cells, queries, memory.adoption, sessions, watched
        )
        paging.follow()
        change = MapChange(reloader, cache, scheduler, memory.map_switch, memory.event_log, paging)
        watched.watch(reloader.fd, lambda: self._collect_reload(change), "map")
        defects = Defects(statistics)
        dispatch = Dispatch(
            handshake,
            cells,
            queries,
            operators,
            authorization,
            live,
            survey,
            sampler,
            defects,
            self._inbox.add_work,
        )
        tasks: deque[tuple[str, BackgroundTask]] = deque(
            [
                ("usage", survey),
                ("map", memory.map_switch),
                ("map", paging),
                ("memory", scheduler.prefetcher),
                ("statistics", sampler),
                ("memory", cache.evictor),
                ("answers", live),
            ]
        )
        if memory.preparer is not None:
            tasks.append(("loaders", memory.preparer))
        if elsewhere is not None:
            tasks += self._tasks_of(elsewhere)
        self._handshake = handshake
        self._loop = ServingLoop(
            watched,
            self._inbox,
            dispatch,
            operators,
            cells,
            events,
            survey,
            scheduler,
            tasks,
            statistics,
            defects,
            memory.event_log,
        )

    def _tasks_of(self, elsewhere: PublishedOrigin) -> Iterator[tuple[str, BackgroundTask]]:
        """Yield the background tasks that a remote origin needs."""
        from shmmap.daemon.loading.outages import OriginWatch

        cache, scheduler, watched = self._memory.cache, self._memory.scheduler, self._memory.watched
        origin_watch = OriginWatch(elsewhere.link, scheduler, elsewhere.try_again, self._take_another)
        watched.watch(elsewhere.link.fd, origin_watch.collect, "map")
        yield "map", origin_watch
        if elsewhere.keeper is not None:
            from shmmap.daemon.loading.outages import DiskAhead

            disk_ahead = DiskAhead(cache, scheduler, elsewhere.keeper)
            watched.watch(elsewhere.keeper.fd, disk_ahead.collect, "memory")
            yield "memory", disk_ahead

    def run(self, started_s: float) -> None:
        """Bind, report READY, answer requests until a signal or an operator stops the daemon."""
        memory, watched = self._memory, self._memory.watched
        try:
            self._watch_map()
            with contextlib.closing(ServingSignals()) as signals:
                self._signals.raise_if_stopped()
                watched.watch(signals.fd, lambda: self._on_signals(signals))
                self._listen()
                memory.statistics.set("starting", 0)
                memory.statistics.beat()
                self._publish_epoch("started")
                self._live.begin_events()
                memory.scheduler.pool.start_one()
                cells, ledger = len(memory.cache.catalogue), memory.cache.ledger
                log.info(
                    "ready",
                    endpoint=self._socket_path,
                    instance=self._config.instance,
                    map=self._config.map_path,
                    cells=cells,
                    budget_bytes=ledger.budget_bytes,
                    start_s=time.monotonic() - started_s,
                )
                self._manager.ready(f"serving {cells} cells")
                _settle_memory()
                if self._signals.reload_wanted:
                    self._reload()
                self._loop.run()
                self._loop.answer_waiting()
        finally:
            self._end()

    def _listen(self) -> None:
        memory = self._memory
        passed = socket.socket(fileno=self._activated.fd) if self._activated is not None else None
        requests = SocketFile(self._socket_path, self._gid, passed)
        listener = Listener(
            requests.socket,
            memory.watched,
            self._connections,
            memory.statistics,
            b"ROUTER",
            b"DEALER",
            MAX_REQUEST_BYTES,
            self._inbox.receive,
            self._handshake.hung_up,
        )
        self._sockets.append((requests, listener))
        step("daemon.bind")
        events = SocketFile(events_path(self._socket_path), self._gid)
        listener = event_listener(
            events.socket, memory.watched, self._connections, memory.statistics, memory.event_log
        )
        self._sockets.append((events, listener))
        for _file, one in self._sockets:
            one.begin()

    def _restore_sockets(self, now_s: float) -> None:
        """Recreate files of sockets that another program removed; open connections continue."""
        if now_s < self._look_s:
            return
        self._look_s = now_s + LOOK_S
        missing, before = 0, self._memory.statistics.values["sockets_missing"]
        for at, (file, listener) in enumerate(self._sockets):
            if file.is_there:
                continue
            try:
                make_runtime_dir(Path(file.path).parent, self._gid)
                again = SocketFile(file.path, self._gid)
            except ShmmapError as error:
                missing += 1
                if not before:
                    log.error("socket removed by another program", path=file.path, error=error)
                continue
            log.warning("socket removed by another program, and made again", path=file.path)
            listener.move_to(again.socket)
            self._sockets[at] = again, listener
        if not missing:
            self._lock.restore()
        self._memory.statistics.set("sockets_missing", missing)

    def _end(self) -> None:
        keep = self._signals.keep
        self._manager.stopping("keeping memory for the next start" if keep else "freeing memory")
        self._publish_epoch("stopping")
        self._memory.event_log.close()
        self._connections.deliver(LAST_WORDS_S)
        for file, _listener in self._sockets:
            file.socket.close()
        self._reloader.close()
        if self._file_watch is not None:
            self._file_watch.close()
        for file, _listener in self._sockets:
            file.remove()

    def _publish_epoch(self, what: str) -> None:
        catalogue, ledger = self._memory.cache.catalogue, self._memory.cache.ledger
        self._memory.event_log.publish(
            Epoch, what, catalogue.map_version, len(catalogue), ledger.resident_count
        )

    def _beat(self) -> None:
        """Do the periodic work, a few times a second, in the loop itself: a hanging daemon stops beating."""
        memory, now_s = self._memory, time.monotonic()
        self._manager.beat(now_s, self._status)
        self._handshake.look_after_departed()
        if not any(self._connections):  # no connection will end and make room
            self._connections.try_again()
        self._pins.keep(now_s)
        self._operators.answer_overdue(now_s)
        self._live.beat(now_s)
        if was_noticed() and not self.replaced:
            self._on_replaced()
        self._restore_sockets(now_s)
        if self._file_watch is not None and self._file_watch.take_change(now_s):
            self._reload()
        if self._elsewhere is not None:
            self._elsewhere.note_served(memory.cache.catalogue)
            self._published.look(self._elsewhere, self._memory.scheduler.link)
        catalogue = memory.cache.catalogue
        version = catalogue.map_version
        if version != memory.identity.map_version:
            memory.identity = dataclasses.replace(memory.identity, map_version=version)
            memory.statistics.update_identity(memory.identity)

    def _on_replaced(self) -> None:
        """Report that shmmap was replaced; under a service manager end: it starts the new version."""
        self.replaced = True
        log.error(RESTART)
        self._memory.statistics.set("package_replaced", 1)
        if is_installed() and self._manager.starts_again:
            log.info("stopping", reason="the service manager starts the new version", segments="kept")
            self._signals.keep = True
            self._loop.stop(answer=False)

    def _collect_reload(self, change: MapChange) -> None:
        if self._elsewhere is not None:  # before the reload is answered
            self._published.look(self._elsewhere, self._memory.scheduler.link)
        change.collect()

    def _status(self) -> str:
        memory, ledger = self._memory, self._memory.cache.ledger
        return status_line(
            resident=ledger.cell_count,
            cells=len(memory.cache.catalogue),
            clients=len(memory.sessions),
            used_bytes=ledger.used_bytes,
            budget_bytes=ledger.budget_bytes,
            failed=memory.statistics.values["loads_failed"],
        )

    # --- reload -----------------------------------------------------------------------------------

    def _watch_map(self) -> None:
        if self._config.watch:
            watch = FileWatch(self._directories(self._memory.cache.id_prefix))
            self._memory.watched.watch(watch.fd, lambda: watch.drain(time.monotonic()), "map")
            self._file_watch = watch

    def _directories(self, id_prefix: str) -> set[str]:
        return directories_of(self._config.map_path, self._config.metadata, id_prefix)

    def _take_another(self) -> None:
        """Reload because the origin has another version of the map."""
        self._reloader.ask(lambda _result: None)

    def _reload(self) -> None:
        """Read the map again after a signal or a change, and report start and end to the service manager."""
        self._manager.reloading()
        self._reloader.ask(self._reloaded)

    def _reloaded(self, result: Reread | ShmmapError) -> None:
        if isinstance(result, ShmmapError):
            self._manager.reloaded(f"reload failed, the old map stays: {result.message}")
            return
        if self._file_watch is not None:  # the metadata may name another directory now
            self._file_watch.follow(self._directories(result.catalogue.id_prefix))
        self._manager.reloaded(f"map read again: {len(result.catalogue)} cells")

    # --- signals ----------------------------------------------------------------------------------

    def _on_signals(self, signals: ServingSignals) -> None:
        for number in signals.take():
            if number == RELOAD_SIGNAL and not self._signals.hangup_stops:
                self._reload()
            elif number in (*STOP_SIGNALS, KEEP_SIGNAL, RELOAD_SIGNAL) and not self._loop.stopping:
                keep = self._signals.keep = self._signals.keep or number == KEEP_SIGNAL
                log.info("stopping", signal=number.name, segments="kept" if keep else "removed")
                if not keep:
                    for again in STOP_SIGNALS:
                        signal.signal(again, self._quick_exit)
                self._loop.stop(answer=not keep)

    def _quick_exit(self, number: int, frame: object) -> None:
        """Remove the names and exit because of a second signal.

        It may interrupt the handling of the first signal, so it relies only on the directory's content.
        """
        del number, frame
        ignore_signals()  # further signals would pile up in this handler
        directory, instance = self._memory.directory, self._config.instance
        take_away(directory, instance)
        for file, _listener in self._sockets:
            file.remove()
        self._lock.release()
        os._exit(0)  # the loaders die with this process


def _settle_memory() -> None:
    """Free memory left over from reading the map; from now on reference counting alone frees memory.

    No object that the daemon drops is part of a reference cycle (a test ensures that), and a run of the
    cyclic garbage collector took 30 ms of a turn: even new objects are many where segments come and go fast.
    """
    gc.collect()
    gc.disable()
    ctypes.CDLL(None).malloc_trim(0)
