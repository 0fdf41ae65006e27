# SPDX-License-Identifier: Apache-2.0
"""Cells as PCL's leaves and as ROS messages, beside what PCL itself makes of the same cells' points.

Leaves have equal counts; their means and inverse covariances are as near as those of the ``ndt`` layer in
``tests/unit/layers/test_voxels.py``.  PCL sums centroids in float32, one point after the other: with places
of some 100 m and some 100 points in a voxel its sum is up to a millimetre off.
"""

from __future__ import annotations

import os
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import shmmap
from shmmap.dividing.divide import divide
from tests.benchmarks.layer_build import cells_of, city
from tests.cpp.conftest import DaemonFactory
from tests.support.compiled_programs import PclLeaves, build_pcl_leaves, built_once
from tests.support.cpp_client import FLAGS
from tests.support.daemon_process import ROOT
from tests.support.divided_map import DividedMap, make_map
from tests.support.skips import programs_or_skip


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the compiled program."""
    program = built_once(tmp_path_factory, "leaves", lambda folder: build_pcl_leaves(folder, optimize="-O1"))
    if program is None:
        pytest.skip("g++ or libpcl-dev (1.12 or newer) is missing")
    return program


def town(root: Path) -> DividedMap:
    """Ground, walls and clutter: 4 x 4 cells of 20 m about the origin."""
    made = DividedMap(root)
    made.pcd_dir.mkdir(parents=True)
    for number, xyz in enumerate(cells_of(city(1_000_000), across=4)):
        x, y = (20 * (index - 2) for index in divmod(number, 4))
        made.write_cell(f"{x}_{y}.pcd", (x, y), {name: xyz[:, axis] for axis, name in enumerate("xyz")})
    made.write_metadata()
    return made


def check(cells: list[dict[str, Any]]) -> None:
    """The same leaves, in the same order."""
    for cell in cells:
        assert (cell["ours"], cell["counts"], cell["refused"]) == (cell["theirs"], 0, 0)
        assert cell["mean"] < 1e-9
        assert cell["inverse"] < 1e-8
        assert cell["centroid"] < 2e-3


@pytest.mark.parametrize("leaf", [1.0, 2.0, 2.7])
def test_a_town(program: Path, daemon: DaemonFactory, tmp_path: Path, leaf: float) -> None:
    one = daemon(town(tmp_path / "map").root)
    with PclLeaves(program, one.endpoint, leaf) as pcl:
        cells = pcl.compare()
    check(cells)
    assert len(cells) == 16
    assert sum(cell["ours"] for cell in cells) > 500


def test_messages_are_what_pcl_reads_from_the_files(
    program: Path, daemon: DaemonFactory, tmp_path: Path
) -> None:
    """Fields, layout and points to the byte, as Autoware's loader reads its files with PCL."""
    made = make_map(tmp_path / "map")
    points = made.points("0_0.pcd")
    ring = np.arange(len(points["x"])).astype(np.uint16)
    time = np.linspace(0, 0.1, len(ring))
    made.write_cell("0_0.pcd", (0, 0), {**points, "ring": ring, "time": time})
    one = daemon(made.root)
    with PclLeaves(program, one.endpoint, 2.0) as pcl:
        cells = pcl.clouds()
    assert [cell["id"] for cell in cells] == sorted(map(made.id, made.corners))
    assert {(cell["points"], cell["fields"], cell["layout"], cell["data"]) for cell in cells} == {
        (500, 1, 1, 1)
    }


def test_a_street(program: Path, daemon: DaemonFactory, data_dir: Path, tmp_path: Path) -> None:
    divide([data_dir / "kitti0005_map" / "map_static_v005.pcd"], tmp_path / "map")
    one = daemon(tmp_path / "map")
    with PclLeaves(program, one.endpoint, 2.0) as pcl:
        check(cells := pcl.compare())
        clouds = pcl.clouds()
    assert len(cells) == len(clouds) == 59
    assert all(cloud["fields"] and cloud["layout"] and cloud["data"] for cloud in clouds)


# --- messages of ROS --------------------------------------------------------------------------------------


def test_points_of_layers(daemon: DaemonFactory, divided_map: DividedMap, tmp_path: Path) -> None:
    programs_or_skip("g++")
    program = tmp_path / "point_cloud2"
    source = ROOT / "tests" / "support" / "point_cloud2.cpp"
    subprocess.run(["g++", "-std=c++17", *FLAGS, "-Wuseless-cast", source, "-o", program], check=True)
    one = daemon(divided_map.root)
    environment = {**os.environ, "SHMMAP_ENDPOINT": one.endpoint}
    for layer in ("points", "voxel(leaf=1.0)"):
        printed = subprocess.run(
            [program, layer], env=environment, check=True, capture_output=True, text=True
        )
        lines = iter(printed.stdout.splitlines())
        with shmmap.connect(one.endpoint) as client:
            cells = client.around(0, 0, 1e6, layers=layer, wait=60)
            assert len(cells) == 36
        for cell in cells:
            _, frame, width, height, step = next(lines).split()
            assert (frame, int(width), int(height)) == (cell.frame_id, len(cell.xyz), 1)
            fields = {}
            while (line := next(lines)).startswith("field "):
                _, name, offset, datatype, count = line.split()
                fields[name] = int(offset), int(datatype), int(count)
            assert list(fields.items())[:3] == [("x", (0, 7, 1)), ("y", (4, 7, 1)), ("z", (8, 7, 1))]
            rows = np.frombuffer(bytes.fromhex(line), np.uint8).reshape(len(cell.xyz), int(step))
            xyz = rows[:, :12].copy().view("<f4")
            expected = (cell.xyz.astype(np.float64) + cell.origin).astype(np.float32)
            np.testing.assert_array_equal(xyz, expected)
            for name in set(cell.column_names) - {"xyz"}:
                if cell[name].dtype.itemsize == 8 and cell[name].dtype.kind in "iu":
                    assert name not in fields
                    continue
                start, _, values = fields[name]
                nbytes = values * cell[name].dtype.itemsize
                assert rows[:, start : start + nbytes].tobytes() == cell[name].tobytes()
    refused = subprocess.run(
        [program, "ndt(leaf=2.0)"], env=environment, check=True, capture_output=True, text=True
    )
    assert refused.stdout == "no_column\n"
