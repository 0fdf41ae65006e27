# SPDX-License-Identifier: Apache-2.0
"""Worker of a slice: a process that makes layers of a published map's cells and sends their objects.

Points of the next cells are fetched while a cell is made.  Cells are made and sent as in
`shmmap.publishing.worker`, which reads files instead.
"""

from __future__ import annotations

import contextlib
import socket
import sys
from collections import OrderedDict, deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from typing import Final

import msgspec

from shmmap.errors import LoadFailed, MapDataError, MapMissing, Offline, ShmmapError
from shmmap.layers.build import cache_key
from shmmap.layers.contract import Box
from shmmap.layers.disk_cache import LayerCache
from shmmap.layers.points import LAYER
from shmmap.layers.sources import CellJob, CellSource, SourceReader, check_size
from shmmap.layers.spec import layer_spec
from shmmap.origin.remote.object_tier import KeptObjects, ObjectTier
from shmmap.origin.remote.published_object import (
    ObjectName,
    read_points,
    stamp_of,
    unpack_source,
)
from shmmap.origin.remote.zstd_frame import unpack_frame
from shmmap.prepare.task_pool import CellTask, Ready, decode_task, encode
from shmmap.processes.request_threads import leave
from shmmap.processes.start_child import MAX_PACKET_BYTES
from shmmap.publishing.messages import TASKS_AHEAD, CellSent, KnownObjects, NotSent, SliceSettings
from shmmap.publishing.worker import CellMaker, Sender, make_and_send, run_worker
from shmmap.segment.version import Source, Stamp

HELD_BYTES: Final = 128 << 20
"""Size limit of fetched objects held in memory, since the next cells use some of the same neighbours."""
_OF_THE_STORE: Final = (Offline.code, MapMissing.code)
"""Errors of the store, which end the run because any other cell would fail in the same way."""


class PublishedPoints(SourceReader):
    """Reads the points of a published map's cells; each layer is computed.

    Parameters
    ----------
    objects
        Reads objects, verified.
    threads
        Threads that fetch ahead.
    max_bytes
        Size limit of objects held in memory.
    """

    def __init__(self, objects: KeptObjects, threads: Executor, *, max_bytes: int = HELD_BYTES) -> None:
        self._objects = objects
        self._threads = threads
        self._max_bytes = max_bytes
        self._held: OrderedDict[ObjectName, Future[memoryview]] = OrderedDict()  # most recently used last
        self._bytes = 0

    def begin(self, sources: Sequence[Source]) -> None:
        """Begin to fetch the points of cells as far as memory allows, without waiting."""
        for source in sources:
            name = unpack_source(source)[LAYER].name
            if name not in self._held and self._bytes + name.size <= self._max_bytes:
                self._hold(name)

    def stamp(self, source: Source) -> Stamp:
        """Return the stamp in the source, whose objects never change."""
        return stamp_of(source)

    def read(self, source: Source, box: Box, needs: Sequence[str] | None) -> CellSource:
        """Read the columns that a layer needs of a cell's points.

        Raises
        ------
        LoadFailed
            The points are damaged.  A layer made without them would differ.
        Offline, MapMissing
            The points cannot be fetched.
        """
        name = unpack_source(source)[LAYER].name
        path = f"{self._objects.url}/{name.path}"
        try:
            unpacked = unpack_frame(self._frame(name), name.raw, name=path, exact=True)
            header, columns = read_points(unpacked, source, needs, name=path)
            check_size(sum(column.nbytes for column in header.columns), source.name)
        except MapDataError as error:
            raise LoadFailed(str(error), cell_id=source.name) from None
        return CellSource.of(header, columns, box)

    def _frame(self, name: ObjectName) -> memoryview:
        held = self._held.get(name) or self._hold(name)
        self._held.move_to_end(name)
        try:
            return held.result()
        except ShmmapError as error:
            del self._held[name]
            self._bytes -= name.size
            if not isinstance(error, MapDataError):
                raise
            return self._objects.read(name.sha256, name.size)  # retry, as the transfer may have damaged it

    def _hold(self, name: ObjectName) -> Future[memoryview]:
        held = self._held[name] = self._threads.submit(self._objects.read, name.sha256, name.size)
        self._bytes += name.size
        while self._bytes > self._max_bytes and len(self._held) > 1:
            oldest, _ = self._held.popitem(last=False)
            self._bytes -= oldest.size
        return held


def _tasks(channel: socket.socket, begin: Callable[[CellTask], None]) -> Iterator[CellTask]:
    """Yield the tasks of a worker; ``begin`` is called for the next ones while a task is being worked on."""
    waiting: deque[CellTask] = deque()
    while True:
        with contextlib.suppress(BlockingIOError):  # no further task has arrived yet
            while data := channel.recv(MAX_PACKET_BYTES, socket.MSG_DONTWAIT if waiting else 0):
                task = decode_task(data)
                begin(task)
                waiting.append(task)
            return
        yield waiting.popleft()


def _work(channel: socket.socket, argument: str) -> None:
    settings = msgspec.json.decode(argument, type=SliceSettings)
    store = settings.open_store()
    cache = tier = None
    if settings.cache_bytes:
        cache = LayerCache(settings.cache_dir, limit_bytes=settings.cache_bytes)
        tier = ObjectTier(settings.cache_dir, limit_bytes=settings.cache_bytes)

    def send(message: CellSent | NotSent) -> None:
        channel.send(encode(message))  # a whole packet, whatever other threads send

    sender = Sender(store, send, is_first=False)
    channel.send(encode(Ready()))
    with ThreadPoolExecutor(TASKS_AHEAD, "fetch") as fetching:
        points = PublishedPoints(KeptObjects(store, tier, keep=settings.keep_points), fetching)
        maker = CellMaker(KnownObjects(""), cache, keep=True, reader=points)

        def begin(task: CellTask) -> None:
            if not _is_kept(task, cache, points):
                near = {one.source: None for around in task.around for one in around}
                points.begin([task.source, *near])

        make_and_send(_tasks(channel, begin), maker, sender, ending=_OF_THE_STORE)


def _is_kept(task: CellTask, cache: LayerCache | None, points: PublishedPoints) -> bool:
    """Whether all layers of a cell are in the cache, so that its points are not needed."""
    if cache is None:
        return False
    keys = (
        cache_key(
            layer_spec(layer),
            CellJob(task.cell_id, task.source, task.box, task.frame_id, around, points),
        )
        for layer, around in zip(task.layers, task.around, strict=True)
    )
    return all(key is not None and cache.has(key) for key in keys)


def main(arguments: list[str]) -> int:
    """Run with ``CHANNEL_FD PARENT_PID SETTINGS``, the settings as JSON."""
    return run_worker(arguments, _work)


if __name__ == "__main__":
    leave(main(sys.argv[1:]))
