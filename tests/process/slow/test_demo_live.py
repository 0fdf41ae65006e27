# SPDX-License-Identifier: Apache-2.0
"""``shmmap demo --live``: chunks go and come, daemon and mapping program die, and no voxel is lost."""

from __future__ import annotations

import contextlib
import json
import signal
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from shmmap import cli
from shmmap.cli.screens import demo as demo_screen
from shmmap.demo import live_drive
from shmmap.demo.program import Progress
from tests.support.daemon_process import wait_ended
from tests.support.demo_process import SMALL_LIVE, Demo, until

SVG = "{http://www.w3.org/2000/svg}"


def test_nothing_is_lost(tmp_path: Path) -> None:
    demo = Demo(tmp_path, "--live", "--json", "--svg", "picture.svg")
    out, err = demo.process.communicate()
    assert (demo.process.returncode, err) == (0, "")
    report = json.loads(out)
    assert sorted(report) == [
        "active",
        "active_bytes",
        "budget_bytes",
        "came_back",
        "chunks",
        "daemon_chunks",
        "daemon_down_s",
        "daemon_killed_at",
        "differing",
        "evicted",
        "file_bytes",
        "length_m",
        "mapper_killed_at",
        "mapper_resumed_at",
        "mapping_s",
        "max_bytes",
        "points",
        "scans",
        "seconds",
        "svg",
        "voxels",
    ]
    assert report["scans"] == 61
    assert report["differing"] == 0
    assert 0 < report["active"] < report["voxels"], "a part of the map is on disk alone"
    assert report["max_bytes"] <= report["budget_bytes"] == 4 << 20
    # it went round, and once more along the first streets
    assert report["evicted"] >= report["came_back"] > 0
    assert report["daemon_killed_at"] == 40
    assert report["daemon_chunks"] > 0, "those that were in memory"
    assert report["mapper_killed_at"] == 20
    assert report["mapper_resumed_at"] in (18, 19, 20, 21), "three scans may have been in flight"
    picture = ElementTree.parse(report["svg"]).getroot()
    text = " ".join(element.text or "" for element in picture.iter(f"{SVG}text"))
    for word in ("61 scans", "height", "on disk only", "sensor's path", "active cells"):
        assert word in text
    assert demo.leftovers() == []
    assert sorted(path.name for path in tmp_path.iterdir()) == ["picture.svg", "tmp"]


STAGES = ("  The mapping program", "  The daemon is killed")


@pytest.mark.parametrize("stage", STAGES)
def test_an_interrupted_drive_leaves_nothing(tmp_path: Path, stage: str) -> None:
    demo = Demo(tmp_path, "--live")
    until(demo, stage)
    demo.process.send_signal(signal.SIGINT)
    assert wait_ended(demo.process.pid)
    _, err = demo.process.communicate()
    assert (demo.process.returncode, err) == (130, "")
    assert demo.leftovers() == []
    assert [path.name for path in tmp_path.iterdir()] == ["tmp"], "no picture of half a drive"


def test_a_voxel_that_differs_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The mapping program gets another scan than the map without bounds had."""

    class Saboteur(Progress):
        def stage(self, text: str, total: int) -> None:
            assert total > 0
            if text.startswith("Mapping"):
                (scan,) = tmp_path.glob("shmmap-demo-*/7.npz")
                with np.load(scan) as found:
                    xyz, pose = found["xyz"], found["pose"]
                np.savez(scan, xyz=xyz[::2], pose=pose)

    @contextlib.contextmanager
    def progress(*, quiet: bool) -> Iterator[Saboteur]:
        assert not quiet
        yield Saboteur()

    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setattr(demo_screen, "progress_for", progress)
    monkeypatch.setattr(live_drive, "LiveDriveSettings", lambda: SMALL_LIVE)
    assert cli.main(["demo", "--live", "--svg", str(tmp_path / "picture.svg")]) == 1
    out = " ".join(capsys.readouterr().out.split())
    assert " voxels on disk are NOT as in a map without bounds of the same scans" in out


def test_what_is_of_the_other_demonstration_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["demo", "--live", "--density", "4"]) == 2
    assert "leave out --keep-map and --density" in capsys.readouterr().err
