# SPDX-License-Identifier: Apache-2.0
"""`shmmap live fsck|export|reset`: exit codes, JSON, hints."""

from __future__ import annotations

import json
import shutil
from contextlib import closing
from pathlib import Path

import pytest

from shmmap.chunks.voxels import ChunkKey
from shmmap.live_worker.disk.folder import Folder
from shmmap.live_worker.disk.map_database import MapDatabase
from tests.support.divided_map import read_pcd
from tests.support.live_drive import SETTINGS
from tests.support.live_reference import contents, old_directory, stored_drive
from tests.support.stored_chunks import PAGE, change_chunk, chunk_sizes, damage_page, largest
from tests.unit.conftest import Verb


@pytest.fixture
def directory(tmp_path: Path) -> Path:
    stored_drive(tmp_path / "lidar", 2)
    return tmp_path / "lidar"


def damage(directory: Path) -> str:
    """Damage a chunk; return its key."""
    key = largest(directory)
    change_chunk(directory, key, lambda data: data[:-5])
    return key.text


def test_a_good_map_is_checked(directory: Path, verb: Verb) -> None:
    said = verb(["live", "fsck", str(directory)])
    sizes = chunk_sizes(directory)
    assert said.err == ""
    assert f"{len(sizes)} chunks" in said.out
    found = json.loads(verb(["live", "fsck", "--json", str(directory)]).out)
    assert found["good"] is True
    assert found["chunks"] == len(sizes)
    assert found["active"] == found["occupied"] + found["free"] > 100
    assert found["bytes"] == sum(sizes.values())
    assert (found["lost"], found["rebuilt_from"], found["damaged"]) == ([], "", "")


def test_a_damaged_map_is_checked_and_repaired(directory: Path, verb: Verb) -> None:
    key = damage(directory)
    before = contents(directory)
    said = verb(["live", "fsck", str(directory)], 65)
    assert f"lost: chunk {key}: version " in said.out
    assert "let --repair" in said.err
    assert contents(directory) == before
    found = json.loads(verb(["live", "fsck", "--repair", "--json", str(directory)], 65).out)
    assert [one["chunk"] for one in found["lost"]] == [key]
    assert found["rebuilt_from"] == "map.db.damaged.1"
    assert (directory / "map.db.damaged.1").read_bytes() == before["map.db"]
    assert "map.db.damaged.1" in verb(["live", "fsck", str(directory)]).out


def test_damaged_tables(directory: Path, verb: Verb) -> None:
    keys = chunk_sizes(directory)
    damage_page(directory, 1, bytes(PAGE))
    before = contents(directory)
    said = verb(["live", "fsck", str(directory)], 65).out
    assert "damaged: its tables are damaged: file is not a database" in said
    assert contents(directory) == before
    found = json.loads(verb(["live", "fsck", "--repair", "--json", str(directory)], 65).out)
    assert (found["chunks"], found["lost"]) == (len(keys), [])
    verb(["live", "fsck", str(directory)])


def test_while_another_process_works_with_it(directory: Path, verb: Verb, tmp_path: Path) -> None:
    folder = Folder(directory)
    assert "--read-only" in verb(["live", "fsck", str(directory)], 75).err
    verb(["live", "fsck", "--read-only", str(directory)])
    said = verb(["live", "export", str(directory), "-o", str(tmp_path / "out.ply")]).out
    assert "`shmmap live save`" in said
    before = contents(directory)
    assert "stop the daemon" in verb(["live", "reset", str(directory), "--yes"], 75).err
    assert contents(directory) == before
    folder.close()


@pytest.mark.parametrize(
    "words", [["fsck"], ["fsck", "--repair"], ["export", "-o", "x.ply"], ["reset", "--yes"]]
)
def test_no_live_map(tmp_path: Path, verb: Verb, words: list[str]) -> None:
    (tmp_path / "mine").write_bytes(b"mine")
    assert "is no live map" in verb(["live", *words, str(tmp_path)], 66).err
    assert "there is no directory" in verb(["live", *words, str(tmp_path / "none")], 66).err
    assert contents(tmp_path) == {"mine": b"mine"}


@pytest.mark.parametrize("words", [["fsck"], ["export", "-o", "x.ply"], ["reset", "--yes"]])
def test_a_name_that_no_live_map_has(
    tmp_path: Path, verb: Verb, words: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    monkeypatch.setenv("SHMMAP_INSTANCE", "town")
    assert "no live map is set up" in verb(["live", *words, "roof"], 66).err
    for name in ("lidar", "rear"):
        stored_drive(tmp_path / "shmmap/town/live" / name, 0)
    said = verb(["live", *words, "lidra"], 66).err
    assert "neither a directory nor a live map 'lidra'\nhint: live maps here: lidar, rear\n" in said
    assert "0 chunks" in verb(["live", "fsck", "lidar"]).out


def test_a_map_whose_record_is_unreadable(directory: Path, verb: Verb) -> None:
    (directory / "map.json").write_bytes(b"{")
    verb(["live", "fsck", str(directory)])
    damage_page(directory, 1, bytes(PAGE))
    damage_page(directory, 2, bytes(PAGE))
    before = contents(directory)
    said = verb(["live", "fsck", "--repair", str(directory)], 65).err
    assert "not a database" in said
    assert contents(directory) == before
    verb(["live", "reset", str(directory), "--yes"])
    assert contents(directory / "reset.1") == before


def test_a_map_of_an_earlier_version(tmp_path: Path, verb: Verb) -> None:
    """Nothing reads it but the daemon's start, which imports it; it can be put aside."""
    old_directory(tmp_path / "old", 2)
    before = contents(tmp_path / "old")
    for words in (["fsck"], ["fsck", "--repair"], ["export", "-o", str(tmp_path / "x.ply")]):
        assert "shmmap serve --live NAME=DIR" in verb(["live", *words, str(tmp_path / "old")], 65).err
    assert contents(tmp_path / "old") == before
    verb(["live", "reset", str(tmp_path / "old"), "--yes"])
    assert contents(tmp_path / "old" / "reset.1") == before


def test_exports(directory: Path, verb: Verb, tmp_path: Path) -> None:
    out = tmp_path / "out.pcd"
    words = ["live", "export", str(directory), "-o", str(out)]
    made = json.loads(verb([*words, "--json", "--voxels", "both", "--translate", "-1,2,-3"]).out)
    assert (made["path"], made["format"], made["cells"]) == (str(out), "pcd", 0)
    assert made["origin"] == [1.0, -2.0, 3.0]
    assert made["fields"] == [["x", "<f4"], ["y", "<f4"], ["z", "<f4"], ["intensity", "<f4"]]
    assert made["voxels"] == len(read_pcd(out)["x"]) > 100
    assert f"{out} exists" in verb(words, 2).err
    verb([*words, "--force"])
    said = verb(["live", "export", str(directory), "-o", str(tmp_path / "map"), "--cell-size", "10"])
    assert "cells" in said.out
    assert said.err == ""
    assert json.loads((tmp_path / "map" / "shmmap_divide.json").read_text())["cell_size"] == 10.0


def test_exports_of_a_damaged_map(directory: Path, verb: Verb, tmp_path: Path) -> None:
    key = damage(directory)
    words = ["live", "export", str(directory), "-o", str(tmp_path / "out.ply")]
    assert "hint: `shmmap live fsck`" in verb(words, 65).err
    assert not (tmp_path / "out.ply").exists()
    with closing(Folder(directory)) as folder, closing(MapDatabase(folder, SETTINGS)) as database:
        assert database.load(ChunkKey.from_text(key)) is None  # as a daemon that finds it
        database.write_record()
    said = verb([*words, "--json"])
    assert json.loads(said.out)["lost"] == [key]
    assert f"what is lost of 1 chunk: {key}" in said.err


def test_nothing_to_export(tmp_path: Path, verb: Verb) -> None:
    stored_drive(tmp_path / "lidar", 0)
    words = ["live", "export", str(tmp_path / "lidar"), "-o", str(tmp_path / "out.ply")]
    assert "no occupied voxel" in verb(words, 1).err
    verb([*words, "--allow-empty"])
    assert not (tmp_path / "out.ply").exists()


def test_resets(directory: Path, verb: Verb) -> None:
    before = contents(directory)
    said = verb(["live", "reset", str(directory)], 2).err
    assert f"{len(before)} files" in said
    assert "hint: --yes" in said
    assert contents(directory) == before
    document = json.loads(verb(["live", "reset", str(directory), "--yes", "--json"]).out)
    assert document == {
        "path": str(directory), "moved_to": str(directory / "reset.1"), "files": len(before),
        "bytes": sum(map(len, before.values())),
    }  # fmt: skip
    assert contents(directory / "reset.1") == before
    verb(["live", "fsck", str(directory / "reset.1")])
    verb(["live", "fsck", str(directory)], 66)
    verb(["live", "reset", str(directory / "reset.1"), "--yes", "--delete"])
    assert contents(directory) == {}


def test_a_name_stands_for_its_directory(
    directory: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, verb: Verb
) -> None:
    """By the state directory, or by the settings; a directory of that name here comes first."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.chdir(tmp_path)
    place = tmp_path / "state" / "shmmap" / "default" / "live" / "radar"
    place.parent.mkdir(parents=True)
    shutil.copytree(directory, place)
    verb(["live", "fsck", "radar", "--json"])
    settings = tmp_path / "config" / "shmmap" / "shmmap.toml"
    settings.parent.mkdir(parents=True)
    settings.write_text(f'[live.radar]\npath = "{directory}"\n')
    damage(directory)
    verb(["live", "fsck", "radar", "--read-only"], 65)
    verb(["live", "fsck", "sonar"], 66)
