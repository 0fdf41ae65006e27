# SPDX-License-Identifier: Apache-2.0
"""A loader worker: a separate process that reads files and fills segments, one job after another.

It is forked from a process with its imports done (`shmmap.daemon.loading.parent_main`).

The worker is expendable: a file that crashes or hangs it costs that one cell.  It cannot publish.  It fills
an unnamed file that the daemon has made, so that an orphaned worker leaves nothing behind.
"""

from __future__ import annotations

import contextlib
import errno
import os
import resource
import select
import signal
import socket
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, TypeAlias

from shmmap.compile_notices import watch
from shmmap.daemon.host.scheduling import weigh_less
from shmmap.daemon.loading import worker_messages
from shmmap.daemon.records import failure_code
from shmmap.errors import CannotWrite, MapDataError, Offline, Replaced, SegmentCorrupt, ShmmapError
from shmmap.failpoints import step
from shmmap.installed import RESTART
from shmmap.layers.build import Made, cache_key, keep_layer, make_layer
from shmmap.layers.disk_cache import LayerCache
from shmmap.layers.points import LAYER
from shmmap.layers.sources import FILES, CellJob, CellSource, Files, SourceReader, read_segment
from shmmap.layers.spec import LayerSpec, layer_spec
from shmmap.layers.versions import MAX_NEIGHBOURS
from shmmap.origin.map_layout import OpenedDirectories
from shmmap.processes.start_child import packet_buffer, receive_packet
from shmmap.quantities import format_bytes
from shmmap.segment.directory import ShmDirectory
from shmmap.segment.header import verify_file
from shmmap.segment.pins import LOADER_SLOT, lock_slot
from shmmap.segment.process_limits import limit_behind

_NICENESS: Final = 10  # a warm request never waits for a load
_LOWEST_NICENESS: Final = 19  # a load hardly waits for what is prepared
_PAGE_BYTES: Final = 4096

_Work: TypeAlias = tuple[worker_messages.Job, int]
"""A job, and the descriptor of the file that its segment is written to."""


class _Refused(Exception):
    """The daemon has no memory for the segment."""


@dataclass(frozen=True, slots=True)
class WorkerSettings:
    """Directory of segments; directory and size of the disk cache of finished layers (empty: no cache).

    ``origin`` contains the fields of `shmmap.origin.remote.opened_store.ServedFrom`; empty: cells are files.
    """

    shm_dir: str
    cache_dir: str = ""
    cache_bytes: int = 0
    origin: tuple[str, ...] = ()


@dataclass(eq=False, slots=True)
class _Worker:
    channel: socket.socket
    directory: ShmDirectory
    cache: LayerCache | None
    reader: SourceReader = FILES
    _fetching: dict[int, _Work] = field(default_factory=dict)
    _waiting: list[tuple[worker_messages.ToWorker, int]] = field(default_factory=list)
    _light: bool = False
    _buffer: bytearray = field(default_factory=packet_buffer)

    def run(self) -> None:
        """Work until the daemon closes the channel."""
        pidfd = os.pidfd_open(os.getpid())
        self._send(worker_messages.Ready(os.getpid()), pidfd)
        os.close(pidfd)
        while True:
            job, fd = self._next()
            if job is None:
                return
            self._light = self._light or weigh_less()
            if isinstance(job, worker_messages.Job):
                self._load(job, fd)
            elif isinstance(job, worker_messages.Prepare):
                os.setpriority(os.PRIO_PROCESS, 0, _LOWEST_NICENESS)
                self._prepare(job.job)
            elif isinstance(job, worker_messages.Check):
                self._check(job)
            elif isinstance(job, worker_messages.Root) and isinstance(self.reader, Files):
                opened = OpenedDirectories({job.path: fd} if fd >= 0 else {})
                self.reader = Files(opened.at, opened.named)

    def _next(self) -> tuple[worker_messages.ToWorker | None, int]:
        """Return the next message to act on and its descriptor; None when the channel is closed.

        A reader with a fetcher begins to fetch when a job arrives; jobs are done in the order their data
        arrives.
        """
        fetcher = self.reader.fetcher
        while fetcher is not None:
            if self._fetching and not self._waiting:
                both = select.poll()
                both.register(self.channel, select.POLLIN)
                both.register(fetcher.fd, select.POLLIN)
                ready = {fd for fd, _ in both.poll()}
                if fetcher.fd in ready and (number := fetcher.take_done()) is not None:
                    self._send(worker_messages.Begun(number))
                    return self._fetching.pop(number)
                if self.channel.fileno() not in ready:
                    continue
            message, fd = self._take()
            if isinstance(message, worker_messages.Job) and (message.neighbours or not message.points):
                self._fetching[message.number] = message, fd
                fetcher.begin(message.number, layer_spec(message.layer), self._cell(message))
                continue
            if isinstance(message, worker_messages.Job | worker_messages.Check):
                self._send(worker_messages.Begun(message.number))
            return message, fd
        return self._take()

    def _take(self) -> tuple[worker_messages.ToWorker | None, int]:
        return self._waiting.pop(0) if self._waiting else self._receive()

    def _receive(self) -> tuple[worker_messages.ToWorker | None, int]:
        """Return the next message and the descriptor sent with it; None when the channel is closed."""
        data, fd = receive_packet(self.channel, self._buffer)
        return (worker_messages.decode_to_worker(data) if data else None), fd

    def _send(self, message: worker_messages.FromWorker, fd: int | None = None) -> None:
        packet = worker_messages.encode(message)
        if fd is None:
            self.channel.send(packet)
        else:
            socket.send_fds(self.channel, [packet], [fd])

    def note_compiling(self, _module: str, _number: int, _of: int) -> None:
        """Report that this job takes longer than others of its kind."""
        self._send(worker_messages.Compiling())

    def _reserve(self, job: worker_messages.Job, nbytes: int) -> None:
        """Ask for more memory if the segment needs more than was reserved for it."""
        nbytes = -(-nbytes // _PAGE_BYTES) * _PAGE_BYTES
        if nbytes > job.granted:
            self._send(worker_messages.Need(job.number, nbytes))
            while True:
                answer, fd = self._receive()
                if answer is None:
                    raise BrokenPipeError
                if not isinstance(answer, worker_messages.Decision):
                    self._waiting.append((answer, fd))
                elif not answer.granted:
                    raise _Refused
                else:
                    job.granted = nbytes
                    return

    def _load(self, job: worker_messages.Job, fd: int) -> None:
        """Fill the file of a job, and close it before the end of the job is reported."""
        started_ns = time.monotonic_ns()
        with self._reporting_failures(job):
            try:
                _test_hook(job.source.name)
                step("worker.alloc")
                made = self._make_of_one_state(job, fd)
            finally:
                os.close(fd)
            header = made.header
            done = worker_messages.Done(
                number=job.number,
                header_bytes=header.header_bytes,
                points=header.rows,
                dropped=header.dropped_points,
                z_min=header.z_min,
                z_max=header.z_max,
                version=made.version,
                stamp=header.source.token,
                load_ns=time.monotonic_ns() - started_ns,
                warnings=tuple(self.reader.named(warning)[:500] for warning in made.warnings[:20]),
                neighbours=tuple(stamp.token for stamp in made.neighbours),
                cached=made.cached,
                outside=header.outside_points,
                objects=self.reader.take_counts(),
            )
            step("worker.pass")
            self._send(done)
            step("worker.passed")

    def _prepare(self, job: worker_messages.Job) -> None:
        """Compute a layer into the disk cache, unless it is there."""
        with self._reporting_failures(job):
            assert self.cache is not None  # noqa: S101  else nothing is prepared
            _test_hook(job.source.name)
            spec, cell = self._spec(job), self._cell(job)
            key = cache_key(spec, cell)
            kept = self.cache.size_of(key) if key is not None else 0
            nbytes = kept or keep_layer(
                spec, cell, self.cache, source=lambda: self._points_in_memory(job, spec)
            )
            self._send(worker_messages.Prepared(job.number, nbytes, computed=not kept))

    @contextlib.contextmanager
    def _reporting_failures(self, job: worker_messages.Job) -> Iterator[None]:
        """Report whatever ends a job before its result is sent."""
        try:
            yield
        except _Refused:
            self._fail(job, "over_budget", "it does not fit in the budget")
        except Offline as error:
            self._fail(job, error.code, error.message, unread=True)
        except Replaced:
            self._fail(job, "load_failed", f"{job.source.name}: {RESTART}")
        except CannotWrite as error:
            self._fail(job, error.code, error.message)
        except ShmmapError as error:
            self._fail(job, "load_failed", str(error))
        except OSError as error:
            limit = limit_behind(error) if error.errno == errno.EFBIG else None
            if limit is not None:  # the segment's file is limited, whatever the source is like
                self._fail(
                    job, "load_failed", f"{job.source.name}: its segment: {limit.message} ({limit.hint})"
                )
                return
            self._fail(job, failure_code(error), f"{job.source.name}: {error.strerror or error}", unread=True)
        except MemoryError:
            most = format_bytes(resource.getrlimit(resource.RLIMIT_DATA)[0])
            why = f"making {job.layer} takes more than the {most} of memory that a loader may use"
            self._fail(job, "load_failed", f"{job.source.name}: {why} (divide the map into smaller cells)")
        except Exception as error:  # noqa: BLE001  e.g. in another package's builder: it costs one cell
            self._fail(job, "load_failed", f"{job.source.name}: building {job.layer} failed: {error!r}")

    def _make_of_one_state(self, job: worker_messages.Job, fd: int) -> Made:
        """Fill the segment; once more if a file was rewritten while it was being read."""
        stamp = self.reader.stamp(job.source)
        try:
            return self._make(job, fd)
        except MapDataError as error:
            if error.cause != "changed" and self.reader.stamp(job.source) == stamp:
                raise
            os.ftruncate(fd, 0)
            return self._make(job, fd)

    def _make(self, job: worker_messages.Job, fd: int) -> Made:
        """Fill the segment."""
        spec = self._spec(job)
        return make_layer(
            spec,
            self._cell(job),
            fd,
            cache=self.cache,
            keep=job.layer != LAYER,  # only `shmmap prepare` stores the source: it is as quick to read
            source=lambda: self._points_in_memory(job, spec),
            reserve=lambda nbytes: self._reserve(job, nbytes),
        )

    def _spec(self, job: worker_messages.Job) -> LayerSpec:
        if len(job.neighbours) > MAX_NEIGHBOURS:
            raise MapDataError(
                f"{job.layer} looks into more than {MAX_NEIGHBOURS} cells around one",
                path=job.source.name,
                cause="unsupported_format",
                hint="use a smaller radius, or larger cells",
            )
        return layer_spec(job.layer)

    def _cell(self, job: worker_messages.Job) -> CellJob:
        return CellJob(job.cell_id, job.source, job.box, job.frame_id, job.neighbours, self.reader, job.ready)

    def _points_in_memory(self, job: worker_messages.Job, spec: LayerSpec) -> CellSource | None:
        """Return the cell's points from their segment, if that exists and has this state of the source."""
        if not job.points:
            return None
        try:
            with self.directory.opened(job.points) as fd:
                lock_slot(fd, LOADER_SLOT)
                source = read_segment(fd, job.box, spec.source_columns)
                return source if source.stamp.token == self.reader.stamp(job.source) else None
        except (OSError, SegmentCorrupt):
            return None

    def _check(self, job: worker_messages.Check) -> None:
        wrong, stamp = "", self.reader.stamp(job.source)
        try:
            if stamp != job.stamp:
                wrong = "its source has changed" if stamp is not None else "its source cannot be looked at"
            elif job.segment:
                with self.directory.opened(job.segment) as fd:
                    step("worker.check")
                    lock_slot(fd, LOADER_SLOT)
                    verify_file(fd)
        except (OSError, SegmentCorrupt) as error:
            wrong = str(error)
        self._send(worker_messages.Checked(job.number, self.reader.named(wrong)[:500], stamp))

    def _fail(self, job: worker_messages.Job, code: str, message: str, *, unread: bool = False) -> None:
        stamp, why = self.reader.stamp(job.source), self.reader.explain(job.source, message)
        objects = self.reader.take_counts()
        self._send(worker_messages.Failed(job.number, code, why[:4000], stamp, unread, objects))


def _test_hook(path: str) -> None:
    """Crash or hang on a named file, for the tests of that (``SHMMAP_TEST_WORKER``).

    Or treat the origin as unreachable while a file of that name plus ``.offline`` exists.
    """
    what, _, name = os.environ.get("SHMMAP_TEST_WORKER", "").partition(":")
    if what == "offline" and os.path.exists(path + ".offline"):
        raise Offline(f"{path}: its origin does not answer")
    if name and Path(path).name == name:
        if what == "crash":
            os.kill(os.getpid(), signal.SIGSEGV)
        elif what == "hang":
            signal.pause()


def limit_memory(nbytes: int) -> None:
    """Limit this process's memory: exceeding the limit is an error of the current cell."""
    _, hard = resource.getrlimit(resource.RLIMIT_DATA)
    if hard != resource.RLIM_INFINITY:
        nbytes = min(nbytes, hard)
    resource.setrlimit(resource.RLIMIT_DATA, (nbytes, nbytes))


def work(channel: socket.socket, settings: WorkerSettings) -> int:
    """Work in this process until the daemon closes the channel; return the exit code."""
    os.nice(_NICENESS)
    cache = None
    if settings.cache_dir and settings.cache_bytes:
        cache = LayerCache(settings.cache_dir, limit_bytes=settings.cache_bytes)
    reader: SourceReader = FILES
    if settings.origin:
        from shmmap.daemon.loading.published_reader import PublishedReader
        from shmmap.origin.remote.opened_store import ServedFrom

        served = ServedFrom.from_words(*settings.origin)

        def report(message: worker_messages.Arrived) -> None:
            with contextlib.suppress(OSError):  # the daemon has ended, or wants this process no more
                channel.send(worker_messages.encode(message))

        reader = PublishedReader(served, settings.cache_dir, settings.cache_bytes, report)
    worker = _Worker(channel, ShmDirectory(settings.shm_dir), cache, reader)
    watch(worker.note_compiling)
    with contextlib.suppress(BrokenPipeError, ConnectionResetError):
        worker.run()
    return 0
