# SPDX-License-Identifier: Apache-2.0
"""A damaged chunk of a live map: every way to the map's data says what is lacking."""

from __future__ import annotations

import errno
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from shmmap.chunks.voxels import ChunkKey
from shmmap.errors import MapDataError
from shmmap.live_worker.disk.exporting import ExportedVoxels, export
from shmmap.live_worker.disk.folder import Folder, FolderToRead
from shmmap.live_worker.disk.maintenance import CheckedMap, check, repair
from shmmap.live_worker.disk.stored_map import StoredMap
from shmmap.protocol.live import LiveChunks, LiveVoxels, LiveVoxelsReply
from shmmap.protocol.messages import ErrorReply
from tests.support.live_drive import RESOLUTION, Voxel, marked
from tests.support.live_reference import stored_drive
from tests.support.odd_files import failing
from tests.support.served_map import Served
from tests.support.stored_chunks import (
    PAGE,
    change_chunk,
    chunk_sizes,
    damage_page,
    largest,
    page_kinds,
    saved_bytes,
)

Serve = Callable[..., Served]
SCOPES = ("memory", "disk", "all")


def flipped(at: int) -> Callable[[bytes], bytes]:
    def change(data: bytes) -> bytes:
        changed = bytearray(data)
        changed[at] ^= 4
        return bytes(changed)

    return change


DAMAGES: dict[str, Callable[[bytes], bytes]] = {
    "a bit of the header": flipped(48),
    "a bit of the body": flipped(-1),
    "cut in the header": lambda data: data[:100],
    "cut in the body": lambda data: data[:-1],
    "empty": lambda _data: b"",
    "longer": lambda data: data + b"\0",
    "zeros": lambda data: bytes(len(data)),
    "zeros in the body": lambda data: data[:128].ljust(len(data), b"\0"),
}


class Damaged:
    """A map of which one saved chunk was damaged."""

    def __init__(self, serve: Serve, shm: Path, directory: Path) -> None:
        self._serve, self.shm, self.directory = serve, shm, directory
        self.voxels = stored_drive(directory, 2)
        self.key = largest(directory)
        self.lost = {self.key}

    def damage(self, name: str) -> None:
        if name == "of another chunk":
            other = saved_bytes(self.directory, next(iter(chunk_sizes(self.directory))))
            change_chunk(self.directory, self.key, lambda _data: other)
        else:
            change_chunk(self.directory, self.key, DAMAGES[name])

    @property
    def left(self) -> dict[Voxel, int]:
        """The voxels of all other chunks."""
        return {
            voxel: value
            for voxel, value in self.voxels.items()
            if ChunkKey(*(index >> 6 for index in voxel)) not in self.lost
        }

    def serve(self) -> Served:
        return self._serve()

    def answer(self, served: Served, scope: str) -> tuple[set[ChunkKey], dict[Voxel, int]]:
        """The chunks that are said to be lacking, and the voxels."""
        found: dict[Voxel, int] = {}
        lacking: set[ChunkKey] = set()
        for kind in ("occupied", "free"):
            reply: LiveVoxelsReply = served.answer(
                served.ask(lambda n, kind=kind: LiveVoxels(n, "lidar", kind, scope=scope))  # type: ignore[misc]
            )
            assert reply.lacking_count == len(reply.lacking)
            lacking |= {ChunkKey(*one.key) for one in reply.lacking}
            data = (self.shm / reply.segment[1:]).read_bytes()
            indices = np.frombuffer(data, "<i4", 3 * reply.count).reshape(-1, 3).tolist()
            for voxel, value in zip(
                indices, np.frombuffer(data, "<i2", offset=12 * reply.count).tolist(), strict=True
            ):
                found[voxel[0], voxel[1], voxel[2]] = value
        return lacking, found

    def checked(self, *, mend: bool = False) -> CheckedMap:
        """What ``fsck`` says; with ``mend`` after a repair."""
        folder = Folder(self.directory) if mend else FolderToRead(self.directory)
        try:
            found = check(folder, str(self.directory))
            if isinstance(folder, Folder):
                repair(folder, found)
            return found
        finally:
            folder.close()

    def exported(self) -> ExportedVoxels | None:
        folder = FolderToRead(self.directory)
        try:
            with closing(StoredMap(folder, str(self.directory))) as stored:
                return export(stored, self.shm / "out.ply", "ply", voxels="both", force=True)
        finally:
            folder.close()

    def all_say_so(self, served: Served) -> None:
        """Each answer, the state of the map, the check of the files, and the export."""
        row = served.map.status()
        text = " ".join(row.damaged)
        assert row.damaged_count == len(row.damaged) >= len(self.lost)
        assert all(key.text in text for key in self.lost), text
        for scope in SCOPES:
            lacking, found = self.answer(served, scope)
            assert lacking == self.lost, scope
            if scope != "memory":
                assert found == self.left, scope
        page = served.answer(served.ask(lambda n: LiveChunks(n, "lidar", since=1)))
        assert {ChunkKey(*one.key) for one in page.lacking} == self.lost
        checked = self.checked()
        assert not checked.good
        assert {one.chunk for one in checked.lost} == {key.text for key in self.lost}
        made = self.exported()
        assert made is not None
        assert set(made.lost) == {key.text for key in self.lost}
        assert made.voxels == len(self.left)


@pytest.fixture
def damaged(serve: Serve, shm: Path, tmp_path: Path) -> Damaged:
    return Damaged(serve, shm, tmp_path / "map")


@pytest.mark.parametrize(
    ("name", "when", "noticed"),
    [
        (name, when, ("disk", "all", "loading")[(number + 2 * turn) % 3])
        for turn, when in enumerate(("stopped", "running"))
        for number, name in enumerate([*DAMAGES, "of another chunk"])
    ],
)
def test_what_is_lost_is_named_by_all_until_it_is_forgotten(
    damaged: Damaged, name: str, when: str, noticed: str
) -> None:
    """Whatever notices it first; over a restart, and when the chunk was mapped again."""
    if when == "running":
        served = damaged.serve()
        damaged.damage(name)
    else:
        damaged.damage(name)
        with pytest.raises(MapDataError) as caught:
            damaged.exported()
        assert "fsck" in caught.value.hint
        assert not damaged.checked().good
        served = damaged.serve()
    if noticed == "loading":
        for key in damaged.lost:
            served.paged.move("client", tuple((index + 0.5) * 64 * RESOLUTION for index in key))  # type: ignore[arg-type]
            served.until(lambda key=key: key in served.paged.chunks)  # type: ignore[misc]
    else:
        lacking, found = damaged.answer(served, noticed)
        assert (lacking, found) == (damaged.lost, damaged.left)
    served.until(lambda: not served.paged.database.record_is_due)
    served.until(lambda: served.paged._threads.are_idle)
    damaged.all_say_so(served)
    served.end(keep=True)  # as after a kill
    served = damaged.serve()
    damaged.all_say_so(served)
    served.end()
    damaged.checked(mend=True)
    served = damaged.serve()
    assert damaged.answer(served, "all") == (set(), damaged.left), "forgotten"
    assert served.map.status().damaged_count == 0


@pytest.mark.parametrize("name", ["a bit of the body", "of another chunk"])
@pytest.mark.parametrize("dies", [False, True])
def test_what_memory_has_is_saved_again(damaged: Damaged, name: str, dies: bool) -> None:
    """The list from the disk lacks it just once; also if the worker dies before it is saved."""
    served = damaged.serve()
    served.paged.move("client", tuple((index + 0.5) * 64 * RESOLUTION for index in damaged.key))  # type: ignore[arg-type]
    served.until(lambda: damaged.key in served.paged.chunks)
    damaged.damage(name)
    assert damaged.answer(served, "all") == (set(), damaged.voxels)
    ticket = served.ask(lambda n: LiveVoxels(n, "lidar", scope="disk"))
    assert {ChunkKey(*one.key) for one in served.answer(ticket).lacking} == {damaged.key}
    if dies:
        served.end(keep=True)
        served = damaged.serve()
    served.until(lambda: served.paged.all_durable, save_all=True)
    for scope in ("disk", "all"):
        assert damaged.answer(served, scope) == (set(), damaged.voxels)
    served.end()
    assert damaged.checked().good


def test_a_chunk_that_is_lost_twice(damaged: Damaged) -> None:
    """What was mapped since the first loss is in memory and saved again; the first loss stays named."""
    served = damaged.serve()
    damaged.damage("empty")
    mapper = served.open().mapper
    place = tuple((index + 0.5) * 64 * RESOLUTION for index in damaged.key)
    served.paged.move("client", place)  # type: ignore[arg-type]
    served.until(lambda: damaged.key in served.paged.chunks)
    (marks,) = (one for one in marked(3)[2:])
    assert damaged.key in marks.chunks
    served.answer(served.send(marks, mapper, 1, at=place[0]))
    served.until(lambda: served.paged.all_durable, save_all=True)
    mapped = damaged.answer(served, "all")
    assert mapped[0] == {damaged.key}
    damaged.damage("a bit of the body")
    assert damaged.answer(served, "disk")[0] == {damaged.key}
    served.until(lambda: served.paged.all_durable, save_all=True)
    assert damaged.answer(served, "disk") == damaged.answer(served, "all") == mapped
    served.end()
    served = damaged.serve()
    assert damaged.answer(served, "disk") == mapped


def test_a_disk_that_cannot_be_read_at_present_is_a_problem_until_it_can(
    damaged: Damaged, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What it has may be good: nothing is lost, and nothing is answered without it."""
    served = damaged.serve()
    with monkeypatch.context() as patch:
        patch.setattr(served.paged.database, "_read", failing(errno.EIO))
        for scope in ("disk", "all"):
            refused = served.answer(served.ask(lambda n, scope=scope: LiveVoxels(n, "lidar", scope=scope)))  # type: ignore[misc]
            assert isinstance(refused, ErrorReply)
            assert "Input/output error" in refused.message
        assert "cannot be read: Input/output error" in served.map.status().problem
        assert served.map.status().damaged_count == 0
    served.until(lambda: not served.map.status().problem)
    assert damaged.answer(served, "all") == (set(), damaged.voxels)


def test_tables_that_are_damaged_while_all_of_it_is_in_memory(damaged: Damaged) -> None:
    """A new database is made beside the old one; what was lost from it is saved again."""
    served = damaged.serve()
    for key in chunk_sizes(damaged.directory):
        served.paged.move(key, tuple((index + 0.5) * 64 * RESOLUTION for index in key))  # type: ignore[arg-type]
    served.until(lambda: set(served.paged.chunks) >= set(served.paged.database.rows))
    for number, kind in page_kinds(damaged.directory).items():
        if kind != "other":
            damage_page(damaged.directory, number, bytes(PAGE))
    for connection in (served.paged.database._reader, served.paged.database._writer):
        assert connection is not None
        connection.execute("pragma shrink_memory")  # else what was read before is not read again
    damaged.answer(served, "disk")
    served.until(lambda: served.paged.all_durable and not served.paged.database.record.lost, save_all=True)
    assert damaged.answer(served, "disk") == damaged.answer(served, "all") == (set(), damaged.voxels)
    served.end()
    assert damaged.checked().good
    assert damaged.checked().aside == ["map.db.damaged.1"]
