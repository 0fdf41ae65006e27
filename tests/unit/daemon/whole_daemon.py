# SPDX-License-Identifier: Apache-2.0
"""The daemon as it is put together, with its sockets, turned by the test."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import zmq

from shmmap.daemon.assembly import Service
from shmmap.daemon.config import DaemonConfig
from shmmap.daemon.host.instance import InstanceLock, lock_path
from shmmap.daemon.host.scheduling import take_slices
from shmmap.daemon.host.signals import StartSignals
from shmmap.daemon.live_relay import NoLiveMaps
from shmmap.daemon.loading import parent_main
from shmmap.daemon.map.catalogue_reload import Reloader
from shmmap.daemon.map.catalogue_view import ViewOrigin
from shmmap.daemon.map_in_memory import MapInMemory
from shmmap.daemon.pins.watch import PinWatch
from shmmap.daemon.service_manager import ServiceManager
from shmmap.origin.map_directory import open_map
from shmmap.protocol import messages as m
from shmmap.protocol.codec import decode_reply, encode
from shmmap.segment.directory import ShmDirectory
from shmmap.segment.pins import prepare_process
from tests.support.forked_programs import fork_child

HELLO = m.Hello(1, *m.PROTOCOL_VERSION, "walker")
TIMEOUT_S = 240.0


class WholeDaemon:
    """The daemon with its sockets, turned by the test, and one client that has said hello.

    Parameters
    ----------
    map_path
        The map on disk.
    scratch
        A short path of a directory in shared memory: for the socket, segments and the cache.
    origin
        Where cells come from instead.
    **settings
        Of the daemon's configuration.
    """

    def __init__(
        self, map_path: Path, scratch: str, *, origin: ViewOrigin | None = None, **settings: Any
    ) -> None:
        prepare_process()
        self.endpoint = path = scratch + "/walk.sock"
        shm_dir = scratch + "/shm"
        Path(shm_dir).mkdir(exist_ok=True)
        config = DaemonConfig(map_path=str(map_path), instance="walk", shm_dir=shm_dir, workers=1, **settings)
        directory = ShmDirectory(shm_dir)
        origin = origin or open_map(str(map_path), cache_dir=scratch)
        catalogue, pins, early = origin.load(), PinWatch(directory), fork_child(parent_main.__name__)
        self.memory = MapInMemory(config, catalogue, directory, pins, path, 0o400, -1, early)
        signals = cast("StartSignals", SimpleNamespace(keep=False, reload_wanted=False))
        reloader = Reloader(origin, lambda: self.memory.cache.catalogue)
        self._lock = InstanceLock(lock_path(path))
        self.service = Service(
            config, self.memory, NoLiveMaps(), reloader, ServiceManager(), path, -1, signals, None, self._lock
        )
        self.service._listen()
        self._context: zmq.Context[Any] = zmq.Context()
        self._client = self._context.socket(zmq.DEALER)
        self._client.linger = 0
        self._client.connect(f"ipc://{path}")
        self.ask(HELLO)

    def turn(self) -> None:
        """Serve what has come, and do a round of all other work."""
        loop = self.service._loop
        loop.turn()
        while loop._round is not None:
            loop.turn()

    def turn_until(self, done: Callable[[], object]) -> None:
        end_s = time.monotonic() + TIMEOUT_S
        while not done():
            self.turn()
            assert time.monotonic() < end_s

    @contextlib.contextmanager
    def turning(self) -> Iterator[None]:
        """Turn in a thread meanwhile, for clients that wait in this one."""
        over = threading.Event()
        thread = threading.Thread(target=lambda: self.turn_until(over.is_set))
        thread.start()
        try:
            yield
        finally:
            over.set()
            thread.join()

    def ask(self, request: m.Request, during: contextlib.AbstractContextManager[None] | None = None) -> Any:
        """Send a request, turn until it is answered, inside of ``during``; returns the reply."""
        self.send(request)
        with during or contextlib.nullcontext():
            self.turn_until(self.answered)
        return self.received()

    def send(self, request: m.Request) -> None:
        """Send a request."""
        self._client.send(encode(request))

    def answered(self) -> bool:
        """Whether a reply has come."""
        return bool(self._client.poll(0))

    def received(self) -> Any:
        """Return the reply that has come."""
        return decode_reply(self._client.recv())

    def close(self, *, keep: bool = False) -> None:
        """End it once, when the loop has come to rest; ``keep`` leaves the segments to the next run."""
        if self._client.closed:
            return
        self._client.close()
        self.turn_until(lambda: self.service._loop._poll_timeout_s() > 0)
        self._context.term()
        self.service._end()
        self.memory.close(keep=keep)
        self._lock.release()
        take_slices(0)  # the loop's short turns are not for the tests that follow
