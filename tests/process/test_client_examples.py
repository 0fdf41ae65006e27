# SPDX-License-Identifier: Apache-2.0
"""The programs of ``clients/examples`` run as they stand, each beside a daemon."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import shmmap
from shmmap.cli import main
from tests.process.conftest import DaemonFactory
from tests.support.daemon_process import ROOT, DaemonProcess, Deadline
from tests.support.divided_map import DividedMap
from tests.support.live_reference import LiveDaemon
from tests.support.ndt_programs import make_town_drive
from tests.support.pages import read_page

FOLDER = ROOT / "clients/examples"
NOTEBOOKS = {"first_look.ipynb"}
LONG = {"live_drive.py", "slices_with_dask.py"}

pytestmark = pytest.mark.usefixtures("layer_kernels")


def run(name: str, *words: str, beside: DaemonProcess | None = None, timeout_s: float = 120.0) -> str:
    """Run an example; returns what it prints."""
    program = start(name, *words, beside=beside)
    try:
        printed, errors = program.communicate(timeout=timeout_s)
    finally:
        program.kill()
    assert program.returncode == 0, errors
    return printed


def start(name: str, *words: str, beside: DaemonProcess | None = None) -> subprocess.Popen[str]:
    """Start an example."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith("SHMMAP_")}
    if beside is not None:
        environment |= {"SHMMAP_ENDPOINT": beside.endpoint, "SHMMAP_SHM_DIR": beside.shm_dir}
    return subprocess.Popen(
        [sys.executable, FOLDER / name, *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**environment, "PYTHONPATH": str(ROOT)},
    )


def test_the_page_lists_every_example() -> None:
    there = {path.name for path in FOLDER.iterdir() if path.suffix in (".py", ".ipynb")}
    page = read_page("clients/IN_YOUR_PROGRAM.md")
    assert {Path(link).name for link in page.links if link.startswith("examples/")} == there
    sizes = {
        name: len((FOLDER / name).read_text(encoding="utf-8").splitlines()) for name in there - NOTEBOOKS
    }
    assert max(size for name, size in sizes.items() if name not in LONG) <= 65


def test_follow_vehicle(served: DaemonProcess) -> None:
    *moves, last = run("follow_vehicle.py", "-40", "0", beside=served).splitlines()
    assert len(moves) > 1
    assert all(
        re.fullmatch(r"x -?[\d.]+ m: \d+ cells new, \d+ gone, \d+ in the window", line) for line in moves
    )
    assert re.fullmatch(r"[1-9]\d* points within 20 m", last)


def test_asyncio_follow(served: DaemonProcess) -> None:
    *lines, last = run("asyncio_follow.py", "-40", "0", beside=served).splitlines()
    moves = [line for line in lines if re.fullmatch(r"\d+ cells new, \d+ gone, \d+ in the window", line)]
    loads = [line for line in lines if re.fullmatch(r"the daemon has loaded \S+\.pcd", line)]
    assert len(moves) > 1
    assert len(loads) > 1
    assert len(moves) + len(loads) == len(lines)
    assert re.fullmatch(r"[1-9]\d* points at five places ahead", last)


def test_read_layer(served: DaemonProcess, divided_map: DividedMap) -> None:
    first, xyz, *others = run("read_layer.py", "5", "5", "2", beside=served).splitlines()
    assert re.fullmatch(r"  xyz: float32, \(\d+, 3\), unit m", xyz)
    assert re.fullmatch(r"  count: uint32, \(\d+,\), unit none", others[-1])
    found = re.match(r"(\S+): (\d+) voxels of (\d+) points, from ", first)
    assert found is not None
    assert (found[1], int(found[3])) == (divided_map.id("0_0.pcd"), len(divided_map.points("0_0.pcd")["x"]))


def test_record_events(daemon: DaemonFactory, divided_map: DividedMap, tmp_path: Path) -> None:
    """A daemon of its own: the recording begins with the events of the last minute."""
    one = daemon(divided_map.root)
    with shmmap.connect(one.endpoint) as client:
        assert client.around(5.0, 5.0, 2.0, wait=30.0).complete
    file = tmp_path / "events"
    program = start("record_events.py", str(file), beside=one)
    waiting = Deadline()
    while waiting(not file.exists() or "0_0.pcd" not in file.read_text(encoding="utf-8")):
        assert program.poll() is None
    program.send_signal(signal.SIGINT)
    assert program.communicate(timeout=120.0) == ("", "")
    assert program.returncode == 0
    events = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]
    assert [event["seq"] for event in events] == sorted(event["seq"] for event in events)
    assert "0_0.pcd" in {event["id"] for event in events if event["kind"] == "loaded"}


def test_points_in_torch(served: DaemonProcess) -> None:
    pytest.importorskip("torch", reason="torch is not installed")
    counted, spread = run("points_in_torch.py", "5", "5", "2", beside=served).splitlines()
    assert re.match(r"[1-9]\d* points, their mean at \[", counted)
    assert spread.startswith("standard deviations along their axes: [")


@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_torch_loader(served: DaemonProcess, method: str) -> None:
    pytest.importorskip("torch", reason="torch is not installed")
    batches = run("torch_loader.py", "5", "5", "20", method, beside=served).splitlines()
    assert len(batches) > 1
    assert all(re.fullmatch(r"\([1-4], 1024, 3\) mean height -?[\d.]+ m", line) for line in batches)


def test_many_processes(served: DaemonProcess, divided_map: DividedMap) -> None:
    line = run("many_processes.py", "5", "5", "2", beside=served)
    highest = divided_map.points("0_0.pcd")["z"].max()
    assert line == f"1 cells, the highest point is in 0_0.pcd, at {highest:.2f} m\n"


def test_live_map(live_daemon: LiveDaemon) -> None:
    one = live_daemon(resolution=0.05)
    scans, seen = run("live_map.py", "lidar", beside=one).splitlines()
    assert re.fullmatch(r"5 scans, \d{4} voxels, the first at (2\.9|3\.0)\d m", scans)
    assert re.fullmatch(r"free at 1 m: True; a ray gets (2\.9|3\.0) m far", seen)


@pytest.mark.slow
def test_live_drive(tmp_path: Path) -> None:
    """No voxel is lost though memory is short and both programs die; the picture shows the files."""
    out = tmp_path / "town"
    mapper, daemon, few, whole, compared, see = run("live_drive.py", str(out), timeout_s=600.0).splitlines()
    assert (mapper, daemon) == ("after 12 scans the mapper is killed", "after 24 scans the daemon is killed")
    counts = [
        re.fullmatch(r"(\d+) chunks, (\d+) of them in memory, ([\d.]+) MiB", line) for line in (few, whole)
    ]
    (files, _, size), (same_files, _, whole_size) = (
        tuple(map(float, found.groups())) for found in counts if found
    )
    assert files == same_files
    assert size <= 4.0 < whole_size, "a part of the map is on disk alone"
    assert re.fullmatch(r"\d{6,7} voxels, each as without a death, and with memory enough", compared)
    command = see.removeprefix("see them: ")
    assert command == f"shmmap view {out} --image {out}.png"
    assert main(command.split()[1:]) == 0
    with Image.open(f"{out}.png") as picture:
        assert len(picture.getcolors(1 << 24) or ()) > 100


def test_a_drive_is_recorded_and_driven_again(served: DaemonProcess, tmp_path: Path) -> None:
    file = tmp_path / "drive.csv"
    recorder = start("record_drive.py", "record", str(file), "vehicle", "600", beside=served)
    waiting = Deadline()
    with shmmap.MapWindow(served.endpoint, radius=20.0, update_distance=1.0, name="vehicle") as window:
        window.move_to(-20.0, 0.0, wait=30.0)
        for x in range(-20, 21, 5):
            window.move_to(float(x), 0.0, wait=30.0)
            while waiting(f",{x:.3f},0.000\n" not in (file.read_text() if file.exists() else "")):
                assert recorder.poll() is None
                time.sleep(0.01)
    recorder.terminate()
    recorder.communicate()
    *_, last = run("record_drive.py", "replay", str(file), "20", beside=served).splitlines()
    places = len(file.read_text().splitlines())
    assert re.fullmatch(rf"{places} places, \d+ of them before their map", last)


@pytest.mark.slow
def test_localize(daemon: DaemonFactory, tmp_path: Path) -> None:
    """From two metres and half a dozen degrees off, over a drive through a town."""
    drive = make_town_drive(tmp_path, blocks=(2, 2), density=5.0, frames=8, step=1.0)
    one = daemon(drive.map_dir)
    x, y, _, _, _, yaw = drive.poses[0]
    rough = (f"{value:.3f}" for value in (x + 1.5, y - 1.0, yaw + 0.1, 1.8))
    *lines, last = run("localize.py", str(drive.scans), *rough, beside=one).splitlines()
    assert last == "8 of 8 poses are trusted"
    for line, pose in zip(lines, drive.poses, strict=True):
        found = re.match(r"scan_\d+ <Result at x (\S+), y (\S+), z (\S+) m, ", line)
        assert found is not None, line
        assert np.linalg.norm(np.array([float(word) for word in found.groups()]) - pose[:3]) < 0.1


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
