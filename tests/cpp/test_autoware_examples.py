# SPDX-License-Identifier: Apache-2.0
"""The examples in C++ that need PCL, Eigen or ROS, as far as these are there."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

import shmmap
from tests.cpp.conftest import DaemonFactory
from tests.support.autoware_node import TYPES, compiled_with
from tests.support.daemon_process import ROOT
from tests.support.divided_map import DividedMap

CPP = ROOT / "clients" / "cpp"
EXAMPLES = CPP / "examples"


def built_as_it_says(name: str, folder: Path) -> Path:
    """Compile an example by the line in its head."""
    if shutil.which("g++") is None or shutil.which("pkg-config") is None:
        pytest.skip("g++ or pkg-config is missing")
    (command,) = re.findall(r"^//   (g\+\+ .*)$", (EXAMPLES / f"{name}.cpp").read_text(), re.MULTILINE)
    library = re.findall(r"--cflags (\w+)", command)[0]
    if subprocess.run(["pkg-config", "--exists", library], check=False).returncode:
        pytest.skip(f"{library} is missing (libpcl-dev, libeigen3-dev)")
    command = command.replace(f"-o {name}", f"-o {folder / name} -Werror -Wall -Wextra -Wshadow")
    subprocess.run(["sh", "-euc", command], check=True, cwd=CPP)
    return folder / name


def run(program: Path, endpoint: str, *words: object) -> list[str]:
    """What an example prints."""
    done = subprocess.run(
        [program, *map(str, words)],
        env={**os.environ, "SHMMAP_ENDPOINT": endpoint},
        check=True,
        capture_output=True,
        text=True,
    )
    assert done.stderr == ""
    return done.stdout.splitlines()


def test_a_cloud_of_pcl_s(daemon: DaemonFactory, divided_map: DividedMap, tmp_path: Path) -> None:
    program = built_as_it_says("pcl_cloud", tmp_path)
    one = daemon(divided_map.root)
    with shmmap.connect(one.endpoint) as client:
        cells = client.around(5, 5, radius=20).raise_for_failures()
        xyz = np.concatenate([cell.xyz for cell in cells])
    first, second = run(program, one.endpoint, 5, 5, 20)
    assert first == f"{len(cells)} cells, {len(xyz)} points in frame map"
    bounds = [np.float32(word) for word in re.findall(r"-?[0-9][0-9.e+-]*", second)]
    assert bounds == [*xyz.min(axis=0), *xyz.max(axis=0)]


def test_leaves_along_a_drive(daemon: DaemonFactory, divided_map: DividedMap, tmp_path: Path) -> None:
    program = built_as_it_says("ndt_leaves", tmp_path)
    one = daemon(divided_map.root)
    lines = run(program, one.endpoint, -30, 30, 5, 15)
    held: set[str] = set()
    expected = []
    with shmmap.connect(one.endpoint) as client:
        for x in (-30, -10, 10, 30):
            wanted = set(divided_map.in_square(x, 5, 15))
            ids = sorted(map(divided_map.id, wanted))
            cells = client.selected(ids, layers=["ndt(leaf=2.0)"], wait=60).raise_for_failures()
            voxels, points = (
                sum(len(cell["count"]) for cell in cells),
                sum(cell["count"].sum() for cell in cells),
            )
            expected.append(
                f"x {x}: {len(wanted - held)} added, {len(held - wanted)} removed;"
                f" {len(wanted)} cells, {voxels} voxels of {points} points"
            )
            held = wanted
    assert lines == expected


@pytest.mark.parametrize("types", TYPES)
def test_requesters_of_the_service(
    daemon: DaemonFactory, divided_map: DividedMap, tmp_path: Path, types: str
) -> None:
    """Each gets everything once, also of requests at the same time; two of one name share what they hold."""
    if shutil.which("g++") is None:
        pytest.skip("g++ is missing")
    program = compiled_with(types, ROOT / "tests" / "support" / "requesters.cpp", tmp_path)
    if program is None:
        pytest.skip("ROS 2's generator of messages is missing (rosidl-generator-c-cpp, python3-rosidl)")
    one = daemon(divided_map.root)
    lines = run(program, one.endpoint, 0, 0, 100, 6)
    assert lines == ["36 map 0 map "] * 6 + ["3"]
    assert run(program, one.endpoint, 0, 0, -1, 1) == ["0 map 0 map ", "1"], "no area, nothing in it"
    one.stop()
    environment = {**os.environ, "SHMMAP_ENDPOINT": one.endpoint}
    ended = subprocess.run(
        [program, "0", "0", "100", "2", "6"], env=environment, check=True, capture_output=True, text=True
    )
    assert ended.stdout.splitlines() == ["none none "] * 2 + ["1"], "no daemon, no answer: never an empty one"
    with subprocess.Popen(
        [program, "0", "0", "100", "2"], env=environment, stdout=subprocess.PIPE, text=True
    ) as waiting:
        one.start()
        assert waiting.communicate()[0].splitlines() == ["36 map 0 map "] * 2 + ["1"]
        assert waiting.returncode == 0
