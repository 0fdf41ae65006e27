# SPDX-License-Identifier: Apache-2.0
"""A directory of an earlier version is imported as it is: chunks byte for byte, and what was lost by name."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest

from shmmap.chunks.chunk_file import read_file_header
from shmmap.chunks.voxels import ChunkKey
from shmmap.errors import ConfigError, MapDataError
from shmmap.live_worker.disk.folder import Folder
from shmmap.live_worker.disk.map_database import MapDatabase
from shmmap.live_worker.disk.map_record import MapSettings
from tests.support import live_reference
from tests.support.live_drive import SETTINGS
from tests.support.live_reference import contents
from tests.support.odd_files import ODD_FILES
from tests.support.stored_chunks import files_of, saved_bytes


@contextmanager
def opened(directory: Path, settings: MapSettings = SETTINGS) -> Iterator[MapDatabase]:
    """Open a map as a daemon does."""
    with closing(Folder(directory)) as folder, closing(MapDatabase(folder, settings)) as database:
        yield database


@pytest.fixture
def old(tmp_path: Path) -> Path:
    live_reference.old_directory(tmp_path / "map", 2)
    return tmp_path / "map"


def chunks_of(directory: Path) -> dict[ChunkKey, bytes]:
    return {ChunkKey.from_text(path.stem): path.read_bytes() for path in directory.glob("[-0-9]*.chunk")}


def test_all_of_it_is_imported_and_kept(old: Path) -> None:
    before, chunks = contents(old), chunks_of(old)
    assert len(chunks) > 5
    with opened(old) as database:
        assert database.rows.keys() == chunks.keys()
        assert {key: saved_bytes(old, key) for key in chunks} == chunks
        assert all(database.load(key) for key in chunks)
        assert (database.record.lost_chunks, database.record.applied) == ({}, {1: 2})
        assert [(one.number, one.uid, one.name, one.scans) for one in database.record.mappers] == [
            (1, 1000, "front", 1 << 20)
        ]
        assert database.map_id == bytes(range(16))
        assert database.record.runs == 4
        assert database.add_mapper(1000, "rear").number == 2
    assert files_of(old) == {"map.db", "map.json", "imported.1"}
    assert contents(old / "imported.1") == before, "what was there is as it was"
    with opened(old) as again:
        assert again.rows.keys() == chunks.keys()
    with opened(old / "imported.1") as another:
        assert another.rows.keys() == chunks.keys()


@pytest.mark.parametrize("kind", ["a file", "a directory without a record"])
def test_what_has_the_name_already_stays(old: Path, kind: str) -> None:
    before = contents(old)
    there = old / "imported.1"
    if kind != "a file":
        there.mkdir()
        there /= next(name for name in before if name.endswith(".chunk"))
    there.write_bytes(b"precious")
    with opened(old) as database:
        assert not database.record.lost_chunks
    assert there.read_bytes() == b"precious"
    assert contents(old / "imported.2") == before


def test_the_newest_good_one_of_each_chunk_counts(old: Path) -> None:
    """Chunks that were written and not flushed are there under other names, and so are older ones."""
    (first, data), (second, newer), (third, other), *_ = sorted(chunks_of(old).items())
    for path, content in {
        ".chunk.aa.tmp": data, f".{first.text}.chunk.bb.tmp": data[:-1], ".chunk.cc.tmp": newer,
        ".map.json.ab.tmp": b"{",
    }.items():  # fmt: skip
        (old / path).write_bytes(content)
    (old / f"{first.text}.chunk").unlink()
    (old / f"{second.text}.chunk").write_bytes(newer[:100])
    (old / f"{third.text}.chunk").write_bytes(other[:-1])
    with opened(old) as database:
        assert saved_bytes(old, first) == data
        assert saved_bytes(old, second) == newer
        assert (list(database.record.lost_chunks), database.rows.get(third)) == ([third], None)
        assert database.record.lost_chunks[third].version == read_file_header(other).version


def gone(path: Path, _other: Path) -> None:
    path.unlink()


def copied(path: Path, other: Path) -> None:
    path.write_bytes(other.read_bytes())


def cut(path: Path, _other: Path) -> None:
    path.write_bytes(path.read_bytes()[:-1])


@pytest.mark.parametrize("damage", [gone, copied, cut])
@pytest.mark.parametrize("manifest", [True, False])
def test_what_was_lost_has_its_name(old: Path, damage: Callable[[Path, Path], None], manifest: bool) -> None:
    chunks = chunks_of(old)
    path, other = (old / f"{key.text}.chunk" for key in sorted(chunks)[:2])
    damage(path, other)
    if not manifest:
        (old / "manifest.json").unlink()
    lost = {ChunkKey.from_text(path.stem)} if manifest or damage is not gone else set()
    with opened(old) as database:
        assert database.record.lost_chunks.keys() == lost
        assert database.rows.keys() == chunks.keys() - {ChunkKey.from_text(path.stem)}
    with opened(old) as again:
        assert again.record.lost_chunks.keys() == lost


def test_what_was_lost_before_is_lost(old: Path) -> None:
    manifest = json.loads((old / "manifest.json").read_text())
    key = next(iter(manifest["chunks"]))
    manifest["missing"] = {key: {**manifest["chunks"][key], "version": 900}}
    (old / "manifest.json").write_text(json.dumps(manifest))
    with opened(old) as database:
        assert {one.text: lost.version for one, lost in database.record.lost_chunks.items()} == {key: 900}


@pytest.mark.parametrize("text", [b"{", b"[" * 200_000, b"\xff", b""])
def test_a_damaged_manifest_and_a_damaged_record(old: Path, text: bytes) -> None:
    before = contents(old)
    (old / "map.json").write_bytes(text)
    with pytest.raises(MapDataError, match=r"map\.json"), opened(old):
        pass
    (old / "map.json").write_bytes(before["map.json"])
    (old / "manifest.json").write_bytes(text)
    with opened(old) as database:
        assert len(database.rows) == len(chunks_of(old / "imported.1"))
    assert (old / "imported.1" / "manifest.json").read_bytes() == text


def test_other_settings_change_nothing(old: Path) -> None:
    before = contents(old)
    with pytest.raises(ConfigError, match="was made with"), opened(old, MapSettings(resolution=0.3)):
        pass
    assert contents(old) == before


@pytest.mark.parametrize("name", ["0_0_0.chunk", "manifest.json"])
def test_chunks_without_a_record_are_left_alone(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b"whatever")
    with pytest.raises(MapDataError, match="missing"), opened(tmp_path):
        pass
    assert contents(tmp_path) == {name: b"whatever"}


@pytest.mark.parametrize("name", ["map.json", "manifest.json", "9_9_9.chunk", ".chunk.ab.tmp"])
@pytest.mark.parametrize("kind", ["directory", "pipe", "loop", "socket"])
def test_what_is_no_regular_file_keeps_the_map_closed(old: Path, name: str, kind: str) -> None:
    """It may hide a good file: nothing is changed until it is gone."""
    path = old / name
    if path.exists():
        path.rename(old / "kept")
    ODD_FILES[kind](path)
    before = files_of(old)
    with pytest.raises(OSError, match=f"{name}: "), opened(old):
        pass
    assert files_of(old) - {"map.db.new"} == before


class Killed(BaseException):
    """The process ends here."""


def test_killed_at_any_step_it_is_imported_by_the_next_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing is lost, and nothing is imported twice."""
    for steps in range(60):
        directory = tmp_path / str(steps)
        live_reference.old_directory(directory, 1)
        before, chunks = contents(directory), chunks_of(directory)
        left = [steps]

        def count(kill: list[int] = left) -> None:
            kill[0] -= 1
            if kill[0] < 0:
                raise Killed

        class Watched(Folder):
            def rename(self, old: str, new: str) -> None:
                count()
                super().rename(old, new)

            def sync(self, name: str) -> None:
                count()
                super().sync(name)

            def sync_names(self) -> None:
                count()
                super().sync_names()

        folder = Watched(directory)
        ended = False
        try:
            with closing(MapDatabase(folder, SETTINGS)):
                pass
            ended = True
        except Killed:
            pass
        finally:
            folder.close()
        with opened(directory) as database:
            assert database.rows.keys() == chunks.keys()
            assert not database.record.lost_chunks
            assert {key: saved_bytes(directory, key) for key in chunks} == chunks
        assert contents(directory / "imported.1") == before
        assert files_of(directory) == {"map.db", "map.json", "imported.1"}
        if ended:
            return
    raise AssertionError("it never came to its end")
