# SPDX-License-Identifier: Apache-2.0
"""A live map on disk: durable when it says so, whatever the power does; damaged files are kept."""

from __future__ import annotations

import contextlib
import errno
import os
import random
import re
import shutil
from pathlib import Path

import msgspec
import pytest

from shmmap.chunks.chunk_file import encode_chunk
from shmmap.chunks.layout import ChunkIdentity, ChunkView, new_header
from shmmap.chunks.occupancy import Occupancy
from shmmap.chunks.voxels import ChunkKey
from shmmap.daemon.live.disk.folder import Folder
from shmmap.daemon.live.disk.map_files import SCANS_AHEAD, MapFiles
from shmmap.daemon.live.disk.map_record import MapSettings, Row
from shmmap.errors import ConfigError, MapDataError
from tests.support.disks import CutDisk, PowerCut
from tests.support.odd_files import ODD_FILES, failing

SETTINGS = MapSettings(resolution=0.1)
KEYS = [ChunkKey(0, 0, 0), ChunkKey(-1, 2, 0), ChunkKey(5, 5, -5)]


def identity(made: MapFiles, key: ChunkKey) -> ChunkIdentity:
    return ChunkIdentity(made.map_id, key, 0.1, -1992, 3476, 0, 0, 1, "map")


def chunk(made: MapFiles, key: ChunkKey, version: int) -> bytes:
    """The file of an empty chunk of this version."""
    view = ChunkView(new_header(identity(made, key)))
    view.state["version"] = version
    return encode_chunk(view, "raw")


def version_of(made: MapFiles, key: ChunkKey) -> int:
    """The version that a chunk's file holds, read whole; 0 where there is none."""
    data = made.load(key)
    return int(ChunkView(data).state["version"]) if data is not None else 0


def test_a_map_is_made_and_found_again(tmp_path: Path) -> None:
    folder = Folder(tmp_path / "state" / "lidar")
    made = MapFiles(folder, SETTINGS)
    assert (made.settings, made.mappers, made.rows) == (SETTINGS, [], {})
    assert made.begin_run() == 1
    mapper = made.add_mapper(1000, "front")
    made.expect_scan(mapper, 0)
    made.save(KEYS[0], chunk(made, KEYS[0], 3))
    made.save(KEYS[1], chunk(made, KEYS[1], 1))
    made.write_manifest()
    folder.close()
    assert (tmp_path / "state" / "lidar").stat().st_mode & 0o777 == 0o700
    again = MapFiles(folder := Folder(tmp_path / "state" / "lidar"), SETTINGS)
    assert again.map_id == made.map_id
    assert again.begin_run() == 2
    assert [(m.number, m.uid, m.name, m.scans) for m in again.mappers] == [(1, 1000, "front", SCANS_AHEAD)]
    assert again.rows == {KEYS[0]: Row(3, 2688, 0, 0, 0, 0), KEYS[1]: Row(1, 2688, 0, 0, 0, 0)}
    assert [version_of(again, key) for key in KEYS] == [3, 1, 0]
    assert not again.missing
    assert not again.damaged


@pytest.mark.parametrize(
    ("other", "key"),
    [
        (MapSettings(resolution=0.2), "resolution"),
        (MapSettings(resolution=0.1, frame_id="odom"), "frame_id"),
        (MapSettings(resolution=0.1, occupancy=Occupancy(hit=0.8)), "hit"),
    ],
)
def test_other_settings_are_refused(other: MapSettings, key: str) -> None:
    disk = CutDisk()
    MapFiles(disk, SETTINGS)
    with pytest.raises(ConfigError, match="was made with") as caught:
        MapFiles(disk, other)
    assert caught.value.key == key


@pytest.mark.parametrize("name", ["0_0_0.chunk", "manifest.json"])
def test_chunks_without_a_map_are_left_alone(name: str) -> None:
    disk = CutDisk()
    disk.write(name, b"whatever")
    with pytest.raises(MapDataError, match="missing"):
        MapFiles(disk, SETTINGS)
    assert disk.names() == [name]


def test_a_damaged_file_is_quarantined_and_never_overwritten(tmp_path: Path) -> None:
    folder = Folder(tmp_path)
    made = MapFiles(folder, SETTINGS)
    for key in KEYS:
        made.save(key, chunk(made, key, 2))
    made.write_manifest()
    first = tmp_path / "0_0_0.chunk"
    first.write_bytes(b"CORRUPTED DATA")
    with (tmp_path / "-1_2_0.chunk").open("r+b") as file:
        file.truncate(1000)
    os.rename(tmp_path / "5_5_-5.chunk", tmp_path / "7_7_7.chunk")
    again = MapFiles(folder, SETTINGS)
    assert sorted(again.damaged) == [
        "-1_2_0.chunk.damaged.1",
        "0_0_0.chunk.damaged.1",
        "7_7_7.chunk.damaged.1",
    ]
    assert again.rows == {}
    assert set(again.missing) == {*KEYS, ChunkKey(7, 7, 7)}, "of which it is not known what it was"
    again.save(KEYS[0], chunk(again, KEYS[0], 1))
    again.flush()
    assert again.quarantine(KEYS[0], "its body is damaged") == "0_0_0.chunk.damaged.2"
    assert (tmp_path / "0_0_0.chunk.damaged.1").read_bytes() == b"CORRUPTED DATA"
    assert again.load(KEYS[0]) is None


def test_a_file_that_did_not_get_its_name_is_taken_if_it_is_newer() -> None:
    disk = CutDisk()
    made = MapFiles(disk, SETTINGS)
    made.save(KEYS[0], chunk(made, KEYS[0], 5))
    disk.write(".0_0_0.chunk.aaaa.tmp", chunk(made, KEYS[0], 7))
    disk.write(".0_0_0.chunk.bbbb.tmp", chunk(made, KEYS[0], 6))
    disk.write(".0_0_0.chunk.cccc.tmp", chunk(made, KEYS[0], 9)[:-1])
    disk.write(".-1_2_0.chunk.dddd.tmp", chunk(made, KEYS[1], 1))
    disk.write(".chunk.eeee.tmp", chunk(made, KEYS[2], 3))
    disk.write(".2_3_5.chunk.ffff.tmp", chunk(made, KEYS[1], 2))
    disk.write(".map.json.ffff.tmp", b"{}")
    again = MapFiles(disk, SETTINGS)
    assert [version_of(again, key) for key in KEYS] == [7, 2, 3], "whatever they are called"
    assert sorted(disk.names()) == sorted([*(key.text + ".chunk" for key in KEYS), "map.json"])


@pytest.mark.parametrize(("what", "before"), [("write", 1), ("overwrite", 2)])
def test_a_full_disk_leaves_what_there_was(monkeypatch: pytest.MonkeyPatch, what: str, before: int) -> None:
    """All that is spare gives its room back."""
    disk = CutDisk()
    made = MapFiles(disk, SETTINGS)
    for version in range(1, before + 1):
        for key in KEYS:
            made.save(key, chunk(made, key, version))
        made.flush()
    with monkeypatch.context() as patch:
        patch.setattr(disk, what, failing(errno.ENOSPC))
        with pytest.raises(OSError, match="No space"):
            made.save(KEYS[0], chunk(made, KEYS[0], 9))
    assert sorted(disk.names()) == sorted([*(key.text + ".chunk" for key in KEYS), "map.json"])
    assert [version_of(made, key) for key in KEYS] == [before] * 3
    made.save(KEYS[0], chunk(made, KEYS[0], 10))
    made.flush()
    assert version_of(MapFiles(disk, SETTINGS), KEYS[0]) == 10


def test_files_are_written_over_again(tmp_path: Path) -> None:
    """Making a file takes long: what was replaced is used again, once nothing can need it."""
    folder = Folder(tmp_path)
    made = MapFiles(folder, SETTINGS)
    files = []
    for version in range(1, 8):
        for key in KEYS:
            made.save(key, chunk(made, key, version))
        made.flush()
        files.append({path.stat().st_ino for path in tmp_path.iterdir() if ".chunk" in path.name})
    assert [len(some) for some in files[:2]] == [len(KEYS), 2 * len(KEYS)]
    assert all(later == files[1] for later in files[2:]), "no more are made"
    assert [version_of(made, key) for key in KEYS] == [7, 7, 7]
    made.remove_spare()
    assert sorted(folder.names()) == sorted([*(key.text + ".chunk" for key in KEYS), "map.json"])


def test_who_reads_a_file_that_is_written_over_reads_the_one_in_its_place(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    folder = Folder(tmp_path)
    for name, content in (("one", b"a" * 5000), ("other", b"b" * 4000)):
        folder.write(name, content)
        os.utime(tmp_path / name, (0, 0))
    read = os.read

    def meanwhile(fd: int, most: int) -> bytes:
        monkeypatch.setattr(os, "read", read)
        half = read(fd, most // 2)
        folder.exchange("one", "other")
        folder.overwrite("other", b"c" * 5000)
        return half

    monkeypatch.setattr(os, "read", meanwhile)
    assert folder.read("one") == b"b" * 4000
    assert folder.read("other") == b"c" * 5000
    folder.overwrite("other", b"d" * 10)
    assert folder.read("other") == b"d" * 10


@pytest.mark.parametrize("what", ["sync", "rename", "sync_names"])
def test_what_a_disk_does_not_flush_is_kept_and_written_again(
    monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    """After a flush that failed, what the kernel had may be gone: the second one has nothing of it."""
    disk = CutDisk()
    made = MapFiles(disk, SETTINGS)
    for key in KEYS:
        made.save(key, chunk(made, key, 1))
    made.flush()
    names = sorted(disk.names())
    disk.exchanges = what != "rename"
    for key in KEYS:
        made.save(key, chunk(made, key, 2))
    unflushed = made.unflushed_bytes
    with monkeypatch.context() as patch:
        calls = [0]

        def at_the_second(*arguments: str) -> None:
            calls[0] += 1
            if calls[0] == 2 or what == "sync_names":
                failing(errno.ENOSPC)()
            getattr(CutDisk, what)(disk, *arguments)

        patch.setattr(disk, what, at_the_second)
        with pytest.raises(OSError, match="No space"):
            made.flush()
    assert [version_of(made, key) for key in KEYS] == [2, 2, 2]
    assert made.unflushed_bytes == unflushed
    made.save(KEYS[1], chunk(made, KEYS[1], 3))
    written = noted(monkeypatch, disk, "write")
    made.flush()
    assert len(written) == 2, "those that nothing newer has come for"
    made.remove_spare()
    assert sorted(disk.names()) == names
    assert made.unflushed_bytes == 0
    after = MapFiles(disk.after(lambda: False, lambda _size: 0), SETTINGS)
    assert [version_of(after, key) for key in KEYS] == [2, 3, 2]


def test_what_is_saved_often_is_flushed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    disk = CutDisk()
    made = MapFiles(disk, SETTINGS)
    for version in (1, 2, 3):
        made.save(KEYS[0], chunk(made, KEYS[0], version))
        assert len([name for name in disk.names() if name.endswith(".tmp")]) == min(version, 2)
        assert version_of(made, KEYS[0]) == version
    synced = noted(monkeypatch, disk, "sync")
    made.flush()
    assert len(synced) == 1
    assert "0_0_0.chunk" in disk.names()


@pytest.mark.parametrize("again", [False, True])
def test_what_is_saved_while_it_is_flushed(monkeypatch: pytest.MonkeyPatch, *, again: bool) -> None:
    """The older one gets its place, the newer one is for the next time; also after a flush that failed."""
    disk = CutDisk()
    made = MapFiles(disk, SETTINGS)
    made.save(KEYS[0], chunk(made, KEYS[0], 1))
    if again:
        with monkeypatch.context() as patch:
            patch.setattr(disk, "sync_names", failing(errno.ENOSPC))
            with pytest.raises(OSError, match="No space"):
                made.flush()

    def meanwhile(name: str) -> None:
        made.save(KEYS[0], chunk(made, KEYS[0], 2))
        CutDisk.sync(disk, name)

    with monkeypatch.context() as patch:
        patch.setattr(disk, "sync", meanwhile)
        made.flush()
    assert version_of(made, KEYS[0]) == 2
    assert made.unflushed_bytes
    made.write_manifest()
    assert made.unflushed_bytes == 0
    made.remove_spare()
    assert sorted(disk.names()) == ["0_0_0.chunk", "manifest.json", "map.json"]
    assert version_of(MapFiles(disk, SETTINGS), KEYS[0]) == 2


def noted(monkeypatch: pytest.MonkeyPatch, disk: CutDisk, what: str) -> list[str]:
    """Names of files with which something is done from now on."""
    found: list[str] = []

    def do(name: str, *more: bytes) -> None:
        found.append(name)
        getattr(CutDisk, what)(disk, name, *more)

    monkeypatch.setattr(disk, what, do)
    return found


class Drive:
    """A map that is written for a while; it knows what it was promised."""

    def __init__(self, disk: CutDisk) -> None:
        self.durable: dict[ChunkKey, int] = {}
        self.mappers = 0
        self.run = 0
        self._disk = disk

    def go(self, rng: random.Random) -> None:
        made = MapFiles(self._disk, SETTINGS)
        self.map_id = made.map_id
        saved: dict[ChunkKey, int] = {key: row.version for key, row in made.rows.items()}
        self.run = made.begin_run()
        for _ in range(30):
            what = rng.random()
            key = rng.choice(KEYS)
            if what < 0.6:
                version = saved.get(key, 0) + rng.randint(1, 3)
                made.save(key, chunk(made, key, version))
                saved[key] = version
            elif what < 0.8:
                made.flush()
                self.durable.update(saved)
            elif what < 0.9:
                made.write_manifest()
                self.durable.update(saved)
            else:
                self.mappers = made.add_mapper(0, "m").number


@pytest.mark.parametrize("exchanges", [True, False])
@pytest.mark.parametrize("seed", range(60))
def test_a_power_cut_at_any_operation_loses_nothing_durable(seed: int, exchanges: bool) -> None:
    """The disk may then be in any state that is allowed; and the power may fail again in the next run."""
    rng = random.Random(seed)
    disk = CutDisk(rng.randint(0, 70), exchanges)
    durable: dict[ChunkKey, int] = {}
    mappers = run = 0
    for _ in range(4):
        drive = Drive(disk)
        with contextlib.suppress(PowerCut):
            drive.go(rng)
        durable = {**durable, **{key: max(v, durable.get(key, 0)) for key, v in drive.durable.items()}}
        mappers, run = max(mappers, drive.mappers), max(run, drive.run)
        disk = disk.after(lambda: rng.random() < 0.5, lambda size: rng.randint(-size, size))
        made = MapFiles(disk, SETTINGS)
        assert not made.missing
        assert not made.damaged
        for key, version in durable.items():
            assert version_of(made, key) >= version
        for key in made.rows:
            assert version_of(made, key) == made.rows[key].version
        assert not [name for name in disk.names() if name.endswith(".tmp")]
        assert made.add_mapper(0, "next").number > mappers
        assert made.begin_run() > run
        mappers += 1
        disk.operations, disk.exchanges = rng.randint(0, 70), exchanges


def test_the_manifest_lists_what_is_durable() -> None:
    disk = CutDisk()
    made = MapFiles(disk, SETTINGS)
    made.save(KEYS[0], chunk(made, KEYS[0], 4))
    made.write_manifest()
    listed = msgspec.json.decode(disk.read("manifest.json"))
    assert listed == {
        "format": 1,
        "chunks": {
            "0_0_0": {"version": 4, "bytes": 2688, "active": 0, "occupied": 0, "free": 0, "bricks": 0}
        },
        "applied": {},
        "missing": {},
    }
    disk.remove("0_0_0.chunk")
    assert list(MapFiles(disk, SETTINGS).missing) == [KEYS[0]]


# --- whatever is in a file -----------------------------------------------------------------------


def stored(disk: CutDisk) -> dict[str, object]:
    """A map of a mapper and a chunk; what ``map.json`` says."""
    made = MapFiles(disk, SETTINGS)
    made.expect_scan(made.add_mapper(1000, "front"), 5)
    made.save(KEYS[0], chunk(made, KEYS[0], 3))
    made.write_manifest({1: 4})
    said: dict[str, object] = msgspec.json.decode(disk.read("map.json"))
    return said


def put(disk: CutDisk, name: str, data: bytes) -> None:
    disk.remove(name)
    disk.write(name, data)


MAPPER = {"number": 1, "uid": 0, "name": "a", "scans": 5}


@pytest.mark.parametrize(
    "changes",
    [
        b"", b"{", b'{"format":2,"map_id":"00","settings":{}}', b'{"format":1,"map_id":"x","settings":{}}',
        {"lives": -1}, {"lives": (1 << 31) - 1}, {"lives": 1 << 70}, {"lives": 1.5}, {"lives": "1"},
        {"lives": None}, {"format": 0}, {"format": True}, {"map_id": "0" * 31 + "g"}, {"map_id": " " * 32},
        {"map_id": "00" * 17}, {"next_mapper": 0}, {"next_mapper": 1}, {"next_mapper": -(1 << 63)},
        {"mappers": {}}, {"mappers": [7]},
        {"mappers": [MAPPER] * 2, "next_mapper": 9}, {"mappers": [{**MAPPER, "number": 0}]},
        {"mappers": [{**MAPPER, "scans": -1}]}, {"mappers": [{**MAPPER, "scans": (1 << 63) - 1}]},
        {"mappers": [{**MAPPER, "uid": -1}]}, {"mappers": [{**MAPPER, "name": None}]},
        {"mappers": [{**MAPPER, "number": n} for n in range(1, 40)], "next_mapper": 99},
        {"settings": None}, {"settings": {"resolution": 0.0}}, {"settings": {"resolution": 1e308}},
        {"settings": {"resolution": -0.1}}, {"settings": {"frame_id": ""}},
        {"settings": {"frame_id": "é" * 40}},
        {"settings": {"occupancy": {"hit": 7.0}}}, {"settings": {"occupancy": {"hit": "x"}}},
    ],
)  # fmt: skip
def test_a_map_file_that_cannot_be_is_damaged_and_stays(changes: dict[str, object] | bytes) -> None:
    """Every error is one that names the file: none ends the process, and nothing is changed."""
    disk = CutDisk()
    said = stored(disk)
    put(disk, "map.json", changes if isinstance(changes, bytes) else msgspec.json.encode({**said, **changes}))
    before = {name: disk.read(name) for name in disk.names()}
    with pytest.raises((MapDataError, ConfigError)) as failure:
        MapFiles(disk, SETTINGS)
    assert isinstance(failure.value, ConfigError) or "map.json" in failure.value.message
    assert {name: disk.read(name) for name in disk.names()} == before


ROW = '{"version":3,"bytes":9,"active":0,"occupied":0,"free":0,"bricks":0}'
NO_MANIFEST = [
    b"", b"\xff", b"[" * 100_000, b"{" * 100_000, b'{"a":' * 100_000, b"null", b'{"format":1}', b"\0" * 5000,
    b'{"format":2,"chunks":{}}', b'{"format":1,"chunks":{"x":' + ROW.encode() + b"}}",
    b'{"format":1,"chunks":{"0_0_0":' + ROW.replace("3", "-3").encode() + b"}}",
    b'{"format":1,"chunks":{"0_0_0":' + ROW.replace("3", str(1 << 64)).encode() + b"}}",
    b'{"format":1,"chunks":{"99999999999_0_0":' + ROW.encode() + b"}}",
    b'{"format":1,"chunks":{"0_0_0":' + ROW.encode() + b'},"applied":{"1":-4}}',
    b'{"format":1,"chunks":{"0_0_0\xe9":' + ROW.encode() + b"}}",
]  # fmt: skip


@pytest.mark.parametrize("text", NO_MANIFEST, ids=range(len(NO_MANIFEST)))
def test_a_manifest_that_cannot_be_is_quarantined_and_written_again(text: bytes) -> None:
    disk = CutDisk()
    stored(disk)
    put(disk, "manifest.json", text)
    again = MapFiles(disk, SETTINGS)
    assert list(again.damaged) == ["manifest.json.damaged.1"]
    assert disk.read("manifest.json.damaged.1") == text
    assert (list(again.rows), again.missing) == ([KEYS[0]], {})
    again.write_manifest()
    assert not MapFiles(disk, SETTINGS).damaged


def test_any_bit_of_any_file_may_flip() -> None:
    """The map opens or says what is damaged; of chunks that are good none is lost."""
    rng = random.Random(3)
    for _ in range(400):
        disk = CutDisk()
        stored(disk)
        name = rng.choice(["map.json", "manifest.json", "0_0_0.chunk"])
        data = bytearray(disk.read(name))
        at = rng.randrange(len(data) * 8)
        data[at // 8] ^= 1 << at % 8
        put(disk, name, bytes(data))
        try:
            again = MapFiles(disk, SETTINGS)
        except (MapDataError, ConfigError):
            assert name == "map.json"
            continue
        assert KEYS[0] in again.rows or name != "manifest.json"
        assert again.begin_run() < 1 << 31
        assert len(again.applied) <= 1


def test_what_a_manifest_says_of_scans_that_were_never_sent_does_not_count() -> None:
    disk = CutDisk()
    stored(disk)
    MapFiles(disk, SETTINGS).write_manifest({1: SCANS_AHEAD + 7, 9: 3})
    assert MapFiles(disk, SETTINGS).applied == {}


@pytest.mark.parametrize("name", ["map.json", "manifest.json", "0_0_0.chunk", ".chunk.ab.tmp"])
def test_a_file_of_a_tebibyte_is_not_read(tmp_path: Path, name: str) -> None:
    folder = Folder(tmp_path)
    made = MapFiles(folder, SETTINGS)
    made.save(KEYS[0], chunk(made, KEYS[0], 3))
    made.write_manifest()
    (tmp_path / name).touch()
    os.truncate(tmp_path / name, 1 << 40)
    if name == "map.json":
        with pytest.raises(MapDataError, match="more than 1,048,576 bytes"):
            MapFiles(folder, SETTINGS)
    else:
        again = MapFiles(folder, SETTINGS)
        assert list(again.damaged) == ([] if name.endswith(".tmp") else [f"{name}.damaged.1"])


@pytest.mark.parametrize("name", ["map.json", "manifest.json", "0_0_0.chunk", ".chunk.ab.tmp"])
@pytest.mark.parametrize("kind", ["directory", "pipe", "loop", "socket"])
def test_what_is_no_regular_file_keeps_the_map_closed(tmp_path: Path, name: str, kind: str) -> None:
    """It may hide a good file: nothing is changed until it is gone."""
    folder = Folder(tmp_path)
    made = MapFiles(folder, SETTINGS)
    made.save(KEYS[0], chunk(made, KEYS[0], 3))
    made.write_manifest()
    path = tmp_path / name
    if path.exists():
        path.rename(tmp_path / "kept")
    ODD_FILES[kind](path)
    before = sorted(os.listdir(tmp_path))
    with pytest.raises(OSError, match=f"{re.escape(name)} cannot be read: "):
        MapFiles(folder, SETTINGS)
    assert sorted(os.listdir(tmp_path)) == before
    shutil.rmtree(path) if kind == "directory" else path.unlink()
    if (tmp_path / "kept").exists():
        (tmp_path / "kept").rename(path)
    assert list(MapFiles(folder, SETTINGS).rows) == [KEYS[0]]
