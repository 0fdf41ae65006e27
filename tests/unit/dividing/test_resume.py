# SPDX-License-Identifier: Apache-2.0
"""A run that was interrupted goes on where it was, and the map is the same to the byte."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from shmmap.dividing.divide import divide
from shmmap.dividing.settings import DivideSettings
from shmmap.dividing.workspace import Workspace
from shmmap.errors import InstanceBusy
from shmmap.formats.pcd.writer import write_pcd
from shmmap.origin.map_report import DividedMap
from shmmap.progress import NoProgress
from tests.support.cloud_bytes import write_las
from tests.support.clouds import Columns, expected_rows, map_rows, rows_of, xyzircaedt


class Interrupt(NoProgress):
    """Interrupts a run when ``points`` have been read, or when a stage begins."""

    def __init__(self, points: int, stage: str = "") -> None:
        self._left = points
        self._stage = stage

    def stage(self, name: str, total: int) -> None:
        del total
        if name == self._stage:
            raise KeyboardInterrupt

    def advance(self, points: int) -> None:
        self._left -= points
        if self._left < 0 and not self._stage:
            raise KeyboardInterrupt


def settings(**options: Any) -> DivideSettings:
    return DivideSettings(**{"durable": False, "checkpoint_s": 0.0, **options})


def files_of(out: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in (out / "pointcloud_map.pcd").iterdir()}


def interrupted(files: list[Path], out: Path, points: int, stage: str = "", **options: Any) -> None:
    with pytest.raises(KeyboardInterrupt):
        divide(files, out, settings(**options), progress=Interrupt(points, stage))
    assert not out.exists()


def resumed(files: list[Path], out: Path, **options: Any) -> DividedMap:
    made = divide(files, out, settings(resume=True, **options))
    assert not [name for name in os.listdir(out.parent) if name.startswith(".")]
    return made


def inputs(folder: Path, kind: str) -> tuple[list[Path], Columns]:
    """Two files of a kind, and all their points."""
    parts = [xyzircaedt(3000, seed=seed) for seed in (1, 2)]
    parts[1]["time_stamp"] += np.uint32(3000)
    files = []
    for i, part in enumerate(parts):
        path = folder / f"in{i}.{'laz' if kind == 'laz' else 'pcd'}"
        if kind == "laz":
            write_las(path, part)
        else:
            write_pcd(path, part, encoding=kind)
        files.append(path)
    return files, {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


@pytest.mark.parametrize("kind", ["binary", "binary_compressed", "ascii", "laz"])
@pytest.mark.parametrize("points", [1600, 4200])
def test_a_resumed_map_is_the_same(tmp_path: Path, kind: str, points: int) -> None:
    files, columns = inputs(tmp_path, kind)
    whole = divide(files, tmp_path / "whole", settings())
    interrupted(files, tmp_path / "map", points)
    made = resumed(files, tmp_path / "map", check=True)
    assert 0 < made.resumed_points <= points
    assert files_of(tmp_path / "map") == files_of(tmp_path / "whole")
    assert (made.points, made.dropped, made.bounds) == (whole.points, whole.dropped, whole.bounds)
    if kind != "laz":
        assert map_rows(tmp_path / "map") == expected_rows(rows_of(columns))


@pytest.mark.parametrize(
    ("stage", "options"),
    [
        ("thinning out", {"leaf": 0.5}),
        ("encoding", {"leaf": 0.5, "encoding": "ascii"}),
        ("encoding", {"encoding": "binary_compressed"}),
        ("checking", {"leaf": 0.5, "check": True}),
        ("checking", {"check": True}),
    ],
)
def test_a_run_that_was_nearly_done(tmp_path: Path, stage: str, options: dict[str, Any]) -> None:
    files, _ = inputs(tmp_path, "binary")
    divide(files, tmp_path / "whole", settings(**options))
    interrupted(files, tmp_path / "map", 0, stage, **options)
    made = resumed(files, tmp_path / "map", **options)
    assert made.resumed_points > 0
    assert files_of(tmp_path / "map") == files_of(tmp_path / "whole")


def test_a_run_killed_while_its_map_appears(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The workspace then has the map that was replaced, of other points with the same names and sizes."""
    files, columns = inputs(tmp_path, "binary")
    divide(files, tmp_path / "map", settings())
    columns["intensity"] = np.uint8(255) - columns["intensity"]
    write_pcd(tmp_path / "new.pcd", columns)
    with monkeypatch.context() as patch:
        patch.setattr(Workspace, "remove", lambda _: None)  # as far as a killed run comes
        divide([tmp_path / "new.pcd"], tmp_path / "map", settings(force=True))
    assert map_rows(tmp_path / "map") == expected_rows(rows_of(columns))
    made = divide([tmp_path / "new.pcd"], tmp_path / "map", settings(force=True, resume=True))
    assert made.resumed_points == 0
    assert map_rows(tmp_path / "map") == expected_rows(rows_of(columns))


@pytest.mark.parametrize("case", ["another size", "another input", "no resume"])
def test_another_run_starts_from_the_beginning(tmp_path: Path, case: str) -> None:
    files, columns = inputs(tmp_path, "binary")
    interrupted(files, tmp_path / "map", 4200)
    options: dict[str, Any] = {"resume": case != "no resume"}
    if case == "another size":
        options["cell_size"] = 15.0
    elif case == "another input":
        columns = {name: column[::2] for name, column in columns.items()}
        write_pcd(files[0], columns)
        files.pop().unlink()
    made = divide(files, tmp_path / "map", settings(**options))
    assert made.resumed_points == 0
    size = "15" if case == "another size" else "20"
    assert map_rows(tmp_path / "map") == expected_rows(rows_of(columns), size)
    assert sorted(os.listdir(tmp_path)) == [*(path.name for path in files), "map"]


@pytest.mark.parametrize("damage", ["short", "gone", "state", "boot", "bit", "journal", "link", "two names"])
def test_a_state_that_is_no_use_is_no_danger(tmp_path: Path, damage: str) -> None:
    files, columns = inputs(tmp_path, "binary")
    interrupted(files, tmp_path / "map", 4200)
    space = tmp_path / ".map.dividing"
    cell = max((space / "map" / "pointcloud_map.pcd").iterdir(), key=lambda path: path.stat().st_size)
    if damage == "short":
        os.truncate(cell, 100)
    elif damage == "gone":
        cell.unlink()
    elif damage == "bit":
        data = bytearray(cell.read_bytes())
        data[-30] ^= 1
        cell.write_bytes(data)
    elif damage == "journal":
        (space / "pieces").unlink()
    elif damage == "link":
        cell.rename(tmp_path / "aside")
        cell.symlink_to(tmp_path / "aside")
    elif damage == "two names":
        os.link(cell, tmp_path / "aside")
    elif damage == "state":
        (space / "state.json").write_text("{")
    else:
        text = (space / "state.json").read_text()
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        (space / "state.json").write_text(text.replace(boot, "another"))
    made = resumed(files, tmp_path / "map")
    assert made.resumed_points == 0
    assert map_rows(tmp_path / "map") == expected_rows(rows_of(columns))


def test_nothing_else_gets_into_a_resumed_map(tmp_path: Path) -> None:
    """What lies beside the cells of an interrupted run, or among them, is removed; links are not followed."""
    files, columns = inputs(tmp_path, "binary")
    interrupted(files, tmp_path / "map", 4200)
    victim = tmp_path / "victim"
    victim.mkdir()
    (victim / "mine").write_text("mine")
    content = tmp_path / ".map.dividing" / "map"
    (content / "pointcloud_map_metadata.yaml").symlink_to(victim / "mine")
    (content / "more").mkdir()
    (content / "pointcloud_map.pcd" / "0_0_0.pcd").write_text("x")
    made = resumed(files, tmp_path / "map")
    assert made.resumed_points > 0
    assert map_rows(tmp_path / "map") == expected_rows(rows_of(columns))
    assert len(list((tmp_path / "map" / "pointcloud_map.pcd").iterdir())) == made.cells
    assert not (tmp_path / "map" / "more").exists()
    assert (victim / "mine").read_text() == "mine"


def test_two_runs_do_not_mix(tmp_path: Path) -> None:
    files, _ = inputs(tmp_path, "binary")
    with Workspace(str(tmp_path / "map")), pytest.raises(InstanceBusy):
        divide(files, tmp_path / "map", settings())
    assert sorted(os.listdir(tmp_path)) == ["in0.pcd", "in1.pcd"]
    divide(files, tmp_path / "map", settings())
