# SPDX-License-Identifier: Apache-2.0
"""What one life of the daemon has between its locks and its end: the map in memory, sockets, a loop."""

from __future__ import annotations

import contextlib
import ctypes
import dataclasses
import gc
import logging
import os
import secrets
import signal
import time
from typing import Final

import zmq

from shmmap import __version__
from shmmap.daemon.cache.cell_cache import Store
from shmmap.daemon.cache.eviction_policy import POLICIES
from shmmap.daemon.cache.ledger import Residency
from shmmap.daemon.cache.reclaimer import Reclaimer
from shmmap.daemon.config import DaemonConfig
from shmmap.daemon.events.log import EventLog, nowhere
from shmmap.daemon.events.publisher import EventPublisher, events_path
from shmmap.daemon.host.budget import choose_budget
from shmmap.daemon.host.cgroup_memory import memory_limit_bytes
from shmmap.daemon.host.instance_names import lock_name, lock_path, take_away
from shmmap.daemon.host.scheduling import SERVING_SLICE_NS, take_slices
from shmmap.daemon.host.signals import KEEP_SIGNAL, RELOAD_SIGNAL, STOP_SIGNALS, ServingSignals, StartSignals
from shmmap.daemon.loading.adoption import Leftovers
from shmmap.daemon.loading.worker_pool import WorkerPool
from shmmap.daemon.map.catalogue_reload import Reloader
from shmmap.daemon.map.file_watch import FileWatch, directories_of
from shmmap.daemon.pins.probe import Rung
from shmmap.daemon.pins.watch import PinWatch
from shmmap.daemon.requests.map_queries import MapQueries
from shmmap.daemon.requests.operators.authorization import Privileges
from shmmap.daemon.requests.operators.operator_pins import OperatorPins
from shmmap.daemon.service_manager.socket_activation import ActivatedSocket
from shmmap.daemon.service_manager.status import ServiceManager, status_line
from shmmap.daemon.serving_loop import Server
from shmmap.daemon.transport.outbox import SEND_QUEUE
from shmmap.daemon.transport.sessions import Sessions
from shmmap.daemon.transport.socket_file import bind_socket, remove_socket
from shmmap.errors import ConfigError, InternalError, ShmmapError
from shmmap.failpoints import step
from shmmap.origin.catalogue import Catalogue
from shmmap.protocol.codec import MAX_REQUEST_BYTES
from shmmap.protocol.events import Epoch
from shmmap.segment.directory import ShmDirectory
from shmmap.segment.names import segment_prefix
from shmmap.statistics.identity import DaemonIdentity, pid_namespace, start_time_ticks
from shmmap.statistics.writer import StatisticsWriter

__all__ = ["Life"]

_log = logging.getLogger(__name__)

RECEIVE_QUEUE: Final = 32
"""Requests that libzmq reads ahead from one connection, of up to `MAX_REQUEST_BYTES` each."""


class Life:
    """Everything the daemon has between its locks and its end."""

    def __init__(
        self,
        config: DaemonConfig,
        catalogue: Catalogue,
        directory: ShmDirectory,
        pins: PinWatch,
        socket_path: str,
        mode: int,
        gid: int,
    ) -> None:
        self._config = config
        self._socket_path = socket_path
        self._gid = gid
        self._privileges = Privileges(config.admin_group)
        self._epoch = secrets.randbits(63) | 1
        self._event_log = EventLog(self._epoch)
        self._map_watch: FileWatch | None = None
        self._directory = directory
        self._catalogue = catalogue
        self._identity = DaemonIdentity(
            pid=os.getpid(),
            start_time_ticks=start_time_ticks(os.getpid()),
            pid_namespace=pid_namespace(),
            epoch=self._epoch,
            instance=config.instance,
            endpoint=socket_path,
            map_path=config.map_path,
            map_version=catalogue.map_version,
            shm_dir=directory.path,
            id_prefix=catalogue.id_prefix,
            library_version=__version__,
            started_unix_ns=time.time_ns(),
            frame_id=catalogue.frame_id,
        )
        budget = choose_budget(  # may refuse: before anything has a name
            config.budget_bytes,
            directory,
            ours_bytes=directory.used_bytes(segment_prefix(config.instance)),
            limit_bytes=memory_limit_bytes(),
        )
        try:
            self._statistics = StatisticsWriter(
                directory, config.instance, self._identity, mode=mode, gid=gid
            )
        except OSError as error:
            raise ConfigError(
                f"shared-memory directory {directory.path}: nothing can be written there: {error.strerror}",
                key="shm_dir",
                hint="make room, and lift limits on the size of files (ulimit -f, LimitFSIZE=)",
            ) from error
        self._sessions = Sessions()
        books = Residency(budget)
        books.overhead_bytes = self._statistics.size_bytes

        def grow_statistics(nbytes: int) -> bool:
            fits = books.shortage(nbytes) <= 0
            books.overhead_bytes += nbytes if fits else 0
            return fits

        self._statistics.reserve = grow_statistics
        reclaimer = Reclaimer(books, directory, self._sessions, POLICIES[config.eviction], pins)
        self._statistics.set("pin_source", list(Rung).index(pins.rung))
        self._statistics.set("last_reload_unix_ns", time.time_ns())
        pool = WorkerPool(
            config.loaders(),
            directory.path,
            config.load_timeout_s,
            watch=lambda fd: self._running.watch_worker(fd),
            unwatch=lambda fd: self._running.unwatch(fd),
            cache_dir=config.cache_dir,
            cache_bytes=config.cache_bytes,
        )
        self._store = Store(
            catalogue,
            books,
            reclaimer,
            pool,
            directory,
            self._statistics,
            instance=config.instance,
            epoch=self._epoch,
            id_prefix=catalogue.id_prefix,
            mode=mode,
            gid=gid,
            on_settled=lambda key: self._running.cells.settled(key),
            event_log=self._event_log,
        )
        leftovers = Leftovers(directory, config.instance, self._store, reclaimer, mode=mode, gid=gid)
        leftovers.take_over(time.monotonic())
        self._server: Server | None = None

    @property
    def _running(self) -> Server:
        if self._server is None:
            raise InternalError("the server does not run yet")
        return self._server

    def serve(
        self,
        reloader: Reloader,
        started_s: float,
        signals: StartSignals,
        manager: ServiceManager,
        activated: ActivatedSocket | None,
    ) -> None:
        """Bind, say READY, answer requests until told to stop."""
        take_slices(SERVING_SLICE_NS)  # ZeroMQ's thread inherits it
        context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        socket: zmq.Socket[bytes] = context.socket(zmq.ROUTER)
        socket.setsockopt(zmq.LINGER, 200)
        socket.setsockopt(zmq.MAXMSGSIZE, MAX_REQUEST_BYTES)
        socket.setsockopt(zmq.SNDHWM, SEND_QUEUE)
        socket.setsockopt(zmq.RCVHWM, RECEIVE_QUEUE)
        self._manager = manager
        self._reloader = reloader
        self._owns_socket = activated is None
        quota = self._config.session_quota
        budget = self._store.books.budget_bytes
        events = EventPublisher(context, self._event_log.beat)
        self._pins = OperatorPins(self._store)
        queries = MapQueries(
            self._config,
            self._store,
            self._sessions,
            self._statistics,
            self._pins,
            epoch=self._epoch,
            event_log=self._event_log,
            events_path=events_path(self._socket_path),
        )
        server = self._server = Server(
            socket,
            self._store,
            self._sessions,
            self._statistics,
            queries,
            self._pins,
            reloader,
            self._privileges,
            self._event_log,
            epoch=self._epoch,
            quota_bytes=int(quota * budget) if quota <= 1 else int(quota),
            on_beat=self._beat,
        )
        try:
            self._watch_map(server)
            with contextlib.closing(ServingSignals()) as heard:
                server.watch(heard.fd, lambda: self._on_signals(heard, signals))
                if activated is not None:
                    socket.setsockopt(zmq.USE_FD, activated.fd)  # libzmq closes it, and leaves its file
                bind_socket(socket, self._socket_path, self._gid, own=self._owns_socket)
                step("daemon.bind")
                bind_socket(events.socket, events_path(self._socket_path), self._gid)
                server.guard()
                server.watch(events.fd, events.drain)
                self._event_log.send = events.send
                self._tell_epoch("started")
                self._store.loads.pool.start_one()
                _log.info(
                    "ready endpoint=%s instance=%s map=%s cells=%d budget_bytes=%d after_s=%.2f",
                    self._socket_path, self._config.instance, self._config.map_path,
                    len(self._catalogue), budget, time.monotonic() - started_s,
                )  # fmt: skip
                manager.ready(f"serving {len(self._catalogue)} cells")
                _settle_memory()
                if signals.reload_wanted:
                    self._reload()
                server.run()
        finally:
            manager.stopping("keeping memory for the next start" if signals.keep else "freeing memory")
            self._tell_epoch("stopping")
            self._event_log.send = nowhere
            events.close()
            socket.close()
            context.term()
            reloader.close()
            if self._map_watch is not None:
                self._map_watch.close()
            if self._owns_socket:
                remove_socket(self._socket_path)
            remove_socket(events_path(self._socket_path))

    def _watch_map(self, server: Server) -> None:
        if self._config.watch:
            watch = FileWatch(self._directories(self._store.catalogue.id_prefix))
            server.watch(watch.fd, lambda: watch.drain(time.monotonic()))
            self._map_watch = watch

    def _directories(self, id_prefix: str) -> set[str]:
        return directories_of(self._config.map_path, self._config.metadata, id_prefix)

    def _tell_epoch(self, what: str) -> None:
        catalogue = self._store.catalogue
        self._event_log.publish(
            Epoch, what, catalogue.map_version, len(catalogue), self._store.books.resident_count
        )

    def _beat(self) -> None:
        self._manager.beat(time.monotonic(), self._status)
        self._pins.keep(time.monotonic())
        self._running.watch_crowd(time.monotonic())
        if self._map_watch is not None and self._map_watch.due(time.monotonic()):
            self._reload()
        version = self._store.catalogue.map_version
        if version != self._identity.map_version:
            self._identity = dataclasses.replace(self._identity, map_version=version)
            self._statistics.update_identity(self._identity)

    def _status(self) -> str:
        books = self._store.books
        return status_line(
            resident=len({resident.key.cell_id for resident in books.residents()}),  # some have layers, too
            cells=len(self._store.catalogue),
            used_bytes=books.used_bytes,
            budget_bytes=books.budget_bytes,
            clients=len(self._sessions),
            failed=self._statistics.values["loads_failed"],
        )

    def _reload(self) -> None:
        """Read the map again because of a signal; the service manager waits for the end."""
        self._manager.reloading()
        self._reloader.ask(self._reloaded)

    def _reloaded(self, result: Catalogue | ShmmapError) -> None:
        if isinstance(result, ShmmapError):
            self._manager.reloaded(f"reload failed, the old map stays: {result.message}")
        else:
            if self._map_watch is not None:  # the metadata may name another directory now
                self._map_watch.follow(
                    directories_of(self._config.map_path, self._config.metadata, result.id_prefix)
                )
            self._manager.reloaded(f"map read again: {len(result)} cells")

    # --- signals ----------------------------------------------------------------------------------

    def _on_signals(self, heard: ServingSignals, signals: StartSignals) -> None:
        for number in heard.take():
            if number == RELOAD_SIGNAL:
                self._reload()
            elif number in (*STOP_SIGNALS, KEEP_SIGNAL) and not self._running.stopping:
                signals.keep = number == KEEP_SIGNAL
                _log.info(
                    "stopping on %s%s",
                    number.name,
                    ", the segments stay for the next start" if signals.keep else "",
                )
                if not signals.keep:
                    for again in STOP_SIGNALS:
                        signal.signal(again, self._quick_exit)
                self._running.stop(answer=not signals.keep)

    def _quick_exit(self, number: int, frame: object) -> None:
        """A second signal: take the names away and go.

        It may come in the middle of the first one's work, so it trusts the disk alone.
        """
        del number, frame
        directory, instance = self._directory, self._config.instance
        locks = (directory.path + lock_name(instance), lock_path(self._socket_path))
        ours = [events_path(self._socket_path), *([self._socket_path] if self._owns_socket else [])]
        take_away(directory, instance, (*ours, *locks))
        os._exit(0)  # the loaders die with this process

    def close(self, *, keep: bool) -> None:
        """Take every name away, or leave those of the segments to the next life."""
        self._store.close(keep=keep)
        self._statistics.close()
        if self._server is not None:
            self._server.close()


def _settle_memory() -> None:
    """Give back what reading the map took, and keep what stays out of the garbage collector's way."""
    gc.collect()
    gc.freeze()
    ctypes.CDLL(None).malloc_trim(0)
