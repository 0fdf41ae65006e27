# SPDX-License-Identifier: Apache-2.0
"""``shmmap view`` of every kind of source shows the same block at the same place."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from shmmap.simulation.town import Town
from tests.process.conftest import DaemonFactory
from tests.support.daemon_process import ROOT
from tests.support.divided_map import write_pcd
from tests.support.live_reference import stored_drive
from tests.support.pictures import png_pixels

BLOCK = (42.0, 12.0, 50.0, 26.0)
ROOF_M = 6.0
DATA = os.environ.get("SHMMAP_TEST_DATA", "")


def plain_with_a_block() -> dict[str, NDArray[Any]]:
    """80 m x 40 m of ground, a point each 12 cm, and a roof."""
    x, y = (part.ravel() for part in np.meshgrid(np.arange(0.06, 80, 0.12), np.arange(0.06, 40, 0.12)))
    roof = (x > BLOCK[0]) & (x < BLOCK[2]) & (y > BLOCK[1]) & (y < BLOCK[3])
    z = np.where(roof, ROOF_M, 0.0)
    return {
        "x": x.astype("<f4"),
        "y": y.astype("<f4"),
        "z": z.astype("<f4"),
        "intensity": (z * 10).astype("<f4"),
    }


def view(cwd: Path, *words: str, code: int = 0) -> dict[str, Any]:
    """What ``view --json`` reports."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith("SHMMAP_")} | {
        "PYTHONPATH": str(ROOT)
    }
    done = subprocess.run(
        [sys.executable, "-m", "shmmap.cli", "view", *words, "--json"],
        cwd=cwd, env=environment, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == code, done.stderr
    return json.loads(done.stdout) if done.stdout else {}


def check_block(path: Path, report: dict[str, Any]) -> None:
    """The roof is where the report's scale puts it, and ground beside it."""
    pixels = png_pixels(path.read_bytes(), "RGB").astype(int)
    left, top = 62, 26

    def at(x: float, y: float) -> NDArray[Any]:
        column = left + (x - report["box"][0]) / report["metres_per_pixel"]
        row = top + (report["box"][3] - y) / report["metres_per_pixel"]
        found: NDArray[Any] = pixels[int(row), int(column)]
        return found

    min_x, min_y, max_x, max_y = BLOCK
    middle = ((min_x + max_x) / 2, (min_y + max_y) / 2)
    assert at(*middle)[0] > 200 > 140 > at(*middle)[1], "the end of the colours"
    step = 4 * report["metres_per_pixel"]
    for x, y, out_x, out_y in (
        (min_x, middle[1], -1, 0),
        (max_x, middle[1], 1, 0),
        (middle[0], min_y, 0, -1),
    ):
        assert np.ptp(at(x - out_x * step, y - out_y * step)) > 60
        assert np.ptp(at(x + out_x * step, y + out_y * step)) < 30
    assert np.ptp(at(15, 15)) < 20


def cloud(folder: Path) -> list[str]:
    write_pcd(folder / "block.pcd", plain_with_a_block())
    return ["block.pcd"]


def text(folder: Path) -> list[str]:
    columns = plain_with_a_block()
    rows = np.column_stack([columns[axis] for axis in "xyz"])
    np.savetxt(folder / "block.xyz", rows, fmt="%.3f")
    return ["block.xyz"]


def two_clouds(folder: Path) -> list[str]:
    columns = plain_with_a_block()
    west = columns["x"] < 45
    (folder / "clouds").mkdir()
    for name, chosen in (("west", west), ("east", ~west)):
        write_pcd(folder / f"clouds/{name}.pcd", {key: values[chosen] for key, values in columns.items()})
    return ["clouds"]


def divided(folder: Path) -> list[str]:
    cloud(folder)
    words = [
        sys.executable,
        "-m",
        "shmmap.cli",
        "divide",
        "block.pcd",
        "town",
        "--translate",
        "none",
        "--quiet",
    ]
    subprocess.run(words, cwd=folder, check=True, capture_output=True)
    return ["town"]


def published(folder: Path) -> list[str]:
    divided(folder)
    words = [sys.executable, "-m", "shmmap.cli", "publish", "town", "store", "--quiet"]
    subprocess.run(words, cwd=folder, check=True, capture_output=True)
    return ["store"]


@pytest.mark.parametrize("make", [cloud, text, two_clouds, divided, published])
def test_files(tmp_path: Path, make: Callable[[Path], list[str]]) -> None:
    words = make(tmp_path)
    report = view(tmp_path, *words, "--image", "v.png")
    assert report["points"] == len(plain_with_a_block()["x"])
    check_block(tmp_path / "v.png", report)
    part = view(tmp_path, *words, "--image", "p.png", "--box", "40,10,60,20", "--from", "south")
    x, y = (plain_with_a_block()[axis] for axis in "xy")
    assert part["points"] == int(((x >= 40) & (x <= 60) & (y >= 10) & (y <= 20)).sum())
    if make is not text:
        by = view(tmp_path, *words, "--image", "i.png", "--by", "intensity")
        assert (by["low"], by["high"]) == (0, pytest.approx(10 * ROOF_M))


def test_a_daemon(tmp_path: Path, daemon: DaemonFactory) -> None:
    divided(tmp_path)
    one = daemon(tmp_path / "town")
    where = ("--instance", one.instance, "--runtime-dir", one.runtime_dir, "--shm-dir", one.shm_dir)
    report = view(tmp_path, "--image", "v.png", *where)
    assert report["points"] == len(plain_with_a_block()["x"])
    check_block(tmp_path / "v.png", report)


def test_a_live_map_s_directory(tmp_path: Path) -> None:
    voxels = stored_drive(tmp_path / "live")
    report = view(tmp_path, "live", "--image", "v.png", "--by", "intensity")
    assert 0 < report["points"] < len(voxels)
    assert 0.5 < report["low"] <= report["high"] <= 1.0, "the probability that they are occupied"
    for file in (tmp_path / "live").iterdir():
        file.unlink()
    view(tmp_path, "live", "--image", "w.png", code=66)


def test_memory_does_not_grow_with_the_map(tmp_path: Path) -> None:
    """Nine times the points take the memory of one cell, one block and one picture."""
    peaks = []
    for blocks in (1, 3):
        town = tmp_path / f"town{blocks}"
        Town(seed=1, blocks=(blocks, blocks), density=40.0).write(town)
        words = ["view", str(town), "--image", str(tmp_path / "v.png")]
        program = (
            f"from shmmap.cli.entry import main; assert main({words}) == 0;"
            " print(open('/proc/self/status').read().partition('VmHWM:')[2].split()[0])"
        )
        done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        peaks.append(int(done.stdout.split()[-1]) / 1024)
    assert peaks[1] - peaks[0] < 25, peaks
    assert peaks[1] < 130, peaks


def test_a_damaged_file(tmp_path: Path) -> None:
    cloud(tmp_path)
    os.truncate(tmp_path / "block.pcd", 5000)
    view(tmp_path, "block.pcd", "--image", "v.png", code=65)
    assert not (tmp_path / "v.png").exists()


@pytest.mark.skipif(not DATA, reason="SHMMAP_TEST_DATA is not set: no recorded clouds")
def test_recorded_clouds(tmp_path: Path) -> None:
    """A street with reflections below it: the street is at height 0 where the vehicle drove."""
    report = view(tmp_path, f"{DATA}/kitti0005_map/map_static_v010.pcd", "--image", "v.png")
    assert report["points"] == 1_110_224
    assert 4 < report["high"] < 9
    pixels = png_pixels((tmp_path / "v.png").read_bytes(), "RGB").astype(int)
    column = int(62 + (8 - report["box"][0]) / report["metres_per_pixel"])
    row = int(26 + (report["box"][3] + 20) / report["metres_per_pixel"])
    assert np.ptp(pixels[row - 8 : row + 8, column - 8 : column + 8].mean(axis=(0, 1))) < 12, "grey street"
    feet = view(tmp_path, f"{DATA}/las_copc/autzen_trim.laz", "--image", "f.png")
    assert feet["points"] == 110_000
    assert 300 < feet["box"][2] - feet["box"][0] < 420, "metres, not feet"
