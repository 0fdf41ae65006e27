# SPDX-License-Identifier: Apache-2.0
"""Preparing a whole map: every cell to a worker, on all cores, until nothing is missing.

Workers are processes that the kernel ends with this one.  A worker that dies costs the cell it worked
on; another takes its place.  Stopped at any moment and started again, the run continues where it was:
what is in the cache is only looked at.
"""

from __future__ import annotations

import contextlib
import selectors
import socket
import subprocess
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Final, Protocol

import msgspec

from shmmap.errors import InternalError
from shmmap.layers.derive import Neighbour
from shmmap.layers.disk_cache import LayerCache
from shmmap.layers.spec import canonical_layers
from shmmap.layers.versions import MAX_NEIGHBOURS, LayerVersions
from shmmap.origin.catalogue import Catalogue
from shmmap.prepare import work
from shmmap.processes.packets import MAX_PACKET_BYTES
from shmmap.processes.start_child import how_ended, start_child

__all__ = ["Failure", "PrepareProgress", "Prepared", "prepare_map"]

_FAILED_STARTS: Final = 3


class PrepareProgress(Protocol):
    """Hears how far a run is."""

    def stage(self, name: str, total: int) -> None:
        """A stage of so many cells begins."""

    def advance(self, cells: int) -> None:
        """So many more cells are done."""

    def done(self, cells: int) -> None:
        """Everything is done."""


@dataclass(frozen=True, slots=True)
class Failure:
    """A layer that could not be prepared."""

    cell_id: str
    layer: str
    message: str


@dataclass(slots=True)
class Prepared:
    """What a run came to; layers are counted by how they got there, ``bytes`` are those of all of them."""

    cells: int
    kept: int = 0
    recognised: int = 0
    built: int = 0
    bytes: int = 0
    cache_bytes: int = 0
    failures: list[Failure] = field(default_factory=list)


@dataclass(eq=False, slots=True)
class _Worker:
    process: subprocess.Popen[bytes]
    channel: socket.socket
    task: work.CellWork | None = None
    ready: bool = False


class _Run:
    def __init__(
        self,
        tasks: Iterator[work.CellWork],
        total: int,
        cache: LayerCache,
        cache_dir: str,
        limit: int,
        progress: PrepareProgress,
    ) -> None:
        self._tasks = tasks
        self._again: list[work.CellWork] = []
        self._exhausted = False
        self._cache = cache
        self._arguments = [cache_dir, str(cache.limit_bytes)]
        self._limit = min(limit, total)
        self._progress = progress
        self._selector = selectors.DefaultSelector()
        self._workers: list[_Worker] = []
        self._failed_starts = 0
        self._added_bytes = 0
        self.result = Prepared(total)

    def run(self) -> None:
        try:
            while True:
                while len(self._workers) < self._limit and (task := self._next()) is not None:
                    self._start(task)
                if not any(worker.task for worker in self._workers):
                    break
                for key, _ in self._selector.select():
                    self._hear(key.data)
        finally:
            for worker in list(self._workers):
                self._end(worker)
            self._selector.close()

    def _next(self) -> work.CellWork | None:
        """The next cell: one given back by a worker that could not start, or a new one."""
        if self._again:
            return self._again.pop()
        if self._exhausted:
            return None
        task = next(self._tasks, None)
        self._exhausted = task is None
        return task

    def _start(self, task: work.CellWork) -> None:
        process, ours = start_child("shmmap.prepare.worker", *self._arguments, new_session=False)
        worker = _Worker(process, ours)
        self._workers.append(worker)
        self._selector.register(ours, selectors.EVENT_READ, worker)
        self._feed(worker, task)

    def _feed(self, worker: _Worker, task: work.CellWork | None) -> None:
        worker.task = task
        if task is not None:
            with contextlib.suppress(OSError):  # its end is reported by its channel
                worker.channel.send(work.encode(task))

    def _hear(self, worker: _Worker) -> None:
        try:
            data = worker.channel.recv(MAX_PACKET_BYTES)
            message = work.decode_done(data) if data else None
        except (OSError, msgspec.MsgspecError):
            message = None
        if message is None:
            self._died(worker)
        elif isinstance(message, work.Ready):
            worker.ready = True
            self._failed_starts = 0
        else:
            self._count(message, worker)
            self._feed(worker, self._next())

    def _count(self, done: work.CellDone, worker: _Worker) -> None:
        result = self.result
        for layer in done.layers:
            result.kept += layer.how == "kept"
            result.recognised += layer.how == "recognised"
            result.built += layer.how == "built"
            result.bytes += layer.bytes
            if layer.how == "built":
                self._added_bytes += layer.bytes
            elif layer.how == "failed" and worker.task is not None:
                result.failures.append(Failure(worker.task.cell_id, layer.layer, layer.message))
        if self._added_bytes > self._cache.limit_bytes // 16:
            self._added_bytes = 0
            self._cache.trim()
        self._progress.advance(1)

    def _died(self, worker: _Worker) -> None:
        task, ready = worker.task, worker.ready
        how = self._end(worker)
        if not ready:
            self._failed_starts += 1
            if self._failed_starts >= _FAILED_STARTS:
                raise InternalError(f"no worker can be started: {how}")
            if task is not None:
                self._again.append(task)
            return
        if task is not None:
            message = f"{task.source.name}: the worker died of it ({how})"
            self.result.failures += [Failure(task.cell_id, layer, message) for layer in task.layers]
            self._progress.advance(1)

    def _end(self, worker: _Worker) -> str:
        self._workers.remove(worker)
        self._selector.unregister(worker.channel)
        worker.channel.close()
        worker.process.kill()
        return how_ended(worker.process.wait())


def prepare_map(
    catalogue: Catalogue,
    layers: Sequence[str],
    *,
    cache_dir: str,
    cache_bytes: int,
    workers: int,
    progress: PrepareProgress,
) -> Prepared:
    """Have layers of every cell of a map in the disk cache.

    Parameters
    ----------
    layers
        Specs, in any form.
    cache_dir, cache_bytes
        Where, and at most how much; what was used least recently makes room.
    workers
        How many processes.

    Raises
    ------
    BadRequest
        If a layer is unknown.
    CannotWrite
        If nothing can be kept in ``cache_dir``.
    """
    names = canonical_layers(layers)
    cache = LayerCache(cache_dir, limit_bytes=cache_bytes)
    cache.make()
    versions = LayerVersions(lambda: catalogue)
    recognise = not cache.is_empty
    crowded: list[Failure] = []

    def tasks() -> Iterator[work.CellWork]:
        for index in range(len(catalogue)):
            cell_id = catalogue.id(index)
            around: dict[str, tuple[Neighbour, ...]] = {}
            for name in names:
                near = versions.neighbours(index, name)
                if len(near) > MAX_NEIGHBOURS:
                    message = f"{name} looks into more than {MAX_NEIGHBOURS} cells around one"
                    crowded.append(Failure(cell_id, name, message))
                else:
                    around[name] = tuple(
                        Neighbour.of(catalogue.id(i), catalogue.source(i), catalogue.box(i)) for i in near
                    )
            yield work.CellWork(
                index,
                cell_id,
                catalogue.source(index),
                catalogue.box(index),
                catalogue.frame_id,
                tuple(around),
                tuple(around.values()),
                recognise,
            )

    progress.stage("prepare", len(catalogue))
    run = _Run(tasks(), len(catalogue), cache, cache_dir, max(1, workers), progress)
    run.run()
    run.result.failures += crowded
    run.result.cache_bytes = cache.trim()
    progress.done(len(catalogue))
    return run.result
