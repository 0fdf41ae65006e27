# SPDX-License-Identifier: Apache-2.0
"""`shmmap live fsck|export|reset`: exit codes, JSON, hints."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from shmmap.daemon.live.disk.folder import Folder
from tests.support.divided_map import read_pcd
from tests.support.live_reference import contents, stored_drive
from tests.unit.conftest import Verb


@pytest.fixture
def directory(tmp_path: Path) -> Path:
    stored_drive(tmp_path / "lidar", 2)
    return tmp_path / "lidar"


def damage(directory: Path) -> Path:
    path = max(directory.glob("*.chunk"), key=lambda path: path.stat().st_size)
    path.write_bytes(path.read_bytes()[:-5])
    return path


def test_a_good_map_is_checked(directory: Path, verb: Verb) -> None:
    said = verb(["live", "fsck", str(directory)])
    assert said.err == ""
    assert f"{len(list(directory.glob('*.chunk')))} chunks" in said.out
    found = json.loads(verb(["live", "fsck", "--json", str(directory)]).out)
    assert found["good"] is True
    assert found["chunks"] == len(list(directory.glob("*.chunk")))
    assert found["active"] == found["occupied"] + found["free"] > 100
    assert found["bytes"] == sum(path.stat().st_size for path in directory.glob("*.chunk"))
    assert (found["manifest"], found["rewritten"], found["damaged"]) == ("current", False, [])


def test_a_damaged_map_is_checked_and_repaired(directory: Path, verb: Verb) -> None:
    path = damage(directory)
    before = contents(directory)
    said = verb(["live", "fsck", str(directory)], 65)
    assert f"damaged: {path.name}: " in said.out
    assert "hint: --repair" in said.err
    assert contents(directory) == before
    (damaged,) = json.loads(verb(["live", "fsck", "--repair", "--json", str(directory)], 65).out)["damaged"]
    assert damaged["file"] == path.name
    assert damaged["kept_as"] == f"{path.name}.damaged.1"
    assert (directory / damaged["kept_as"]).read_bytes() == before[path.name]
    assert damaged["kept_as"] in verb(["live", "fsck", str(directory)]).out


def test_a_missing_chunk(directory: Path, verb: Verb) -> None:
    path = max(directory.glob("*.chunk"))
    path.unlink()
    said = verb(["live", "fsck", str(directory)], 65).out
    assert f"missing: chunk {path.name.removesuffix('.chunk')}: " in said


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


def test_a_map_whose_record_is_unreadable(directory: Path, verb: Verb) -> None:
    (directory / "map.json").write_bytes(b"{")
    before = contents(directory)
    said = verb(["live", "fsck", "--repair", str(directory)], 65).err
    assert "map.json" in said
    assert "hint: bring the file back" in said
    assert contents(directory) == before
    verb(["live", "reset", str(directory), "--yes"])
    assert contents(directory / "reset.1") == before


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
    path = damage(directory)
    words = ["live", "export", str(directory), "-o", str(tmp_path / "out.ply")]
    assert "hint: `shmmap live fsck`" in verb(words, 65).err
    assert not (tmp_path / "out.ply").exists()
    verb(["live", "fsck", "--repair", str(directory)], 65)
    said = verb([*words, "--json"])
    assert f'"{path.name}.damaged.1"' in said.out
    assert "1 damaged file in quarantine" in said.err


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
