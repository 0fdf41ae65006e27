# SPDX-License-Identifier: Apache-2.0
"""A live map on disk: whatever page of its database is damaged costs little, and what is lost has a name."""

from __future__ import annotations

import errno
import json
import os
import random
import shutil
import sqlite3
import struct
import threading
import tracemalloc
import zlib
from collections.abc import Callable, Container, Iterable, Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path

import pytest
from xxhash import xxh3_64_intdigest

from shmmap.chunks.chunk_file import check_file, check_identity, encode_chunk
from shmmap.chunks.layout import ChunkIdentity, ChunkView, new_header
from shmmap.chunks.occupancy import Occupancy
from shmmap.chunks.voxels import ChunkKey
from shmmap.errors import ConfigError, MapDataError
from shmmap.live_worker.disk import map_database, schema
from shmmap.live_worker.disk.folder import Folder, FolderToRead
from shmmap.live_worker.disk.maintenance import CheckedMap, check, repair
from shmmap.live_worker.disk.map_database import SCANS_AHEAD, MapDatabase
from shmmap.live_worker.disk.map_record import Lost, MapSettings, Row
from shmmap.live_worker.disk.rebuilding import NEW, finish_replacing, replace_database
from shmmap.live_worker.disk.stored_map import opened_folder_to_read
from shmmap.mounts import Mount
from tests.support.odd_files import ODD_FILES, failing
from tests.support.pages import read_page
from tests.support.stored_chunks import (
    PAGE,
    change_chunk,
    damage_page,
    database,
    files_of,
    page_kinds,
    saved_bytes,
)

SETTINGS = MapSettings(resolution=0.1)
KEYS = [ChunkKey(0, 0, 0), ChunkKey(-1, 2, 0), ChunkKey(5, 5, -5)]


@contextmanager
def opened(directory: Path, settings: MapSettings = SETTINGS) -> Iterator[MapDatabase]:
    """Open a map as a daemon does, and end as one that is killed."""
    with closing(Folder(directory)) as folder, closing(MapDatabase(folder, settings)) as made:
        yield made


def chunk(made: MapDatabase, key: ChunkKey, version: int) -> bytes:
    """The bytes of an empty chunk of this version."""
    view = ChunkView(new_header(made.settings.identity(made.map_id, key, 1)))
    view.state["version"] = version
    return encode_chunk(view, "raw")


def with_body(data: bytes, body: bytes) -> bytes:
    """Another body under a chunk's header, with the right checksums."""
    header = bytearray(data[:120])
    struct.pack_into("<QQ", header, 64, len(body), xxh3_64_intdigest(body))
    return bytes(header) + struct.pack("<II", zlib.crc32(header), 0) + body


def loaded(made: MapDatabase, keys: Iterable[ChunkKey]) -> dict[ChunkKey, bytes | None]:
    """What the map has of these chunks."""
    found = {key: made.load(key) for key in keys}
    return {key: bytes(data) if data is not None else None for key, data in found.items()}


def checked(directory: Path) -> CheckedMap:
    """Check a map, as any process may."""
    with opened_folder_to_read(str(directory)) as folder:
        return check(folder, str(directory))


def version_of(made: MapDatabase, key: ChunkKey) -> int:
    """The version of a chunk, read whole; 0 where there is none."""
    data = made.load(key)
    return int(ChunkView(data).state["version"]) if data is not None else 0


def test_a_map_is_made_and_found_again(tmp_path: Path) -> None:
    directory = tmp_path / "state" / "lidar"
    with opened(directory) as made:
        assert (made.settings, made.record.mappers, made.rows) == (SETTINGS, [], {})
        assert made.record.runs == 1
        mapper = made.add_mapper(1000, "front")
        made.expect_scan(mapper, 0)
        made.save(KEYS[0], chunk(made, KEYS[0], 3))
        made.save(KEYS[1], chunk(made, KEYS[1], 1))
        made.write_record({1: 7})
        map_id = made.map_id
        assert {path.stat().st_mode & 0o777 for path in directory.iterdir()} == {0o600}
    assert directory.stat().st_mode & 0o777 == 0o700
    assert files_of(directory) == {"map.db", "map.json"}
    with opened(directory) as again:
        assert again.map_id == map_id
        assert again.record.runs == 2
        assert [(m.number, m.uid, m.name, m.scans) for m in again.record.mappers] == [
            (1, 1000, "front", SCANS_AHEAD)
        ]
        assert again.rows == {KEYS[0]: Row(3, 2688, 0, 0, 0, 0), KEYS[1]: Row(1, 2688, 0, 0, 0, 0)}
        assert again.record.applied == {1: 7}
        assert [version_of(again, key) for key in KEYS] == [3, 1, 0]
        assert (again.record.lost_chunks, again.damaged) == ({}, {})


def test_a_database_is_on_the_disk_before_it_gets_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flush, flushed = os.fdatasync, list[str]()

    def noted(fd: int) -> None:
        flushed.append(os.readlink(f"/proc/self/fd/{fd}"))
        flush(fd)

    monkeypatch.setattr(os, "fdatasync", noted)
    with opened(tmp_path / "map"):
        assert flushed[0] == str(tmp_path / "map" / NEW)


@pytest.mark.parametrize(
    ("other", "key"),
    [
        (MapSettings(resolution=0.2), "resolution"),
        (MapSettings(resolution=0.1, frame_id="odom"), "frame_id"),
        (MapSettings(resolution=0.1, occupancy=Occupancy(hit=0.8)), "hit"),
    ],
)
def test_other_settings_are_refused(tmp_path: Path, other: MapSettings, key: str) -> None:
    with opened(tmp_path):
        pass
    with pytest.raises(ConfigError, match="was made with") as caught, opened(tmp_path, other):
        pass
    assert caught.value.key == key


def test_a_network_file_system_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(schema, "mount_of", lambda path: Mount("nfs4", "/", path, []))
    with pytest.raises(ConfigError, match=r"network file system \(nfs4\)"), opened(tmp_path):
        pass
    assert files_of(tmp_path) == set()


def test_where_sqlite_keeps_no_log_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As where processes cannot share memory: SQLite has a way of locking that is as poor."""

    def poor(folder: Folder, name: str = "map.db", *, mode: str = "rw") -> sqlite3.Connection:
        return schema.connect(folder, name, mode=f"{mode}&vfs=unix-dotfile")

    monkeypatch.setattr("shmmap.live_worker.disk.rebuilding.connect", poor)
    with pytest.raises(ConfigError, match="cannot keep a log there"), opened(tmp_path):
        pass
    assert not files_of(tmp_path)


@pytest.mark.parametrize("name", ["map.db", "map.db-wal", "map.db-shm", "map.json"])
@pytest.mark.parametrize("kind", ["directory", "pipe", "loop", "socket"])
def test_what_is_no_regular_file_keeps_the_map_closed(tmp_path: Path, name: str, kind: str) -> None:
    """It may hide a good file, or lead elsewhere: nothing is changed until it is gone."""
    with opened(tmp_path) as made:
        made.save(KEYS[0], chunk(made, KEYS[0], 3))
        made.write_record()
    path = tmp_path / name
    if path.exists():
        path.rename(tmp_path / "kept")
    ODD_FILES[kind](path)
    before = files_of(tmp_path)
    with pytest.raises(OSError, match=f"{name}: it is a"), opened(tmp_path):
        pass
    if name != "map.json":
        with pytest.raises(MapDataError, match=rf"{name}: it is a .* \(move it away") as refused:
            checked(tmp_path)
        assert refused.value.cause == "unreadable"
    assert files_of(tmp_path) == before


def test_a_map_whose_database_is_gone_is_not_made_again(tmp_path: Path) -> None:
    with opened(tmp_path):
        pass
    (tmp_path / "map.db").unlink()
    with pytest.raises(MapDataError, match="the database with the chunks is missing"), opened(tmp_path):
        pass


def test_the_database_is_as_the_page_says(tmp_path: Path) -> None:
    """Byte for byte where others recognize it, and the statements of its tables."""
    with opened(tmp_path) as made:
        made.save(KEYS[0], saved := chunk(made, KEYS[0], 3))
    header = (tmp_path / "map.db").read_bytes()[:100]
    assert header[:20] == b"SQLite format 3\0" + bytes.fromhex("1000 0202"), "pages of 4096 bytes, WAL"
    assert (header[60:64], header[68:72]) == (bytes([0, 0, 0, 1]), b"SHML")
    tables = read_page("shmmap/chunks/CHUNKS.md").blocks["tables"]
    with database(tmp_path) as reader:
        found = [text for (text,) in reader.execute("select sql from sqlite_master order by rowid")]
        rows = reader.execute("select id, key, version, bytes, data from chunks").fetchall()
        ((number, record),) = reader.execute("select * from map").fetchall()
        padded = reader.execute("select padding from chunks").fetchall()
    assert [text.lower() for text in found] == tables
    assert rows == [(1, "0_0_0", 3, len(saved), saved)]
    assert not any(padded[0][0])
    assert number == 0
    assert json.loads(record)["lost"] == {}


@pytest.mark.parametrize("name", ["map.db", "map.db-wal"])
def test_a_file_that_is_not_where_it_was_is_a_problem_until_it_is(tmp_path: Path, name: str) -> None:
    """It is still written to; the daemon's next start would not find that."""
    with opened(tmp_path) as made:
        assert made.moved() == ""
        (tmp_path / name).rename(tmp_path / "kept")
        assert made.moved() == f"{name}: it was moved, removed or replaced"
        shutil.copy(tmp_path / "kept", tmp_path / name)
        assert made.moved() == f"{name}: it was moved, removed or replaced"
        (tmp_path / "kept").rename(tmp_path / name)
        assert made.moved() == ""


# --- the log ------------------------------------------------------------------------------------


def test_what_was_not_flushed_outlives_the_process(tmp_path: Path) -> None:
    """A copy of the files is what the kernel has: as after SIGKILL."""
    with opened(tmp_path / "map") as made:
        made.save(KEYS[0], chunk(made, KEYS[0], 3))
        copy_of(tmp_path / "map", tmp_path / "killed")
    with opened(tmp_path / "killed") as again:
        assert version_of(again, KEYS[0]) == 3


def test_a_copy_that_is_taken_while_it_is_written(tmp_path: Path) -> None:
    """File by file, of no single moment: it opens, and each chunk is whole or has its name."""
    with opened(tmp_path / "map") as made:
        for key in KEYS:
            made.save(key, chunk(made, key, 1))
        made.bring_log_in()
        for version in range(2, 20):
            for key in KEYS:
                made.save(key, chunk(made, key, version))
            if version % 5 == 0:
                made.bring_log_in()
            (other := tmp_path / str(version)).mkdir()
            for name in ("map.db", "map.json", "map.db-wal"):
                (other / name).write_bytes((tmp_path / "map" / name).read_bytes())
                made.save(KEYS[version % 3], chunk(made, KEYS[version % 3], version + 100))
                if version % 2:
                    made.bring_log_in()
            with opened(other) as again:
                for key in KEYS:
                    assert version_of(again, key) or key in again.record.lost_chunks, (version, key)
                    again.save(key, chunk(again, key, 1000))


def copy_of(directory: Path, other: Path) -> None:
    other.mkdir()
    for name in ("map.db", "map.db-wal", "map.json"):
        if (directory / name).exists():
            (other / name).write_bytes((directory / name).read_bytes())


def test_the_log_is_brought_in_when_it_is_long(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(map_database, "LOG_BYTES", 1 << 16)
    with opened(tmp_path) as made:
        for version in range(1, 60):
            made.save(KEYS[0], chunk(made, KEYS[0], version))
            made.flush()
            assert (tmp_path / "map.db-wal").stat().st_size <= (1 << 16) + (1 << 15)
        assert version_of(made, KEYS[0]) == 59


def test_a_reader_that_keeps_its_transaction_is_a_problem_with_a_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The log grows to its bound; nothing is saved then, until the reader has ended."""
    monkeypatch.setattr(map_database, "LOG_BYTES", 1 << 16)
    monkeypatch.setattr(map_database, "MAX_LOG_BYTES", 1 << 18)
    with opened(tmp_path) as made:
        made.save(KEYS[0], chunk(made, KEYS[0], 1))
        with database(tmp_path) as reader:
            reader.execute("begin")
            reader.execute("select count(*) from chunks").fetchall()

            def save_many() -> None:
                for version in range(2, 200):
                    made.save(KEYS[0], chunk(made, KEYS[0], version))
                    made.flush()

            with pytest.raises(OSError, match="another process keeps reading its database"):
                save_many()
            assert (tmp_path / "map.db-wal").stat().st_size <= (1 << 18) + (1 << 16)
            assert version_of(made, KEYS[0]) > 1, "reading goes on"
        made.save(KEYS[0], chunk(made, KEYS[0], 1000))
        made.flush()
        assert (tmp_path / "map.db-wal").stat().st_size < 1 << 16


def test_another_process_s_lock_is_an_error_at_once(tmp_path: Path) -> None:
    with opened(tmp_path) as made:
        with database(tmp_path) as other:
            other.execute("begin immediate")
            with pytest.raises(OSError, match="another process has locked its database"):
                made.save(KEYS[0], chunk(made, KEYS[0], 1))
        made.save(KEYS[0], chunk(made, KEYS[0], 1))
        assert version_of(made, KEYS[0]) == 1


def test_what_a_disk_does_not_flush_is_written_elsewhere(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """After a flush that failed the kernel takes the log for written: it is brought into the database."""
    with opened(tmp_path) as made:
        made.save(KEYS[0], chunk(made, KEYS[0], 1))
        with monkeypatch.context() as patch:
            patch.setattr(os, "fdatasync", failing(errno.EIO))
            with pytest.raises(OSError, match="Input/output"):
                made.flush()
        made.flush()
        assert (tmp_path / "map.db-wal").stat().st_size == 0
        made.save(KEYS[0], chunk(made, KEYS[0], 2))
        flushed: list[int] = []
        monkeypatch.setattr(os, "fdatasync", flushed.append)
        made.flush()
        assert len(flushed) == 1


def test_saving_and_reading_beside_the_log_brought_in(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Threads that save, load and flush: each reads a version that was saved."""
    monkeypatch.setattr(map_database, "LOG_BYTES", 1 << 16)
    failed: list[BaseException] = []
    with opened(tmp_path) as made:
        for key in KEYS:
            made.save(key, chunk(made, key, 1))

        def work(key: ChunkKey) -> None:
            try:
                for version in range(2, 60):
                    made.save(key, chunk(made, key, version))
                    made.flush()
                    assert version_of(made, key) == version
                    assert all(version_of(made, other) for other in KEYS)
            except BaseException as error:  # noqa: BLE001  asserted below
                failed.append(error)

        threads = [threading.Thread(target=work, args=(key,)) for key in KEYS]
        for one in threads:
            one.start()
        for one in threads:
            one.join()
        assert not failed
        assert (made.record.lost_chunks, made.damaged) == ({}, {})


# --- damage -------------------------------------------------------------------------------------


def flipped(data: bytes) -> bytes:
    return data[:-1] + bytes([data[-1] ^ 1])


def test_a_damaged_chunk_stays_and_is_saved_beside(tmp_path: Path) -> None:
    with opened(tmp_path) as made:
        for key in KEYS:
            made.save(key, chunk(made, key, 2))
        change_chunk(tmp_path, KEYS[0], flipped)
        damaged = saved_bytes(tmp_path, KEYS[0])
        assert made.load(KEYS[0]) is None
        assert (list(made.record.lost_chunks), list(made.found_lost)) == ([KEYS[0]], [KEYS[0]])
        made.note_remade(KEYS[0])
        made.save(KEYS[0], chunk(made, KEYS[0], 1))
        with database(tmp_path) as reader:
            assert (damaged,) in reader.execute("select data from chunks").fetchall()
    with opened(tmp_path) as again:
        assert [version_of(again, key) for key in KEYS] == [1, 2, 2]
        assert again.record.lost_chunks[KEYS[0]].version == 2
        assert KEYS[0].text in again.losses(9)[0][0]


def test_what_was_lost_before_has_its_name_where_tables_are_damaged_at_the_start(tmp_path: Path) -> None:
    """The record can be read, only the rows cannot; and nothing else of that chunk is left."""
    lost = {KEYS[1].text: Lost(3, "it was on a page that is gone")}
    with opened(tmp_path) as made:
        made.save(KEYS[0], chunk(made, KEYS[0], 2))
        made.record.lost.update(lost)
        made.write_record()
    with database(tmp_path) as writer:
        writer.execute("insert into chunks(key) values('no key')")
    with opened(tmp_path) as again:
        assert list(again.damaged) == ["map.db.damaged.1"]
        assert version_of(again, KEYS[0]) == 2
        assert (again.record.lost, list(again.found_lost)) == (lost, [])


@pytest.fixture
def any_body(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have bodies of any bytes: headers and checksums are checked as ever, and nothing is decompressed."""

    def checked(data: bytes, identity: ChunkIdentity, path: str) -> bytearray:
        check_identity(check_file(data, path), identity, path)
        return bytearray(data)

    monkeypatch.setattr(map_database, "decode_chunk", checked)


def stored(directory: Path, chunks: int, rng: random.Random) -> dict[ChunkKey, bytes]:
    """Make a map of chunks of many sizes, written in no order, half of them again."""
    saved: dict[ChunkKey, bytes] = {}
    keys = [ChunkKey(number % 40, number // 40, -1) for number in range(chunks)]
    with opened(directory) as made:
        for version in (1, 2):
            rng.shuffle(keys)
            for key in keys[: chunks // version]:
                body = rng.randbytes(max(40, min(60_000, int(rng.lognormvariate(7.0, 1.5)))))
                saved[key] = with_body(chunk(made, key, version), body)
                made.save(key, saved[key])
        made.write_record()
    return saved


def check_after_damage(
    directory: Path,
    saved: dict[ChunkKey, bytes],
    most: int,
    what: object,
    *,
    unnamed: Container[ChunkKey] = (),
) -> None:
    """What is not there has a name, and is not much; the map goes on, also over its next start."""
    with opened(directory) as made:
        found = loaded(made, saved)
        lost = {key for key, data in found.items() if data != saved[key]}
        assert len(lost) <= most, what
        lost = {key for key in lost if key in made.record.lost_chunks or key not in unnamed}
        assert lost == made.record.lost_chunks.keys(), what
        for key in saved:
            made.save(key, saved[key])
        made.write_record()
        assert loaded(made, saved) == saved, what
    with opened(directory) as again:
        assert again.record.lost_chunks.keys() == lost
        assert again.rows.keys() == saved.keys()


DAMAGES: dict[str, Callable[[random.Random], bytes]] = {
    "random": lambda rng: rng.randbytes(PAGE), "zeros": lambda _rng: bytes(PAGE),
    "a leaf": lambda rng: b"\x0d" + rng.randbytes(PAGE - 1),
    "half of it": lambda rng: rng.randbytes(PAGE // 2),
}  # fmt: skip


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_page_costs_at_most_four_chunks(tmp_path: Path, any_body: None, damage: str) -> None:
    """Each page of a tree, the first among them, and others drawn by chance."""
    rng = random.Random(damage)
    saved = stored(tmp_path / "good", 400, rng)
    kinds = page_kinds(tmp_path / "good")
    trees = [number for number, kind in kinds.items() if kind == "tree"]
    assert len(trees) > 3
    others = rng.sample(sorted(kinds.keys() - set(trees)), 20)
    for number in (*trees, *others):
        copy = tmp_path / f"{number}"
        shutil.copytree(tmp_path / "good", copy)
        damage_page(copy, number, DAMAGES[damage](rng))
        check_after_damage(copy, saved, 4, (damage, number, kinds[number]))
        shutil.rmtree(copy)


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_page_is_damaged_while_the_map_is_used(tmp_path: Path, any_body: None, damage: str) -> None:
    rng = random.Random(damage)
    saved = stored(tmp_path / "good", 120, rng)
    for number in page_kinds(tmp_path / "good"):
        copy = tmp_path / f"{number}"
        if rng.random() < 0.9 and number > 3:
            continue
        shutil.copytree(tmp_path / "good", copy)
        with opened(copy) as made:
            damage_page(copy, number, DAMAGES[damage](rng))
            for key in rng.sample(sorted(saved), 60):
                made.save(key, saved[key])
            found = loaded(made, saved)
            lost = {key for key, data in found.items() if data != saved[key]}
            named = set(made.record.lost_chunks)
            assert lost <= named == set(made.found_lost), number  # some were saved again since
            assert len(named) <= 4, number
            made.write_record()
        with opened(copy) as again:
            assert again.record.lost_chunks.keys() == named, number
            assert {key for key, data in loaded(again, saved).items() if data != saved[key]} == lost
        shutil.rmtree(copy)


# --- a log that is damaged --------------------------------------------------------------------------


def killed(directory: Path, rng: random.Random) -> dict[ChunkKey, bytes]:
    """Make a map of which a part is in the log alone, as after SIGKILL; the chunk saved last is the last."""
    good = directory.with_name("good")
    saved = stored(good, 24, rng)
    with opened(good) as made:
        for version in (3, 4):
            for key in rng.sample(sorted(saved), 12):
                del saved[key]
                saved[key] = with_body(chunk(made, key, version), rng.randbytes(rng.randrange(40, 9000)))
                made.save(key, saved[key])
        copy_of(good, directory)
    shutil.rmtree(good)
    return saved


def damage_log(directory: Path, number: int, data: bytes) -> None:
    with (directory / "map.db-wal").open("r+b") as file:
        file.seek(number * PAGE)
        file.write(data)


@pytest.mark.parametrize("damage", [*DAMAGES, "a bit"])
def test_a_damaged_page_of_the_log_costs_at_most_four_chunks(
    tmp_path: Path, any_body: None, damage: str
) -> None:
    """Those on it, each by name; not, in silence, all that was saved after it."""
    rng = random.Random(damage)
    saved = killed(tmp_path / "killed", rng)
    log = (tmp_path / "killed" / "map.db-wal").read_bytes()
    pages = range(len(log) // PAGE)
    for number in {*pages[:3], *pages[-3:], *rng.sample(pages, 14)}:
        copy = tmp_path / f"{number}"
        shutil.copytree(tmp_path / "killed", copy)
        if damage == "a bit":
            damage_log(copy, number, flipped(log[number * PAGE : number * PAGE + rng.randint(1, PAGE)]))
        else:
            damage_log(copy, number, DAMAGES[damage](rng))
        with closing(FolderToRead(copy)) as folder:
            found = check(folder, str(copy))
        assert found.damaged == "a page of its log is damaged"
        # the chunk saved last may have its name on that page alone
        check_after_damage(copy, saved, 4, (damage, number), unnamed={list(saved)[-1]})
        with opened(copy) as made:
            assert {one.chunk for one in found.lost} == {key.text for key in made.record.lost_chunks}, number
        assert (copy / "map.db.damaged.1-wal").stat().st_size == len(log)
        shutil.rmtree(copy)


def test_a_log_of_any_length_takes_little_memory(tmp_path: Path) -> None:
    with opened(tmp_path) as made:
        made.save(KEYS[0], chunk(made, KEYS[0], 3))
    (tmp_path / "map.db-wal").write_bytes(b"")
    os.truncate(tmp_path / "map.db-wal", 64 << 20)
    tracemalloc.start()
    try:
        found = checked(tmp_path)
        _, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert (found.damaged, list(found.rows)) == ("a page of its log is damaged", [KEYS[0]])
    assert most < 32 << 20


def test_a_log_of_another_map_is_put_aside(tmp_path: Path, any_body: None) -> None:
    """SQLite would overwrite the database with it; what was in its place is not there."""
    saved = stored(tmp_path / "map", 60, random.Random(1))
    killed(tmp_path / "other", random.Random(2))
    shutil.copy(tmp_path / "other" / "map.db-wal", tmp_path / "map")
    before = {name: (tmp_path / "map" / name).read_bytes() for name in files_of(tmp_path / "map")}
    with closing(FolderToRead(tmp_path / "map")) as folder:
        assert check(folder, "map").damaged == "its log is of another map"
    assert {name: (tmp_path / "map" / name).read_bytes() for name in before} == before
    with opened(tmp_path / "map") as made:
        assert loaded(made, saved) == saved
        assert made.losses(9) == (("map.db.damaged.1: map.db: its log is of another map",), 1)
    assert (tmp_path / "map" / "map.db.damaged.1-wal").read_bytes() == before["map.db-wal"]
    with opened(tmp_path / "map") as made:
        assert loaded(made, saved) == saved
        assert made.losses(9) == ((), 0)


def test_a_log_is_brought_in_at_the_start_or_the_reader_that_keeps_it_is_named(
    tmp_path: Path, any_body: None
) -> None:
    saved = killed(tmp_path / "map", random.Random(3))
    with database(tmp_path / "map") as reader:
        reader.execute("begin")
        reader.execute("select count(*) from chunks").fetchall()
        with pytest.raises(OSError, match="another process keeps reading"), opened(tmp_path / "map"):
            pass
        reader.execute("commit")
        with opened(tmp_path / "map") as made:
            assert loaded(made, saved) == saved
            assert (tmp_path / "map" / "map.db-wal").stat().st_size < 4 * PAGE


def test_a_database_that_is_shorter_or_no_database(tmp_path: Path, any_body: None) -> None:
    saved = stored(tmp_path / "good", 60, random.Random(1))
    changes: dict[str, Callable[[bytes], bytes]] = {
        "empty": lambda _data: b"", "text": lambda _data: b"no database" * 1000,
        "half": lambda data: data[: len(data) // 2],
    }  # fmt: skip
    for name, change in changes.items():
        shutil.copytree(tmp_path / "good", tmp_path / name)
        file = tmp_path / name / "map.db"
        damaged = change(file.read_bytes())
        file.write_bytes(damaged)
        with opened(tmp_path / name) as made:
            assert made.record.runs > 1, "its record is in the copy"
            assert list(made.damaged) == ["map.db.damaged.1"]
            assert all(data == saved[key] for key, data in loaded(made, made.rows).items())
        assert (tmp_path / name / "map.db.damaged.1").read_bytes() == damaged
        with opened(tmp_path / name) as again:
            assert again.losses(9)[1] > 0, "nothing says what it had: it is named by each run"
        found = checked(tmp_path / name)
        assert (list(found.unknown), found.good) == (["map.db.damaged.1"], False)
        with closing(Folder(tmp_path / name)) as folder:
            repair(folder, found)
        assert not checked(tmp_path / name).unknown, "until it is forgotten on purpose"
        with opened(tmp_path / name) as forgotten:
            assert forgotten.losses(9) == ((), 0)


def test_the_record_is_in_the_copy_where_the_first_page_is_damaged(tmp_path: Path) -> None:
    """And the other way round; without either the map is not opened, and nothing is changed."""
    with opened(tmp_path) as made:
        made.add_mapper(1000, "front")
        map_id = made.map_id
    damage_page(tmp_path, 1, bytes(PAGE))
    with opened(tmp_path) as again:
        assert (again.map_id, [one.name for one in again.record.mappers]) == (map_id, ["front"])
        assert again.record.runs == 2
    for text in (b"{", b"[" * 200_000, b"\xff", b""):
        (tmp_path / "map.json").write_bytes(text)
        with opened(tmp_path) as again:
            assert (again.map_id, [one.name for one in again.record.mappers]) == (map_id, ["front"])
    for value in ("null", "7", "0.5", "x'ff'", "'{'"):  # by one byte of the row's header, or of its text
        with opened(tmp_path) as made:
            made.write_record()
        with database(tmp_path) as writer:
            writer.execute(f"update map set record = {value}")
        with opened(tmp_path) as again:
            assert (again.map_id, [one.name for one in again.record.mappers]) == (map_id, ["front"])
    (tmp_path / "map.json").write_bytes(b"{")
    (tmp_path / "map.db").write_bytes(bytes(10 * PAGE))
    before = files_of(tmp_path)
    with pytest.raises(MapDataError, match="so is the copy of its record"), opened(tmp_path):
        pass
    assert files_of(tmp_path) == before


@pytest.mark.parametrize("fails", [(Folder, "sync"), (map_database, "read_rows")])
def test_a_disk_too_full_for_a_rebuild_is_tried_again(
    tmp_path: Path, any_body: None, monkeypatch: pytest.MonkeyPatch, fails: tuple[object, str]
) -> None:
    """Also where only the rebuilt one cannot be opened."""
    saved = stored(tmp_path, 60, random.Random(2))
    tree = [number for number, kind in page_kinds(tmp_path).items() if kind == "tree"]
    with opened(tmp_path) as made:
        for number in tree[1:]:
            damage_page(tmp_path, number, bytes(PAGE))
        with monkeypatch.context() as patch:
            patch.setattr(*fails, failing(errno.ENOSPC))
            key = next(iter(saved))
            for _ in range(2):
                with pytest.raises(OSError, match="No space"):
                    made.save(key, saved[key])
                with pytest.raises(OSError, match="No space"):
                    made.load(key)
                with pytest.raises(OSError, match=r"damaged|closed"):
                    made.flush()
                assert "map.db.new" not in files_of(tmp_path), "it takes no room"
        assert loaded(made, saved) == saved
        assert made.record.lost_chunks == {}
        made.flush()
    assert "map.db.new" not in files_of(tmp_path)


def test_a_kill_never_leaves_a_database_without_its_log(tmp_path: Path) -> None:
    for steps in range(20):
        (directory := tmp_path / str(steps)).mkdir()
        for name in ("map.db", "map.db-wal", "map.db-shm", "map.db.new"):
            (directory / name).write_text(name)
        left = iter(range(steps))

        class Killed(Folder):
            def rename(self, old: str, new: str, left: Iterator[int] = left) -> None:
                next(left)
                super().rename(old, new)

            def remove(self, name: str, left: Iterator[int] = left) -> None:
                next(left)
                super().remove(name)

        with closing(Killed(directory)) as folder, suppress(StopIteration):
            replace_database(folder, "map.db.damaged.3")
        names = files_of(directory)
        ended = "map.db.new" not in names
        assert ended or "map.db" not in names or "map.db-wal" in names
        began = "map.db" not in names
        with closing(Folder(directory)) as next_one:
            assert finish_replacing(next_one) == began
        if began or ended:
            assert {path.name: path.read_text() for path in directory.iterdir()} == {
                "map.db": "map.db.new", "map.db.damaged.3": "map.db", "map.db.damaged.3-wal": "map.db-wal",
            }  # fmt: skip
        if ended:
            return
    raise AssertionError("it never came to its end")


@pytest.mark.parametrize("kind", ["pipe", "of another one"])
def test_a_journal_is_not_undone(tmp_path: Path, any_body: None, kind: str) -> None:
    """SQLite would overwrite pages from it, or wait for the pipe."""
    saved = stored(tmp_path / "map", 20, random.Random(1))
    stored(tmp_path / "other", 3, random.Random(2))
    journal = tmp_path / "map" / "map.db-journal"
    if kind == "pipe":
        os.mkfifo(journal)
    else:
        with database(tmp_path / "other") as other:
            for text in ("journal_mode = delete", "cache_size = 1"):
                other.execute(f"pragma {text}")
            other.execute("begin")
            other.execute("update chunks set data = zeroblob(9000)")
            shutil.copy(tmp_path / "other" / journal.name, journal)
    with pytest.raises(MapDataError, match="no daemon makes it"), opened(tmp_path / "map"):
        pass
    with closing(FolderToRead(tmp_path / "map")) as folder, pytest.raises(MapDataError, match="no daemon"):
        check(folder, "map")
    journal.unlink()
    with opened(tmp_path / "map") as made:
        assert loaded(made, saved) == saved
