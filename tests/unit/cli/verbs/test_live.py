# SPDX-License-Identifier: Apache-2.0
"""`shmmap live fsck|export|reset`: exit codes, JSON, hints."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from shmmap.cli.entry import main
from shmmap.daemon.live.disk.folder import Folder
from tests.support.divided_map import read_pcd
from tests.support.live_reference import contents, stored_drive

Captured = pytest.CaptureFixture[str]


@pytest.fixture
def directory(tmp_path: Path) -> Path:
    stored_drive(tmp_path / "lidar", 2)
    return tmp_path / "lidar"


def damage(directory: Path) -> Path:
    path = max(directory.glob("*.chunk"), key=lambda path: path.stat().st_size)
    path.write_bytes(path.read_bytes()[:-5])
    return path


def test_a_good_map_is_checked(directory: Path, capsys: Captured) -> None:
    assert main(["live", "fsck", str(directory)]) == 0
    said = capsys.readouterr()
    assert said.err == ""
    assert f"{len(list(directory.glob('*.chunk')))} chunks" in said.out
    assert main(["live", "fsck", "--json", str(directory)]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["good"] is True
    assert found["chunks"] == len(list(directory.glob("*.chunk")))
    assert found["active"] == found["occupied"] + found["free"] > 100
    assert found["bytes"] == sum(path.stat().st_size for path in directory.glob("*.chunk"))
    assert (found["manifest"], found["rewritten"], found["damaged"]) == ("current", False, [])


def test_a_damaged_map_is_checked_and_repaired(directory: Path, capsys: Captured) -> None:
    path = damage(directory)
    before = contents(directory)
    assert main(["live", "fsck", str(directory)]) == 65
    said = capsys.readouterr()
    assert f"damaged: {path.name}: " in said.out
    assert "hint: --repair" in said.err
    assert contents(directory) == before
    assert main(["live", "fsck", "--repair", "--json", str(directory)]) == 65
    (damaged,) = json.loads(capsys.readouterr().out)["damaged"]
    assert damaged["file"] == path.name
    assert damaged["kept_as"] == f"{path.name}.damaged.1"
    assert (directory / damaged["kept_as"]).read_bytes() == before[path.name]
    assert main(["live", "fsck", str(directory)]) == 0
    assert damaged["kept_as"] in capsys.readouterr().out


def test_a_missing_chunk(directory: Path, capsys: Captured) -> None:
    path = max(directory.glob("*.chunk"))
    path.unlink()
    assert main(["live", "fsck", str(directory)]) == 65
    assert f"missing: chunk {path.name.removesuffix('.chunk')}: " in capsys.readouterr().out


def test_while_another_process_works_with_it(directory: Path, capsys: Captured, tmp_path: Path) -> None:
    folder = Folder(directory)
    assert main(["live", "fsck", str(directory)]) == 75
    assert "--read-only" in capsys.readouterr().err
    assert main(["live", "fsck", "--read-only", str(directory)]) == 0
    assert main(["live", "export", str(directory), "-o", str(tmp_path / "out.ply")]) == 0
    assert "`shmmap live save`" in capsys.readouterr().out
    before = contents(directory)
    assert main(["live", "reset", str(directory), "--yes"]) == 75
    assert "stop the daemon" in capsys.readouterr().err
    assert contents(directory) == before
    folder.close()


@pytest.mark.parametrize(
    "words", [["fsck"], ["fsck", "--repair"], ["export", "-o", "x.ply"], ["reset", "--yes"]]
)
def test_no_live_map(tmp_path: Path, capsys: Captured, words: list[str]) -> None:
    (tmp_path / "mine").write_bytes(b"mine")
    assert main(["live", *words, str(tmp_path)]) == 66
    assert "is no live map" in capsys.readouterr().err
    assert main(["live", *words, str(tmp_path / "none")]) == 66
    assert "there is no directory" in capsys.readouterr().err
    assert contents(tmp_path) == {"mine": b"mine"}


def test_a_map_whose_record_is_unreadable(directory: Path, capsys: Captured) -> None:
    (directory / "map.json").write_bytes(b"{")
    before = contents(directory)
    assert main(["live", "fsck", "--repair", str(directory)]) == 65
    said = capsys.readouterr().err
    assert "map.json" in said
    assert "hint: bring the file back" in said
    assert contents(directory) == before
    assert main(["live", "reset", str(directory), "--yes"]) == 0
    assert contents(directory / "reset.1") == before


def test_exports(directory: Path, capsys: Captured, tmp_path: Path) -> None:
    out = tmp_path / "out.pcd"
    words = ["live", "export", str(directory), "-o", str(out)]
    assert main([*words, "--json", "--voxels", "both", "--translate", "-1,2,-3"]) == 0
    made = json.loads(capsys.readouterr().out)
    assert (made["path"], made["format"], made["cells"]) == (str(out), "pcd", 0)
    assert made["origin"] == [1.0, -2.0, 3.0]
    assert made["fields"] == [["x", "<f4"], ["y", "<f4"], ["z", "<f4"], ["intensity", "<f4"]]
    assert made["voxels"] == len(read_pcd(out)["x"]) > 100
    assert main(words) == 2
    assert f"{out} exists" in capsys.readouterr().err
    assert main([*words, "--force"]) == 0
    assert main(["live", "export", str(directory), "-o", str(tmp_path / "map"), "--cell-size", "10"]) == 0
    said = capsys.readouterr()
    assert "cells" in said.out
    assert said.err == ""
    assert json.loads((tmp_path / "map" / "shmmap_divide.json").read_text())["cell_size"] == 10.0


def test_exports_of_a_damaged_map(directory: Path, capsys: Captured, tmp_path: Path) -> None:
    path = damage(directory)
    words = ["live", "export", str(directory), "-o", str(tmp_path / "out.ply")]
    assert main(words) == 65
    assert "hint: `shmmap live fsck`" in capsys.readouterr().err
    assert not (tmp_path / "out.ply").exists()
    assert main(["live", "fsck", "--repair", str(directory)]) == 65
    assert main([*words, "--json"]) == 0
    said = capsys.readouterr()
    assert f'"{path.name}.damaged.1"' in said.out
    assert "1 damaged file in quarantine" in said.err


def test_nothing_to_export(tmp_path: Path, capsys: Captured) -> None:
    stored_drive(tmp_path / "lidar", 0)
    words = ["live", "export", str(tmp_path / "lidar"), "-o", str(tmp_path / "out.ply")]
    assert main(words) == 1
    assert "no occupied voxel" in capsys.readouterr().err
    assert main([*words, "--allow-empty"]) == 0
    assert not (tmp_path / "out.ply").exists()


def test_resets(directory: Path, capsys: Captured) -> None:
    before = contents(directory)
    assert main(["live", "reset", str(directory)]) == 2
    said = capsys.readouterr().err
    assert f"{len(before)} files" in said
    assert "hint: --yes" in said
    assert contents(directory) == before
    assert main(["live", "reset", str(directory), "--yes", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document == {
        "path": str(directory), "moved_to": str(directory / "reset.1"), "files": len(before),
        "bytes": sum(map(len, before.values())),
    }  # fmt: skip
    assert contents(directory / "reset.1") == before
    assert main(["live", "fsck", str(directory / "reset.1")]) == 0
    assert main(["live", "fsck", str(directory)]) == 66
    assert main(["live", "reset", str(directory / "reset.1"), "--yes", "--delete"]) == 0
    assert contents(directory) == {}


def test_a_name_stands_for_its_directory(
    directory: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Captured
) -> None:
    """By the state directory, or by the settings; a directory of that name here comes first."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.chdir(tmp_path)
    place = tmp_path / "state" / "shmmap" / "default" / "live" / "radar"
    place.parent.mkdir(parents=True)
    shutil.copytree(directory, place)
    assert main(["live", "fsck", "radar", "--json"]) == 0
    settings = tmp_path / "config" / "shmmap" / "shmmap.toml"
    settings.parent.mkdir(parents=True)
    settings.write_text(f'[live.radar]\npath = "{directory}"\n')
    damage(directory)
    assert main(["live", "fsck", "radar", "--read-only"]) == 65
    assert main(["live", "fsck", "sonar"]) == 66
    capsys.readouterr()
