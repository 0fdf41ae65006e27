# SPDX-License-Identifier: Apache-2.0
"""``shmmap divide`` and ``merge`` as a user meets them: killed, out of disk, without permission."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from shmmap.formats.pcd.writer import write_pcd
from shmmap.origin.map_directory import open_map
from tests.benchmarks.divide_large import FIELDS, generate
from tests.support.clouds import expected_rows, map_rows, rows_of, xyzircaedt
from tests.support.daemon_process import ROOT
from tests.support.divided_map import read_pcd
from tests.support.forked_programs import run_verb

KILLS = int(os.environ.get("SHMMAP_TEST_KILLS", "4"))


def command(*words: str | Path) -> list[str]:
    return [sys.executable, "-m", "shmmap.cli", *map(str, words)]


def shmmap(*words: str | Path) -> subprocess.CompletedProcess[str]:
    return run_verb([*map(str, words)], cwd=ROOT)


@pytest.fixture
def cloud(tmp_path: Path) -> Path:
    """A cloud of 4000 points with all fields of XYZIRCAEDT."""
    write_pcd(tmp_path / "cloud.pcd", xyzircaedt(4000))
    return tmp_path / "cloud.pcd"


def test_divide_check_and_merge(cloud: Path, tmp_path: Path) -> None:
    done = shmmap("divide", cloud, tmp_path / "map", "--check", "--origin", "-20,0", "--json")
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert (report["points"], report["points_read"], report["dropped"]) == (4000, 4000, 0)
    assert report["peak_memory_bytes"] < 1 << 30
    assert "dividing" in done.stderr
    assert "checking" in done.stderr
    assert map_rows(tmp_path / "map") == expected_rows(rows_of(xyzircaedt(4000)))
    merged = shmmap("merge", tmp_path / "map", tmp_path / "back.pcd", "--quiet")
    assert (merged.returncode, merged.stderr) == (0, "")
    assert "4,000 from" in merged.stdout
    again = shmmap("divide", tmp_path / "back.pcd", tmp_path / "again", "--quiet")
    assert (again.returncode, again.stderr) == (0, "")
    assert map_rows(tmp_path / "again") == map_rows(tmp_path / "map")


@pytest.mark.parametrize(
    ("words", "code", "says"),
    [
        (["map", "--max-memory", "lots"], 2, "--max-memory"),
        (["map", "--max-memory", "1M"], 2, "at least"),
        (["map", "--cell-size", "0"], 2, "cell size"),
        (["map", "--translate", "1,2"], 2, "X,Y,Z"),
        (["cloud.pcd"], 2, "inside the output"),
    ],
)
def test_wrong_usage(cloud: Path, tmp_path: Path, words: list[str], code: int, says: str) -> None:
    done = shmmap("divide", cloud, tmp_path / words[0], *words[1:])
    assert done.returncode == code
    assert says in done.stderr
    assert os.listdir(tmp_path) == ["cloud.pcd"]


def test_a_killed_run_leaves_no_half_map(tmp_path: Path) -> None:
    columns = xyzircaedt(300_000, reach=200.0)
    # far from the origin in float64, so that every stage takes its time
    for axis in "xyz":
        columns[axis] = columns[axis].astype(np.float64) + 100_000
    write_pcd(tmp_path / "cloud.pcd", columns)
    words: list[str | Path] = ["divide", tmp_path / "cloud.pcd", tmp_path / "map"]
    words += ["--quiet", "--check", "--force", "--leaf", "0.5"]
    began = time.monotonic()
    assert shmmap(*words).returncode == 0
    whole_s = time.monotonic() - began
    truth = map_rows(tmp_path / "map")
    shutil.rmtree(tmp_path / "map")
    chance = random.Random(7)
    for _ in range(KILLS):
        process = subprocess.Popen(command(*words, "--resume"), cwd=ROOT)
        try:
            process.wait(chance.uniform(0.2, 1.0) * whole_s)
        except subprocess.TimeoutExpired:
            process.send_signal(chance.choice([signal.SIGKILL, signal.SIGTERM, signal.SIGINT]))
            process.wait()
        if (tmp_path / "map").exists():
            open_map(tmp_path / "map", strict=True).load()
            assert map_rows(tmp_path / "map") == truth
        assert sorted(set(os.listdir(tmp_path)) - {".map.dividing", "map"}) == ["cloud.pcd"]
    done = shmmap(*words, "--resume")
    assert done.returncode == 0, done.stderr
    assert map_rows(tmp_path / "map") == truth
    assert sorted(os.listdir(tmp_path)) == ["cloud.pcd", "map"]


def test_a_cloud_larger_than_the_memory_it_may_take(tmp_path: Path) -> None:
    generate(tmp_path / "cloud.pcd", 13_000_000, np.dtype(FIELDS["xyzircaedt"]), random=False)
    assert (tmp_path / "cloud.pcd").stat().st_size > 384 << 20
    done = shmmap("divide", tmp_path / "cloud.pcd", tmp_path / "map", "--max-memory", "384M", "--json")
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert report["points"] == 13_000_000
    assert report["peak_memory_bytes"] < 384 << 20
    cells = list((tmp_path / "map" / "pointcloud_map.pcd").iterdir())
    assert len(cells) == report["cells"]
    assert sum(len(read_pcd(cell)["x"]) for cell in cells) == 13_000_000


@pytest.mark.root
def test_a_disk_that_is_full(cloud: Path, tmp_path: Path, private_tmpfs: Callable[[str], str]) -> None:
    small = Path(private_tmpfs("64k"))
    done = shmmap("divide", cloud, small / "map")
    assert done.returncode == 73
    assert "are free" in done.stderr
    assert "hint: " in done.stderr
    assert os.listdir(small) == []
    # room for the points, but not for the number of files
    few = Path(private_tmpfs("16m,nr_inodes=40"))
    done = shmmap("divide", cloud, few / "map")
    assert done.returncode == 73
    assert "No space left on device" in done.stderr
    assert os.listdir(few) == []
    assert shmmap("divide", cloud, few / "map", "--cell-size", "100").returncode == 0
    assert shmmap("merge", few / "map", small / "cloud.pcd").returncode == 73
    assert os.listdir(small) == []


@pytest.mark.root
def test_no_permission(cloud: Path, tmp_path: Path, private_tmpfs: Callable[[str], str]) -> None:
    folder = Path(private_tmpfs("1m"))
    subprocess.run(["mount", "-o", "remount,ro", str(folder)], check=True)
    for words in (("divide", cloud, folder / "map"), ("merge", cloud, folder / "out.pcd")):
        done = shmmap(*words)
        assert done.returncode == 73
        assert "Read-only file system" in done.stderr
        assert "hint: choose a directory" in done.stderr
    assert os.listdir(folder) == []
