# SPDX-License-Identifier: Apache-2.0
"""One run of the daemon: take the lock, open the map, serve, stop.

The order matters.  The lock comes first, because binding would steal a live socket.  The previous run's
segments are taken over before anything is published.  READY is reported once requests are answered.  At the
end, every name is removed before the lock is released.

**Stopping empties, restarting keeps warm.** SIGTERM and SIGINT stop the daemon and free all memory.
SIGUSR1 stops it and leaves the segments to the next run, which adopts them
(`shmmap.daemon.loading.adoption`).  The same happens after a crash, or when a defect ends the daemon.
Clients that wait for an answer get it from the next run, too.  A SIGTERM after a SIGUSR1 changes nothing, so
a restart can be announced before a service manager sends its SIGTERM.  systemd stops a unit in the same way
for ``restart`` and ``stop``, but meanwhile its job list shows which of them it is.  ``+`` gives the line the
right to query that list and to send the signal; in a user's own unit ``systemctl --user`` has that right
anyway::

    ExecStop=-+/bin/sh -c 'systemctl list-jobs --plain --no-legend | \
        grep -Eq "^ *[0-9]+ +%n +restart " && kill -USR1 $MAINPID'

Elsewhere: ``kill -USR1`` before the next start, ``docker run --stop-signal USR1``.
"""

from __future__ import annotations

import atexit
import contextlib
import dataclasses
import logging
import os
import sys
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

from shmmap.daemon.assembly import Service
from shmmap.daemon.config import DaemonConfig, option_of
from shmmap.daemon.events.log import events_path
from shmmap.daemon.host.instance import InstanceLock, lock_path, make_runtime_dir, stopped_early
from shmmap.daemon.host.signals import StartSignals, ignore_signals
from shmmap.daemon.live_relay import LiveEvents, LiveRelay, NoLiveMaps
from shmmap.daemon.loading.prepared_parent import fork_early
from shmmap.daemon.map.catalogue_reload import Reloader
from shmmap.daemon.map.catalogue_view import ViewOrigin
from shmmap.daemon.map_in_memory import FROM_FILES, FetchedFrom, MapInMemory, place_live_maps
from shmmap.daemon.prerequisites import (
    access_of_segments,
    check_file_size_limit,
    choose_pins,
    give_back_large_tables,
    import_ahead,
    raise_descriptor_limit,
)
from shmmap.daemon.requests.operators.operator_requests import Authorization
from shmmap.daemon.service_manager import (
    ActivatedSocket,
    ServiceManager,
    asking_for_time,
    notify,
    take_activated_socket,
)
from shmmap.daemon.transport.socket_file import refuse_taken
from shmmap.dividing.served_cloud import find_origin
from shmmap.errors import CannotWrite, ConfigError, Replaced, ShmmapError
from shmmap.failpoints import step
from shmmap.installed import remember_modules
from shmmap.lazy_imports import needed_packages
from shmmap.live_settings import state_directory
from shmmap.logfmt import log, set_up_logging
from shmmap.origin.catalogue import NoMap
from shmmap.origin.catalogue_bytes import default_cache_directory
from shmmap.origin.map_layout import absolute_path
from shmmap.origin.remote.store import is_published, is_url, read_url
from shmmap.segment.directory import ShmDirectory
from shmmap.segment.pins import prepare_process
from shmmap.statistics.exclusive_name import refuse_second
from shmmap.version import build_version

if TYPE_CHECKING:
    from shmmap.daemon.map.published_origin import PublishedOrigin

LIVE_S: Final = 1.5
"""How long points wait for live maps at the start: faulty live maps must not prevent serving points."""
LIVE_ALONE_S: Final = 120.0
"""How long the daemon waits for live maps if it serves nothing else: kernels are compiled meanwhile."""
_NOT_PUBLISHED: Final = {
    "metadata": "",
    "unit": "",
    "vertical_unit": "",
    "drop_noise": "",
    "watch": "--poll SECONDS looks for new versions",
    "prepare": "add layers with `shmmap prepare URL --shards 1/1` and `shmmap publish URL --join RUN`",
}
"""Settings that a published map does not have, and what to do instead."""
SWITCH_S: Final = 0.0005
"""How long a thread that reloads the map may keep the serving loop waiting for the interpreter lock."""


def run(config: DaemonConfig) -> int:
    """Serve until SIGTERM or SIGINT; return the exit code.

    Raises
    ------
    MapMissing, MapDataError
        The map does not exist, or cannot be served.
    ConfigError
        No map is named, or a setting cannot be used on this machine.
    InstanceBusy
        Another daemon runs this instance.
    CannotStart
        A required resource is unavailable: full, not there yet, or in use.
    """
    set_up_logging(getattr(logging, config.log_level.upper()))
    if not config.map_path and not config.live:
        raise ConfigError(
            "no map is named",
            key="map_path",
            hint="give `shmmap serve MAP`, or set map_path; --live NAME for a live map alone",
        )
    if is_url(config.map_path):
        read_url(config.map_path)  # check before logging: an invalid URL may contain a secret
    log.info(
        "starting", version=build_version(), instance=config.instance, map=config.map_path, pid=os.getpid()
    )
    remember_modules()
    early = fork_early()
    prepare_process()
    give_back_large_tables()
    import_ahead()
    raise_descriptor_limit()
    sys.setswitchinterval(SWITCH_S)
    activated = take_activated_socket()
    with contextlib.ExitStack() as stack:
        signals = StartSignals()
        path = _socket_path(config, activated)
        gid, mode = access_of_segments(config)
        make_runtime_dir(Path(path).parent, gid)
        directory = ShmDirectory(config.shm_dir)
        stack.callback(directory.close)
        pins = choose_pins(directory)
        elsewhere = _published(config)
        if elsewhere is not None:
            stack.callback(_end_threads, elsewhere)
        origin: ViewOrigin = elsewhere if elsewhere is not None else _origin_here(config)
        cache_dir = absolute_path(config.cache_dir or default_cache_directory())
        config = dataclasses.replace(  # loaders and clients run in other directories
            config, map_path=origin.path, shm_dir=directory.path, cache_dir=cache_dir
        )
        with signals.held():
            lock = InstanceLock(lock_path(path), partial(_refuse_taken, path, activated))
            stack.callback(lock.release)
            # two runtime directories may share a directory of segments
            refuse_second(directory, config.instance)
            stack.callback(ignore_signals)  # without the lock, the names are not ours to remove
            step("daemon.lock")
            stack.push(partial(stopped_early, signals, directory, config.instance))
        started_s = time.monotonic()
        with asking_for_time(notify, "reading the map"):
            catalogue = origin.load()
        for problem in catalogue.problems:
            log.warning("problem in the map", what=problem)
        with signals.held():
            fetched = _fetched_from(elsewhere, config) if elsewhere is not None else FROM_FILES
            memory = MapInMemory(config, catalogue, directory, pins, path, mode, gid, early, fetched)
            stack.push(partial(_close, memory, signals))
        ledger = memory.cache.ledger
        check_file_size_limit(ledger.budget_bytes)
        del catalogue  # a reload replaces it
        live = _live_maps(config, memory, gid)
        stack.push(partial(_close, live, signals))
        reloader = Reloader(origin, lambda: memory.cache.catalogue)
        service = Service(
            config,
            memory,
            live,
            reloader,
            ServiceManager(),
            path,
            gid,
            signals,
            activated,
            lock,
            elsewhere,
        )
        service.run(started_s)
    log.info("stopped", instance=config.instance)
    if service.replaced and signals.keep:
        return Replaced.exit_code  # not 0: the service manager then starts the new version
    return CannotWrite.exit_code if live.unsaved else 0


def _origin_here(config: DaemonConfig) -> ViewOrigin:
    """Return the local or remote origin of the cells."""
    if not config.map_path:
        return NoMap()
    return find_origin(
        config.map_path,
        metadata=config.metadata,
        strict=config.strict,
        cache_dir=config.cache_dir,
        unit=config.unit,
        vertical_unit=config.vertical_unit,
        drop_noise=config.drop_noise,
        notify=notify,
    )


def _published(config: DaemonConfig) -> PublishedOrigin | None:
    """Open a published map, given as a URL or a directory with a file CURRENT; None if the map is files."""
    path = config.map_path
    if config.trust and not is_url(path) and not os.path.isdir(path):
        raise ConfigError(
            "--trust is for a published map",
            key="trust",
            hint="name its URL or directory; `shmmap publish MAP URL --sign KEYDIR` makes one",
        )
    if not config.trust and not is_published(path):
        return None
    for name, hint in _NOT_PUBLISHED.items():
        if getattr(config, name):
            raise ConfigError(f"{option_of(name)} is not for a published map", key=name, hint=hint)
    with needed_packages("a published map"):
        from shmmap.daemon.map.published_origin import PublishedOrigin
        from shmmap.origin.remote.opened_store import ServedFrom
        from shmmap.origin.remote.store import may_be_plain

        insecure_http = may_be_plain(path, insecure_http=config.insecure_http, trust=config.trust)
        return PublishedOrigin(
            ServedFrom(path, insecure_http, config.instance_credentials),
            instance=config.instance,
            state_dir=state_directory(config.instance),
            cache_dir=absolute_path(config.cache_dir or default_cache_directory()),
            cache_bytes=config.cache_bytes,
            catalogue_bytes=config.catalogue_budget_bytes,
            poll_s=config.poll_s,
            accept_version=config.accept_version,
            trust=absolute_path(config.trust) if config.trust else "",
        )


def _fetched_from(origin: PublishedOrigin, config: DaemonConfig) -> FetchedFrom:
    from shmmap.daemon.loading.link import Link
    from shmmap.daemon.loading.published_reader import CONCURRENT_FETCHES, needed_bytes

    link = None
    if is_url(origin.path):
        cap_bytes_s = config.link_rate * 1e6 / 8
        link = Link(origin.arrivals, cap_bytes_s=cap_bytes_s, metered=config.metered)
    return FetchedFrom(origin.served.words(), CONCURRENT_FETCHES, link, needed_bytes)


def _end_threads(origin: PublishedOrigin) -> None:
    """End the threads that query the origin; if one still waits, skip the interpreter's shutdown."""
    if not origin.close():
        atexit.register(_leave)


def _leave() -> None:
    logging.shutdown()
    os._exit(0)


def _refuse_taken(path: str, activated: ActivatedSocket | None) -> None:
    """Refuse sockets that other programs use, before the map is read."""
    if activated is None:
        refuse_taken(path)
    refuse_taken(events_path(path))


def _close(
    closed: MapInMemory | LiveRelay | NoLiveMaps,
    signals: StartSignals,
    kind: type[BaseException] | None,
    *_: object,
) -> None:
    """Close; if a defect ended this run, leave memory to the next run, as after a crash.

    A defect in it is logged, so that the next step of the close runs as it should.
    """
    try:
        closed.close(keep=signals.keep or (kind is not None and not issubclass(kind, ShmmapError)))
    except Exception:  # noqa: BLE001  the steps that follow free memory and names
        log.exception("not closed as it should be", what=type(closed).__name__)


def _live_maps(config: DaemonConfig, memory: MapInMemory, gid: int) -> LiveRelay | NoLiveMaps:
    """Start the process that keeps the live maps, and wait for it up to a time limit."""
    if not config.live:
        return NoLiveMaps()
    mappers, ledger = Authorization(config.live_group, "live_group"), memory.cache.ledger
    begin = place_live_maps(
        config.live,
        instance=config.instance,
        cells=memory.directory,
        cells_budget_bytes=ledger.budget_bytes if config.map_path or config.budget_bytes else 0,
        share_bytes=memory.live_bytes,
        shm_dir=config.live_shm_dir,
        budget_bytes=config.live_budget_bytes,
        gid=gid,
        marks_gid=mappers.gid,
    )
    events = LiveEvents(memory.event_log, memory.statistics)
    relay = LiveRelay(begin, memory.watched, mappers.allow, events)
    try:
        relay.start()
        relay.wait_until_serving(LIVE_S if config.map_path else LIVE_ALONE_S, alone=not config.map_path)
    except BaseException:
        relay.close(keep=True)
        raise
    return relay


def _socket_path(config: DaemonConfig, activated: ActivatedSocket | None) -> str:
    """Return the path of the request socket; a socket that was passed to the daemon takes precedence."""
    if activated is None:
        return config.socket()
    if config.endpoint and config.socket() != activated.path:
        raise ConfigError(
            f"endpoint is {config.socket()}, but the service manager listens at {activated.path}",
            key="endpoint",
            hint="remove the setting, or change ListenStream= of the .socket unit",
        )
    return activated.path
