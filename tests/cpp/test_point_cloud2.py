# SPDX-License-Identifier: Apache-2.0
"""Cells as messages of ROS: every point in the map's frame, whatever the layer is relative to."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

import shmmap
from tests.cpp.conftest import DaemonFactory
from tests.support.cpp_client import FLAGS
from tests.support.daemon_process import ROOT
from tests.support.divided_map import DividedMap


def test_points_of_layers(daemon: DaemonFactory, divided_map: DividedMap, tmp_path: Path) -> None:
    if shutil.which("g++") is None:
        pytest.skip("g++ is missing")
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
