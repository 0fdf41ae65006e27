# SPDX-License-Identifier: Apache-2.0
"""Reads cells of a published map in a loader: objects are fetched concurrently, and verified before use."""

from __future__ import annotations

import math
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Final, TypeAlias

from shmmap.daemon.loading import worker_messages
from shmmap.errors import LoadFailed, MapDataError, Offline, ShmmapError
from shmmap.layers.contract import Box
from shmmap.layers.points import LAYER
from shmmap.layers.sources import CellJob, CellSource, SourceReader
from shmmap.layers.spec import LayerSpec, layer_spec
from shmmap.origin.remote.object_tier import KeptObjects, ObjectCounts, kept_objects
from shmmap.origin.remote.opened_store import ServedFrom, open_for_serving
from shmmap.origin.remote.published_object import (
    CellIdentity,
    LayerSource,
    ObjectName,
    read_points,
    stamp_of,
    unpack_source,
    write_segment,
)
from shmmap.origin.remote.transport import Incomplete, reporting_bytes
from shmmap.origin.remote.zstd_frame import DAMAGED, unpack_frame
from shmmap.segment.layout import SegmentHeader
from shmmap.segment.version import Source, Stamp

CONCURRENT_FETCHES: Final = 32
"""Limit of small objects that a loader fetches concurrently."""
MAX_BYTES: Final = 8 << 20
"""Limit of bytes of objects that are fetched or held at a time; a single object may be larger."""
SLOW_S: Final = 0.75
"""How long an object takes a place from others, seconds."""
FAILED_LATELY_S: Final = 60.0
"""How long an object that could not be fetched takes no place from others, seconds."""
REPORTED_S: Final = 0.05
"""Interval of reporting bytes while they come, seconds."""
_STACK_BYTES: Final = 512 << 10
"""Stack of a thread; small, because it counts in full towards the loader's memory limit."""


@dataclass(eq=False, slots=True)
class _Fetch:
    """An object that jobs need; ``frame`` is its data, or why the fetch failed; None until then.

    ``is_slow``: it has taken no place from others since it was found slow.  ``received``: bytes that have
    come over the link and were not reported with a job.
    """

    name: ObjectName
    jobs: set[int] = field(default_factory=set)
    begun: bool = False
    begun_s: float = 0.0
    is_slow: bool = False
    received: int = 0
    frame: memoryview | ShmmapError | None = None


Report: TypeAlias = Callable[[worker_messages.Arrived], None]
"""Sends a message to the daemon; called in any thread."""


def needed_bytes(job: worker_messages.Job) -> int:
    """Return the bytes of the objects that a job is made from."""
    if job.points and not job.neighbours:
        return 0
    return sum(name.size for name in needed_objects(layer_spec(job.layer), job))


class _Reports:
    """Reports bytes as they come, not more often than the daemon needs them."""

    def __init__(self, report: Report) -> None:
        self._report = report
        self._lock = threading.Lock()
        self._bytes, self._delays_s = 0, list[float]()
        self._sent_s = -math.inf

    def add(self, nbytes: int, delay_s: float | None) -> None:
        """Note bytes, and after how long their answer began if they are the first of it."""
        with self._lock:
            self._bytes += nbytes
            self._delays_s += [delay_s] if delay_s is not None else []
            if time.monotonic() >= self._sent_s + REPORTED_S:
                self._send()

    def fetched(self, number: int, nbytes: int) -> None:
        """Report that a job needs the origin no more, for which this many bytes have come."""
        with self._lock:
            self._send(number, nbytes)

    def _send(self, fetched: int = 0, fetched_bytes: int = 0) -> None:
        self._sent_s = time.monotonic()
        self._report(worker_messages.Arrived(self._bytes, tuple(self._delays_s), fetched, fetched_bytes))
        self._bytes, self._delays_s = 0, []


def _get(objects: KeptObjects, name: ObjectName) -> memoryview:
    """Return the frame of an object, verified.

    Raises
    ------
    MapDataError, MapMissing, Offline
        The object is damaged, missing, or unreachable.
    """
    try:
        return objects.read(name.sha256, name.size)
    except MapDataError:  # the data may have been damaged in transit
        return objects.read(name.sha256, name.size)


class ObjectFetcher:
    """Fetches the objects that jobs need, in threads; see `shmmap.layers.sources.Fetcher`.

    An object that two jobs need is fetched once.  As soon as the store does not answer for one object, all
    fetches that have not begun fail too: else the jobs would fail one after the other, each after its own
    timeout.  Objects that have been on their way for long, or have failed lately, take neither places nor
    bytes from others.

    Parameters
    ----------
    report
        Reports bytes as they come, and jobs that need the origin no more.
    """

    def __init__(self, objects: KeptObjects, report: Report = lambda _message: None) -> None:
        self._objects, self._reports = objects, _Reports(report)
        self._lock = threading.Lock()
        threading.stack_size(_STACK_BYTES)
        self._threads = ThreadPoolExecutor(
            2 * CONCURRENT_FETCHES + 1, "fetch"
        )  # the loader exits without waiting for these threads
        self.fd = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK | os.EFD_SEMAPHORE)
        self._fetches: dict[bytes, _Fetch] = {}
        self._needs: dict[int, tuple[bytes, ...]] = {}
        self._queue: deque[_Fetch] = deque()
        self._done: deque[int] = deque()
        self._at_work = 0
        self._under_way: set[_Fetch] = set()
        self._is_watched = False
        self._failed_s: dict[bytes, float] = {}
        self._held_bytes = 0

    def begin(self, number: int, spec: LayerSpec, job: CellJob) -> None:
        """Begin to fetch the objects that a layer of a cell is made from."""
        names = {name.sha256: name for name in needed_objects(spec, job)}
        with self._lock:
            self._forget_last()
            self._needs[number] = tuple(names)
            for digest, name in names.items():
                fetch = self._fetches.get(digest)
                if fetch is None:
                    fetch = self._fetches[digest] = _Fetch(name)
                    self._queue.append(fetch)
                fetch.jobs.add(number)
            self._finish_if_complete(number)
            self._begin_some()

    def take_done(self) -> int | None:
        """Return the number of a job whose objects have all been fetched, or have failed."""
        with self._lock:
            self._forget_last()
            try:
                os.eventfd_read(self.fd)
            except BlockingIOError:
                return None
            self._at_work = self._done.popleft()
            self._begin_some()
            return self._at_work

    def get(self, name: ObjectName) -> memoryview:
        """Return an object that was fetched for the current job, or fetch it now."""
        fetch = self._fetches.get(name.sha256)
        frame = fetch.frame if fetch is not None else None
        if isinstance(frame, ShmmapError):
            raise frame
        return frame if frame is not None else _get(self._objects, name)

    def _fetch(self, fetch: _Fetch) -> None:
        """Fetch an object, in a thread."""
        frame: memoryview | ShmmapError

        def arrived(nbytes: int) -> None:
            delay_s = time.monotonic() - fetch.begun_s if not fetch.received else None
            fetch.received += nbytes
            self._reports.add(nbytes, delay_s)

        try:
            with reporting_bytes(arrived):
                frame = _get(self._objects, fetch.name)
        except ShmmapError as error:
            frame = error
        except BaseException as error:  # noqa: BLE001  also panics: else the job would wait without bound
            frame = LoadFailed(f"{fetch.name.path}: {type(error).__name__}: {error}")
        with self._lock:
            self._under_way.discard(fetch)
            if isinstance(frame, Offline):
                self._failed_s[fetch.name.sha256] = time.monotonic()
            self._fetch_ended(fetch, frame)
            if isinstance(frame, Offline) and not isinstance(frame, Incomplete):
                while self._queue:
                    self._fetch_ended(self._queue.popleft(), frame)
            self._begin_some()

    def _watch(self) -> None:
        """Look for slow objects until nothing is queued, in a thread."""
        while True:
            time.sleep(SLOW_S / 4)
            with self._lock:
                self._begin_some()
                if not self._queue:
                    self._is_watched = False
                    return

    # --- under the lock ---------------------------------------------------------------------------

    def _forget_last(self) -> None:
        """Drop the objects of the last job, which is done."""
        for digest in self._needs.pop(self._at_work, ()):
            fetch = self._fetches[digest]
            fetch.jobs.discard(self._at_work)
            if not fetch.jobs:
                del self._fetches[digest]
                self._held_bytes -= fetch.name.size * (fetch.begun and not fetch.is_slow)
        self._at_work = 0
        self._begin_some()

    def _finish_if_complete(self, number: int) -> None:
        fetches = [self._fetches[digest] for digest in self._needs[number]]
        if all(fetch.frame is not None for fetch in fetches):
            self._reports.fetched(number, sum(fetch.received for fetch in fetches))
            for fetch in fetches:
                fetch.received = 0
            self._done.append(number)
            os.eventfd_write(self.fd, 1)

    def _begin_some(self) -> None:
        now_s = time.monotonic()
        self._find_slow(now_s)
        while self._queue:
            fetch = self._queue[0]
            slow = sum(one.is_slow for one in self._under_way)
            is_slow = now_s < self._failed_s.get(fetch.name.sha256, -math.inf) + FAILED_LATELY_S
            if is_slow and slow < CONCURRENT_FETCHES:
                fetch.is_slow = True
            elif len(self._under_way) - slow >= CONCURRENT_FETCHES:
                break
            else:
                is_much = self._held_bytes and self._held_bytes + fetch.name.size > MAX_BYTES
                if is_much and (len(self._under_way) > slow or self._done):
                    break  # held objects are freed when their job is done; without such a job, go on
                self._held_bytes += fetch.name.size
            self._queue.popleft()
            fetch.begun, fetch.begun_s = True, now_s
            self._under_way.add(fetch)
            self._threads.submit(self._fetch, fetch)
        if self._queue and not self._is_watched and any(not one.is_slow for one in self._under_way):
            self._is_watched = True
            self._threads.submit(self._watch)

    def _find_slow(self, now_s: float) -> None:
        """Take the places of objects that have been on their way for long, as far as others are queued."""
        slow = sum(one.is_slow for one in self._under_way)
        for fetch in self._under_way:
            if now_s >= fetch.begun_s + SLOW_S and not fetch.is_slow and self._queue:
                if slow >= CONCURRENT_FETCHES:
                    return
                slow += 1
                fetch.is_slow = True
                self._held_bytes -= fetch.name.size

    def _fetch_ended(self, fetch: _Fetch, frame: memoryview | ShmmapError) -> None:
        fetch.frame = frame
        for number in fetch.jobs:
            self._finish_if_complete(number)


def needed_objects(spec: LayerSpec, job: CellJob | worker_messages.Job) -> Iterator[ObjectName]:
    """Yield the objects that a layer of a cell is made from."""
    own = unpack_source(job.source)
    if job.ready:
        yield own[str(spec)].name
        return
    yield own[LAYER].name
    for near in job.neighbours:
        yield unpack_source(near.source)[LAYER].name


class PublishedReader(SourceReader):
    """Reads sources stored as objects of a published map."""

    fetcher: ObjectFetcher

    def __init__(
        self,
        served: ServedFrom,
        cache_dir: str,
        cache_bytes: int,
        report: Report = lambda _message: None,
    ) -> None:
        store = open_for_serving(served)
        self._url = store.url
        self._objects = kept_objects(store, cache_dir, cache_bytes, quiet=True)
        self._counts = ObjectCounts()
        self.fetcher = ObjectFetcher(self._objects, report)

    def stamp(self, source: Source) -> Stamp:
        """Return the stamp of a source, whose objects never change."""
        return stamp_of(source)

    def read(self, source: Source, box: Box, needs: Sequence[str] | None) -> CellSource:
        """Read the columns of a cell's points that a layer needs.

        Raises
        ------
        LoadFailed
            The objects are damaged: a layer made without them would not match its version.
        """
        name = unpack_source(source)[LAYER].name
        try:
            header, columns = read_points(self._unpacked(name), source, needs, name=self._path(name))
        except MapDataError as error:
            raise LoadFailed(str(error), cell_id=source.name) from None
        return CellSource.of(header, columns, box)

    def fill(
        self,
        spec: LayerSpec,
        job: CellJob,
        fd: int,
        *,
        reserve: Callable[[int], None] | None,
        warn: Callable[[str], None],
    ) -> SegmentHeader | None:
        """Write a published layer into a segment file; return None if it has to be computed."""
        del warn
        if not job.ready and spec.kind.name != LAYER:
            return None
        layer: LayerSource = unpack_source(job.source)[str(spec)]
        identity = CellIdentity(job.cell_id, job.box, job.frame_id, self.stamp(job.source))
        path = self._path(layer.name)
        header = write_segment(
            self._unpacked(layer.name), fd, identity, str(spec), name=path, reserve=reserve
        )
        if header.builder_version != layer.builder_version:
            raise MapDataError(
                f"builder version {header.builder_version}, the map says {layer.builder_version}",
                path=path,
                cause=DAMAGED,
            )
        return header

    def take_counts(self) -> tuple[int, ...]:
        """Return the counts of reads since the last call; empty if there were none."""
        before, self._counts = self._counts, self._objects.counts
        more = self._counts.since(before)
        return tuple(more) if any(more) else ()

    def _unpacked(self, name: ObjectName) -> bytes:
        return unpack_frame(self.fetcher.get(name), name.raw, name=self._path(name), exact=True)

    def _path(self, name: ObjectName) -> str:
        return f"{self._url}/{name.path}"
