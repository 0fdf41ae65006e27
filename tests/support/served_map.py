# SPDX-License-Identifier: Apache-2.0
"""A live map as its worker serves it, without processes: requests are handed in, answers are kept."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from shmmap.chunks.marks import Marks, encode_marks
from shmmap.chunks.voxels import voxels_of
from shmmap.live_messages import Ask
from shmmap.live_settings import LiveSettings
from shmmap.live_worker.chunk_memory import ChunkMemory, live_prefix
from shmmap.live_worker.disk.folder import Folder
from shmmap.live_worker.disk.map_database import MapDatabase
from shmmap.live_worker.marks_directory import MarksDirectory
from shmmap.live_worker.paging.residency import Limits
from shmmap.live_worker.served_map import ServedMap
from shmmap.protocol import live as messages
from tests.support.daemon_process import Deadline
from tests.support.live_drive import RESOLUTION, SETTINGS, Voxel


class Served:
    """One run of a map's worker.

    Attributes
    ----------
    shm : Path
        Directory of its shared memory.
    answers : dict
        By ticket; each asks under a number of its own, and the ticket is the same.
    ended : bool
        Whether this run is over.
    """

    def __init__(self, shm: Path, disk: Path, budget_bytes: int = 10**9, **limits: Any) -> None:
        self.now_s = 0.0
        self.shm = shm
        self.answers: dict[int, Any] = {}
        self.ended = False
        self._files = 0
        self._folder = Folder(disk)
        self.marks = MarksDirectory(str(shm / "marks"))
        settings = LiveSettings("lidar", str(disk), resolution=RESOLUTION)
        database = MapDatabase(self._folder, SETTINGS)
        memory = ChunkMemory(str(shm), live_prefix("test", "lidar"))
        self.map = ServedMap(
            settings, database, memory, Limits(budget_bytes, **limits), self.marks, self._answer
        )
        self.paged = self.map.paged
        try:
            self.map.adopt(0.0)
        except OSError:
            self.paged.close()
            self._folder.close()
            raise

    def _answer(self, ticket: int, reply: Any) -> None:
        assert ticket not in self.answers, "nothing is answered twice"
        self.answers[ticket] = reply

    def ask(self, make: Callable[[int], messages.LiveRequest], session: int = 1, *, maps: bool = True) -> int:
        """Hand a request in; returns its ticket."""
        self._files += 1
        ticket = self._files
        self.map.handle(Ask(ticket, session, os.geteuid(), maps, b""), make(ticket), self.now_s)
        return ticket

    def open(self, name: str = "front", session: int = 1) -> messages.LiveOpened:
        """Map under a name."""
        ticket = self.ask(lambda n: messages.LiveOpen(n, "lidar", name), session)
        reply: messages.LiveOpened = self.answer(ticket)
        return reply

    def send(self, marks: Marks, mapper: int, scan: int, session: int = 1, at: float = 0.0) -> int:
        """Send a scan; returns its ticket."""
        data = encode_marks(marks, self.paged.database.map_id, mapper, scan)
        name = f"{session:x}.{self._files}"
        Path(self.marks.path, name).write_bytes(data)
        return self.ask(
            lambda n: messages.LiveScan(n, "lidar", mapper, scan, name, len(data), (at, at, at)), session
        )

    def turn(self, *, save_all: bool = False) -> None:
        """A turn, some time after the last one."""
        self.now_s += 0.2
        self.map.run_turn(self.now_s, save_all=save_all)

    def until(self, done: Callable[[], object], *, save_all: bool = False) -> None:
        """Turn until something is so."""
        waiting = Deadline()
        while waiting(not done()):
            self.turn(save_all=save_all)
            self.paged._threads.wait(0.01)

    def answer(self, ticket: int, *, save_all: bool = False) -> Any:
        """Turn until a request is answered."""
        self.until(lambda: ticket in self.answers, save_all=save_all)
        return self.answers[ticket]

    def end(self, *, keep: bool = False) -> None:
        """End this run; with ``keep`` what is in memory is left to the next one."""
        if self.ended:
            return
        self.ended = True
        if not keep:
            self.until(lambda: self.paged.all_durable, save_all=True)
        self.map.end(keep=keep)
        self.marks.close()
        self.paged.memory.close()
        self._folder.close()

    def voxels(self) -> dict[Voxel, int]:
        """All known voxels in memory."""
        found: dict[Voxel, int] = {}
        for key, chunk in self.paged.chunks.items():
            dense = chunk.view.dense()
            places = dense.nonzero()[0]
            for voxel, value in zip(voxels_of(key, places).tolist(), dense[places].tolist(), strict=True):
                found[voxel[0], voxel[1], voxel[2]] = value
        return found
