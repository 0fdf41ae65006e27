# SPDX-License-Identifier: Apache-2.0
"""The programs of ``clients/examples`` run as they stand, each beside a daemon."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import shmmap
from tests.process.conftest import DaemonFactory
from tests.support.daemon_process import ROOT, DaemonProcess
from tests.support.divided_map import DividedMap
from tests.support.pages import read_page

FOLDER = ROOT / "clients/examples"

pytestmark = pytest.mark.usefixtures("layer_kernels")


def run(name: str, *words: str, beside: DaemonProcess | None = None) -> str:
    """Run an example; returns what it prints."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith("SHMMAP_")}
    if beside is not None:
        environment |= {"SHMMAP_ENDPOINT": beside.endpoint, "SHMMAP_SHM_DIR": beside.shm_dir}
    done = subprocess.run(
        [sys.executable, FOLDER / name, *words],
        capture_output=True,
        text=True,
        timeout=120.0,
        env={**environment, "PYTHONPATH": str(ROOT)},
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_page_lists_every_example() -> None:
    there = {path.name for path in FOLDER.glob("*.py")}
    assert {Path(link).name for link in read_page("clients/README.md").links if "examples/" in link} == there
    sizes = {name: len((FOLDER / name).read_text(encoding="utf-8").splitlines()) for name in there}
    assert max(size for name, size in sizes.items() if name != "slices_with_dask.py") <= 65


def test_follow_vehicle(served: DaemonProcess) -> None:
    *moves, last = run("follow_vehicle.py", "-40", "0", beside=served).splitlines()
    assert len(moves) > 1
    assert all(
        re.fullmatch(r"x -?[\d.]+ m: \d+ cells new, \d+ gone, \d+ in the window", line) for line in moves
    )
    assert re.fullmatch(r"[1-9]\d* points within 20 m", last)


def test_read_layer(served: DaemonProcess, divided_map: DividedMap) -> None:
    lines = run("read_layer.py", "5", "5", "2", beside=served).splitlines()
    (found,) = (re.match(r"(\S+): (\d+) voxels of (\d+) points, .* columns xyz, ", line) for line in lines)
    assert found is not None
    assert (found[1], int(found[3])) == (divided_map.id("0_0.pcd"), len(divided_map.points("0_0.pcd")["x"]))


def test_record_events(daemon: DaemonFactory, divided_map: DividedMap, tmp_path: Path) -> None:
    """A daemon of its own: the recording begins with the events of the last minute."""
    one = daemon(divided_map.root)
    with shmmap.connect(one.endpoint) as client:
        assert client.around(5.0, 5.0, 2.0, wait=30.0).complete
    assert run("record_events.py", str(tmp_path / "events"), "3", beside=one) == ""
    events = [json.loads(line) for line in (tmp_path / "events").read_text().splitlines()]
    assert [event["seq"] for event in events] == sorted(event["seq"] for event in events)
    assert "0_0.pcd" in {event["id"] for event in events if event["kind"] == "loaded"}


def test_points_in_torch(served: DaemonProcess) -> None:
    pytest.importorskip("torch", reason="torch is not installed")
    counted, spread = run("points_in_torch.py", "5", "5", "2", beside=served).splitlines()
    assert re.match(r"[1-9]\d* points, their mean at \[", counted)
    assert spread.startswith("standard deviations along their axes: [")


def test_roughness_layer(daemon: DaemonFactory, divided_map: DividedMap, tmp_path: Path) -> None:
    """The kind is as all kinds are; installed by its entry point, a daemon serves it."""
    assert run("roughness_layer.py") == "roughness(edge) is a layer kind\n"
    information = tmp_path / "roughness-1.0.dist-info"
    information.mkdir()
    (information / "METADATA").write_text("Metadata-Version: 2.1\nName: roughness\nVersion: 1.0\n")
    entry_point = re.search(
        r"^    (\[project.*)\n    (roughness = .*)$", (FOLDER / "roughness_layer.py").read_text(), re.M
    )
    assert entry_point is not None
    assert entry_point[1] == '[project.entry-points."shmmap.layers"]'
    (information / "entry_points.txt").write_text(f"[shmmap.layers]\n{entry_point[2].replace(chr(34), '')}\n")
    one = daemon(divided_map.root, environment={"PYTHONPATH": f"{ROOT}:{tmp_path}:{FOLDER}"})
    with shmmap.connect(one.endpoint) as client:
        (cell,) = client.around(5.0, 5.0, 2.0, layers="roughness(edge=4.0)", wait=60.0)
    source = divided_map.points("0_0.pcd")
    z = source["z"][(np.floor(source["x"] / 4) == 1) & (np.floor(source["y"] / 4) == 2)].astype(np.float64)
    (row,) = np.flatnonzero((cell["square"] == (1, 2)).all(axis=1))
    assert cell["roughness"][row] == pytest.approx(z.std(), rel=1e-5)
