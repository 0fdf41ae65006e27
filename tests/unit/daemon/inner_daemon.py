# SPDX-License-Identifier: Apache-2.0
"""The daemon's parts joined as the daemon joins them, without its socket: requests go in, replies come out.

Files are real, segments are real, loaders are real processes.
"""

from __future__ import annotations

import contextlib
import math
import os
import shutil
import signal
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec

from shmmap.daemon.config import DaemonConfig
from shmmap.daemon.loading import parent_main
from shmmap.daemon.loading.link import Link
from shmmap.daemon.loading.worker_messages import Job
from shmmap.daemon.map_in_memory import FROM_FILES, FetchedFrom, MapInMemory
from shmmap.daemon.pins.watch import PinWatch
from shmmap.daemon.requests.cell_requests import CellRequests
from shmmap.daemon.requests.map_queries import MapQueries
from shmmap.daemon.requests.operators.operator_pins import OperatorPins
from shmmap.daemon.transport.connection import Connection
from shmmap.daemon.transport.sessions import Session
from shmmap.origin.catalogue import Catalogue
from shmmap.origin.map_directory import open_map
from shmmap.protocol.codec import decode_reply
from shmmap.protocol.messages import (
    Area,
    BoxMessage,
    Cells,
    CellsPage,
    Differential,
    ListCells,
    Selected,
)
from shmmap.protocol.rows import CellRow
from shmmap.segment.directory import ShmDirectory
from shmmap.segment.pins import prepare_process
from tests.support import connections
from tests.support.daemon_process import stop
from tests.support.forked_programs import fork_child

TIMEOUT_S = 240.0
FETCHED_BYTES = 100_000
EVERYWHERE = BoxMessage(-1e4, -1e4, 1e4, 1e4)


def names(reply: Cells) -> list[str]:
    """File names of the cells that a reply has, in its order."""
    return [Path(cell.id).name for cell in reply.cells]


def joined(parts: list[Cells]) -> Cells:
    """Return the replies to one request as one."""
    return msgspec.structs.replace(
        parts[-1],
        map_version=parts[0].map_version,
        cells=tuple(cell for part in parts for cell in part.cells),
        pending=tuple(cell for part in parts for cell in part.pending),
        failed=tuple(cell for part in parts for cell in part.failed),
    )


def finish(work: Iterator[None] | None) -> None:
    """Do all steps of something."""
    for _ in work or ():
        pass


class InnerDaemon:
    """What the daemon has in memory, and requests over one map; ``offset_s`` moves its clock ahead.

    With a ``link``, each job that reads a cell uses it, although the cells are files; ``jobs`` are all.
    """

    def __init__(
        self,
        map_path: str,
        *,
        cache_dir: str,
        quota_bytes: int = 64 << 20,
        workers: int = 1,
        load_timeout_s: float = 300.0,
        prefetch_share: float = 0.0,
        link: Link | None = None,
        **settings: Any,
    ) -> None:
        prepare_process()
        self.shm_dir = tempfile.mkdtemp(prefix="shmmap-inner-", dir="/dev/shm")
        self.directory = ShmDirectory(self.shm_dir)
        self.origin = open_map(map_path, cache_dir=cache_dir)
        values: dict[str, Any] = {"budget_bytes": 64 << 20, "outage_tolerance_s": 10.0, **settings}
        if "prepare" in settings:
            values["cache_dir"] = cache_dir
        config = DaemonConfig(
            map_path=map_path,
            instance="inner",
            shm_dir=self.shm_dir,
            workers=workers,
            load_timeout_s=load_timeout_s,
            prefetch_share=prefetch_share,
            **values,
        )
        self.offset_s = 0.0
        self.stopped_at_s: float | None = None
        pins = PinWatch(self.directory, events=True)
        self.jobs: list[Job] = []
        fetched = FetchedFrom((), 1, link, self._needed_bytes) if link else FROM_FILES
        catalogue, early = self.origin.load(), fork_child(parent_main.__name__)
        try:
            self.memory = memory = MapInMemory(
                config, catalogue, self.directory, pins, "", 0o400, -1, early, fetched, clock=self.now_s
            )
        except BaseException:
            if early is not None:
                early[1].close()
                early[0].wait(TIMEOUT_S)
            self.directory.close()
            os.rmdir(self.shm_dir)
            raise
        self.cache, self.scheduler, self.sessions = memory.cache, memory.scheduler, memory.sessions
        self.statistics, self.event_log, self.watched = memory.statistics, memory.event_log, memory.watched
        self.map_switch, self.waiting = memory.map_switch, memory.waiting
        self.ledger, self.reclaimer, self.evictor = (
            self.cache.ledger,
            self.cache.reclaimer,
            self.cache.evictor,
        )
        self.loads, self.pool = self.scheduler.loads, self.scheduler.pool
        self.hold_answers = False
        self.due: list[Iterator[None]] = []
        self.replies: list[tuple[Session, Any]] = []
        self.cells = CellRequests(
            self.cache,
            self.scheduler,
            self.waiting,
            quota_bytes=quota_bytes,
            due=self._answer,
            clock=self.now_s,
        )
        pins_of_operators = OperatorPins(self.cache, self.scheduler)
        self.queries = MapQueries(
            config,
            self.cache,
            self.sessions,
            pins_of_operators,
            self.map_switch,
            self.loads,
            self.event_log,
        )

    def _answer(self, _connection: Connection, answer: Iterator[None]) -> None:
        """An answer is due, in the next turn; kept while `hold_answers`."""
        self.due.append(answer)

    def _needed_bytes(self, job: Job) -> int:
        self.jobs.append(job)
        return 0 if job.points else FETCHED_BYTES

    def ask(self, session: Session, message: Area | Differential | Selected) -> None:
        """Begin to serve a request for cells, and do what of it needs no waiting."""
        self.cells.serve(session, message)

    def now_s(self) -> float:
        """Return the time of the daemon's clock."""
        now_s = time.monotonic() if self.stopped_at_s is None else self.stopped_at_s
        return now_s + self.offset_s

    def stop_clock(self) -> None:
        """From now on only ``offset_s`` moves the daemon's clock."""
        self.stopped_at_s = time.monotonic()

    def session(self, name: str = "") -> Session:
        """Open a session of a process that is not watched."""
        connection = connections.of(reply=lambda data: self.replies.append((session, decode_reply(data))))
        session = self.sessions.open(connection, name, self.now_s())
        return session

    def turn(self, timeout_s: float = 0.02) -> None:
        """One turn of the serving loop."""
        for fd in self.watched.poll(timeout_s):
            callback = self.watched.callbacks.get(fd)
            if callback is not None:
                callback()
        now_s = self.now_s()
        self.scheduler.lost.end_overdue(now_s)
        self.cache.survey.run_step(now_s)
        self.scheduler.free(now_s)
        self.scheduler.pump(now_s)
        while self.scheduler.unfinished:
            self.scheduler.pump(now_s)
        self.cells.answer_due(now_s)
        self.map_switch.run_step(now_s)
        if self.scheduler.prefetcher.next_s <= now_s:
            self.scheduler.prefetcher.run_step(now_s)
        preparer = self.memory.preparer
        if preparer is not None and preparer.next_s <= now_s:
            preparer.run_step(now_s)
        if self.evictor.next_s <= now_s:
            self.evictor.run_step(now_s)
        while not self.hold_answers and self.due:
            finish(self.due.pop(0))
        self.cache.events.flush()

    def run_until(self, done: Callable[[], object]) -> None:
        """Turn until ``done()``."""
        end_s = time.monotonic() + TIMEOUT_S
        while not done():
            self.turn()
            assert time.monotonic() < end_s, "the daemon never came to it"

    def run_until_nothing_waits(self) -> None:
        """Turn until no request waits; nothing may be kept for any."""
        self.run_until(lambda: self.cells.next_s() == math.inf)
        assert (list(self.ledger.needed()), self.waiting._of_load, len(self.cells)) == ([], {}, 0)

    def reply_to(self, request: int) -> Any:
        """Run until this request is answered; returns the reply."""
        found: list[Any] = []

        def answered() -> bool:
            found.extend(reply for _, reply in self.replies if reply.request == request)
            return bool(found)

        self.run_until(answered)
        return found[0]

    def cells_of(self, request: int) -> Cells:
        """Run until this request is answered with cells; returns them."""
        reply = self.reply_to(request)
        assert isinstance(reply, Cells)
        return reply

    def cells_for(self, message: Area | Differential | Selected, session: Session | None = None) -> Cells:
        """Serve a request of a session, by default a new one, until it is answered; return the cells."""
        self.ask(session or self.session(), message)
        return self.cells_of(message.request)

    def parts_for(self, message: Area | Differential, session: Session | None = None) -> Iterator[Cells]:
        """Serve a request reply after reply."""
        session, start = session or self.session(), ""
        while True:
            known = len(self.replies)
            self.ask(session, msgspec.structs.replace(message, start=start))
            self.run_until(lambda known=known: len(self.replies) > known)  # type: ignore[misc]
            (part,) = (reply for _, reply in self.replies[known:] if reply.request == message.request)
            yield part
            if not (start := part.next):
                return

    def all_for(self, message: Area | Differential, session: Session | None = None) -> Cells:
        """Serve a request reply after reply, then again until nothing is pending; return all cells."""
        while True:
            whole = joined(list(self.parts_for(message, session)))
            if not whole.pending:
                return whole
            self.turn()

    def everything(self, request: int = 1) -> Cells:
        """Ask for all cells and wait for them."""
        return self.all_for(Area(request, EVERYWHERE, wait=600.0))

    def listed(self) -> list[CellRow]:
        """All that is in memory, as clients list it."""
        rows: list[CellRow] = []
        start: int | None = 0
        while start is not None:
            page = self.queries.answer(ListCells(1, start))
            assert isinstance(page, CellsPage)
            rows += page.rows
            start = page.next
        return rows

    def path_of(self, segment: str) -> str:
        """Path of a segment that a reply names."""
        return f"{self.shm_dir}{self.cache.segment_prefix}{segment}"

    @contextlib.contextmanager
    def loaders_standing_still(self) -> Iterator[list[int]]:
        """Stop the loaders (one is started if there is none); when the block ends they go on."""
        if not len(self.pool):
            self.pool.start_one()
        self.run_until(lambda: all(worker.ready for worker in self.pool))
        pids = [worker.pid for worker in self.pool]
        for pid in pids:
            stop(pid)
        try:
            yield pids
        finally:
            for pid in pids:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGCONT)

    def reload(self) -> Catalogue:
        """Read the map again and serve what it is now."""
        new = self.origin.load(fresh=True)
        self.map_switch.switch(new, new.changes_from(self.cache.catalogue))
        self.scheduler.map_changed()
        self.cache.events.flush()
        return new

    def sleeps(self) -> bool:
        """Whether the loop has nothing to do for loads and memory until something arrives or time passes."""
        return self.scheduler.next_event_s() > self.now_s()

    def close(self) -> None:
        """End everything and remove the directory; the loop comes to rest before, whatever a test did."""
        for session in list(self.sessions):
            self.sessions.close(session)
        self.run_until(self.sleeps)
        self.memory.close(keep=True)
        self.directory.close()
        shutil.rmtree(self.shm_dir)


Inner = Callable[..., InnerDaemon]
"""The fixture that makes them."""
