# SPDX-License-Identifier: Apache-2.0
"""The power fails while a live map is written: what was durable is there, and the tables are whole.

Of the log there is what was flushed, and of the rest any part: its beginning, or any of its pages.  Of the
database there are the pages of the last flush, and, where the log is just brought in, any of the new ones.
"""

from __future__ import annotations

import random
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from shmmap.chunks.chunk_file import encode_chunk
from shmmap.chunks.layout import ChunkView, new_header
from shmmap.chunks.voxels import ChunkKey
from shmmap.live_worker.disk.folder import Folder
from shmmap.live_worker.disk.map_database import MapDatabase
from shmmap.live_worker.disk.map_record import MapSettings, boot_id

SETTINGS = MapSettings(resolution=0.1)
PAGE = 4096
KEYS = [ChunkKey(number, 0, 0) for number in range(40)]


class Disk:
    """What is on the disk for certain while a map is written to, and what it was promised."""

    def __init__(self, directory: Path, rng: random.Random) -> None:
        self.directory, self.rng = directory, rng
        self.folder = Folder(directory)
        self.database = MapDatabase(self.folder, SETTINGS)
        self.now: dict[ChunkKey, int] = {}
        self.durable: dict[ChunkKey, int] = {}
        self.flushed = self.cuts = 0
        self.database.bring_log_in()
        self.base = self.read("map.db")

    def read(self, name: str) -> bytes:
        return (self.directory / name).read_bytes()

    def save(self) -> None:
        key = self.rng.choice(KEYS)
        version = self.now.get(key, 0) + 1
        view = ChunkView(new_header(SETTINGS.identity(self.database.map_id, key, 1)))
        view.state["version"] = version
        self.database.save(key, encode_chunk(view, "raw"))
        self.now[key] = version

    def flush(self) -> None:
        self.database.flush()
        self.flushed, self.durable = len(self.read("map.db-wal")), dict(self.now)

    def bring_in(self) -> None:
        """Bring the log into the database; the power may fail with any part of that done."""
        self.flush()
        log = self.read("map.db-wal")
        self.database.bring_log_in()
        whole = self.read("map.db")
        for _ in range(3):
            half = bytearray(self.base.ljust(len(whole), b"\0"))
            for place in range(0, len(whole), PAGE):
                if self.rng.random() < 0.5:
                    half[place : place + PAGE] = whole[place : place + PAGE]
            size = len(whole) if self.rng.random() < 0.5 else len(self.base)
            self.check(bytes(half[:size]), log)
        self.base, self.flushed = whole, 0
        self.check(self.base, b"")

    def cut(self) -> None:
        log = bytearray(self.read("map.db-wal"))
        kind = self.rng.randrange(3)
        if kind == 0:
            del log[self.flushed :]
        elif kind == 1:
            del log[self.rng.randint(self.flushed, len(log)) :]
        else:
            for place in range(self.flushed - self.flushed % PAGE, len(log), PAGE):
                if self.rng.random() < 0.5:
                    begin, end = max(place, self.flushed), min(place + PAGE, len(log))
                    log[begin:end] = bytes(end - begin)
        self.check(self.base, bytes(log))

    def check(self, database: bytes, log: bytes) -> None:
        """Start as after a cut."""
        self.cuts += 1
        found = self.directory.parent / f"cut{self.cuts}"
        found.mkdir()
        (found / "map.db").write_bytes(database)
        (found / "map.db-wal").write_bytes(log)
        (found / "map.json").write_bytes(self.read("map.json").replace(boot_id().encode(), b"before"))
        with closing(Folder(found)) as folder, closing(MapDatabase(folder, SETTINGS)) as again:
            assert (again.record.lost_chunks, again.damaged) == ({}, {})
            assert again.map_id == self.database.map_id
            for key, version in self.durable.items():
                assert again.version(key) >= version
                data = again.load(key)
                assert data is not None
                assert ChunkView(data).state["version"] == again.version(key)
        with closing(sqlite3.connect(found / "map.db")) as tables:
            assert tables.execute("pragma integrity_check").fetchone() == ("ok",)


@pytest.mark.parametrize("seed", range(8))
def test_a_power_cut_at_any_time_loses_nothing_durable(tmp_path: Path, seed: int) -> None:
    rng = random.Random(seed)
    disk = Disk(tmp_path / "map", rng)
    disk.flush()
    for _ in range(12):
        for _ in range(rng.randrange(1, 12)):
            disk.save()
        if rng.random() < 0.5:
            disk.cut()
        if rng.random() < 0.5:
            disk.flush()
        disk.cut()
        if rng.random() < 0.25:
            disk.bring_in()
    assert disk.cuts > 12
    disk.database.close()
    disk.folder.close()
