# SPDX-License-Identifier: Apache-2.0
"""``shmmap-compare`` against real daemons: the right points, from files and from sockets."""

from __future__ import annotations

import json
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from shmmap_clients.compare_map_filter import CompareMapFilter, CompareRule
from shmmap_clients.compare_map_filter.drive import ScanComparer
from shmmap_clients.scans.scan_sequence import Scan
from shmmap_clients.scans.scan_stream import ScanPublisher, ScanSubscriber
from shmmap_clients.scans.trajectory import matrix_of, tum_line

import shmmap
from tests.support.daemon_process import DaemonProcess
from tests.support.divided_map import DividedMap, random_points, read_pcd
from tests.support.forked_programs import run_verb

Factory = Callable[..., DaemonProcess]
PROGRAM = [sys.executable, "-m", "shmmap_clients.compare_map_filter"]
LONG_S = 120.0


def cloud_of(made: DividedMap) -> NDArray[Any]:
    """Every point of the map, read independently."""
    parts = [made.points(name) for name in sorted(made.corners)]
    return np.concatenate([np.stack([part["x"], part["y"], part["z"]], axis=1) for part in parts])


def make_scan(made: DividedMap, number: int) -> Scan:
    """A scan about the origin: copies of map points, shifted a little or a lot, many on cell borders."""
    rng = np.random.default_rng(number)
    T = matrix_of((4.0 * number - 6.0, 1.0, 0.5), (0, 0, np.sin(0.1 * number), np.cos(0.1 * number)))
    cloud = cloud_of(made).astype(np.float64)
    points = cloud[rng.choice(len(cloud), 600)] + rng.normal(0, 0.4, (600, 3))
    points[:200, rng.integers(0, 2)] = rng.choice([-20.0, 0.0, 20.0], 200) + rng.normal(0, 0.3, 200)
    xyz = ((points - T[:3, 3]) @ T[:3, :3]).astype(np.float32)
    columns: dict[str, NDArray[Any]] = {"xyz": xyz, "ring": rng.integers(0, 64, len(xyz)).astype(np.uint16)}
    return Scan(f"scan_{number}", number * 0.1, columns, T)


def kept_by_brute_force(scan: Scan, made: DividedMap, distance: float) -> NDArray[np.bool_]:
    """Points farther than ``distance`` from every point of the whole map."""
    T = scan.T_map_sensor
    assert T is not None
    points = scan.xyz.astype(np.float64) @ T[:3, :3].T + T[:3, 3]
    cloud = cloud_of(made).astype(np.float64)
    return np.array([((cloud - p) ** 2).sum(axis=1).min() > distance**2 for p in points])


def assert_kept(kept: NDArray[np.bool_], scan: Scan, made: DividedMap) -> None:
    """Compare points within reach of a window of 45 m with brute force."""
    near = np.hypot(*scan.xyz[:, :2].T) < 40.0
    expected = kept_by_brute_force(scan, made, 0.5)
    assert np.array_equal(kept[near], expected[near])
    assert 0.1 < expected.mean() < 0.9


def run(*words: str) -> subprocess.CompletedProcess[str]:
    return run_verb(words, module=PROGRAM[-1])


def test_a_window_gives_what_brute_force_gives(daemon: Factory, divided_map: DividedMap) -> None:
    one = daemon(divided_map.root)
    rule = CompareRule("distance", 0.5)
    compare = CompareMapFilter(rule)
    with shmmap.MapWindow(one.endpoint, 45.0, layers=rule.layer, update_distance=0.0) as window:
        tables = []
        for number in range(4):
            scan = make_scan(divided_map, number)
            assert scan.T_map_sensor is not None
            x, y = (float(v) for v in scan.T_map_sensor[:2, 3])
            window.move_to(x, y, wait=LONG_S)
            got = compare.follow(window).apply(scan.xyz, scan.T_map_sensor)
            assert_kept(got.kept, scan, divided_map)
            tables.append(compare.follow(window)._table)
        assert tables[0] is not tables[-1]
        assert compare.follow(window)._table is tables[-1]  # an unchanged window costs nothing

        # a changed cell counts from the next answer on
        name = divided_map.in_circle(0.0, 0.0, 1.0)[0]
        corner = divided_map.corners[name]
        divided_map.write_cell(name, corner, random_points(np.random.default_rng(99), corner, 300))
        window.client.reload()
        scan = make_scan(divided_map, 1)
        assert scan.T_map_sensor is not None
        # the window asks again when it moves
        assert window.move_to(0.5, 0.5, wait=LONG_S).changed
        got = compare.follow(window).apply(scan.xyz, scan.T_map_sensor)
        assert_kept(got.kept, scan, divided_map)
        compare.use_cells(())


class RestlessWindow(shmmap.MapWindow):
    """Moves on as soon as it has answered, as a window does that is due to ask again."""

    def move_to(self, x: float, y: float, **options: Any) -> shmmap.WindowUpdate:
        update = super().move_to(x, y, **options)
        super().move_to(x + 50.0, y, wait=LONG_S)
        return update


def test_a_scan_is_compared_with_one_state_of_the_window(daemon: Factory, divided_map: DividedMap) -> None:
    one = daemon(divided_map.root)
    rule = CompareRule("distance", 0.5)
    scans = [make_scan(divided_map, number) for number in range(2)]
    with RestlessWindow(one.endpoint, 45.0, layers=rule.layer, update_distance=0.0) as window:
        comparer = ScanComparer(window, CompareMapFilter(rule), first_wait_s=LONG_S, wait_s=LONG_S)
        for scan in scans:
            compared = comparer(scan)
            assert compared.missing == ""
            assert_kept(compared.comparison.kept, scan, divided_map)


def test_of_several_layers_the_rule_s_own_counts(daemon: Factory, divided_map: DividedMap) -> None:
    one = daemon(divided_map.root)
    near, far = CompareRule("distance", 0.5), CompareRule("distance", 1.0)
    scan = make_scan(divided_map, 0)
    with shmmap.MapWindow(one.endpoint, 200.0, layers=(far.layer, near.layer)) as window:
        window.move_to(0.0, 0.0, wait=LONG_S)
        for rule in (near, far):
            compare = CompareMapFilter(rule).follow(window)
            expected = kept_by_brute_force(scan, divided_map, rule.distance)
            assert np.array_equal(compare.apply(scan.xyz, scan.T_map_sensor).kept, expected)
            compare.use_cells(())
        with pytest.raises(shmmap.BadRequest, match="the window has search"):
            CompareMapFilter(CompareRule("voxel", 0.5)).follow(window)


@pytest.fixture
def drive(tmp_path: Path, divided_map: DividedMap) -> list[Scan]:
    """Three scans as NPZ files in ``scans``, their poses in ``poses.txt``."""
    scans = [make_scan(divided_map, number) for number in range(3)]
    (tmp_path / "scans").mkdir()
    for scan in scans:
        np.savez(tmp_path / "scans" / f"{scan.name}.npz", xyz=scan.xyz, ring=scan.columns["ring"])
    lines = [tum_line(scan.stamp_s, scan.T_map_sensor) for scan in scans if scan.T_map_sensor is not None]
    (tmp_path / "poses.txt").write_text("\n".join(lines))
    return scans


def test_files_to_files(daemon: Factory, divided_map: DividedMap, drive: list[Scan], tmp_path: Path) -> None:
    one = daemon(divided_map.root)
    words = [
        "follow", "--scans", f"{tmp_path}/scans", "--poses", f"{tmp_path}/poses.txt", "--mode", "distance",
        "--map-radius", "100", "--endpoint", one.endpoint, "--out", f"{tmp_path}/out", "--json",
        "--picture", f"{tmp_path}/drive.svg",
    ]  # fmt: skip
    done = run(*words)
    assert done.returncode == 0, done.stderr
    expected = [kept_by_brute_force(scan, divided_map, 0.5) for scan in drive]
    document = json.loads(done.stdout)
    assert document["scans"] == 3
    assert document["points"] == 1800
    assert document["incomplete_scans"] == 0
    assert document["kept"] == sum(int(kept.sum()) for kept in expected)
    pairs, *lines = done.stderr.splitlines()
    assert pairs.startswith("shmmap-compare: 3 scans have poses")
    assert len(lines) == 3
    for scan, kept in zip(drive, expected, strict=True):
        written = read_pcd(tmp_path / "out" / f"{scan.name}.pcd")
        assert np.array_equal(written["index"], np.flatnonzero(kept))
        assert np.array_equal(written["ring"], scan.columns["ring"][kept])
        xyz = np.stack([written[axis] for axis in "xyz"], axis=1)
        assert xyz.tobytes() == scan.xyz[kept].tobytes()
    assert ElementTree.parse(tmp_path / "drive.svg").getroot().tag.endswith("svg")

    done = run(*words[:-3], "--mask", "--quiet")
    assert done.returncode == 0, done.stderr
    assert "3 scans, 1800 points" in done.stdout
    assert done.stderr == ""
    written = read_pcd(tmp_path / "out" / "scan_1.pcd")
    assert np.array_equal(written["kept"] != 0, expected[1])
    assert written["kept"].dtype == np.uint8


def test_a_map_elsewhere_is_no_answer(
    daemon: Factory, divided_map: DividedMap, drive: list[Scan], tmp_path: Path
) -> None:
    one = daemon(divided_map.root)
    lines = []
    for scan in drive:
        T = np.array(scan.T_map_sensor)
        T[0, 3] += 3000.0
        lines.append(tum_line(scan.stamp_s, T))
    (tmp_path / "far.txt").write_text("\n".join(lines))
    words = ["follow", "--scans", f"{tmp_path}/scans", "--poses", f"{tmp_path}/far.txt", "--quiet"]
    words += ["--endpoint", one.endpoint, "--json-lines", "-", "--json"]
    done = run(*words)
    assert done.returncode == 1
    *frames, summary = map(json.loads, done.stdout.splitlines())
    assert [frame["no_map"] for frame in frames] == [True] * 3
    assert summary["no_map_scans"] == 3
    assert summary["kept"] == summary["points"]
    printed = done.stderr.splitlines()
    assert len(printed) == 1, "once"
    assert printed[0] == (
        "shmmap-compare: no map around scan scan_0: the map spans x -60 .. 60 m, y -60 .. 60 m,"
        " the pose is at (2994.000, 1.000)"
    )
    assert run(*words, "--allow-empty").returncode == 0
    name = divided_map.in_circle(0.0, 0.0, 1.0)[0]
    files = ["--map", divided_map.id(name), "--scan", f"{tmp_path}/scans/scan_0.npz"]
    alone = run("apply", *files, "--pose", "3000,0,0,0,0,0", "--json")
    assert alone.returncode == 1
    assert json.loads(alone.stdout)["no_map"]
    assert "no map around the scan: the map spans x " in alone.stderr
    assert "the pose is at (3000.000, 0.000)" in alone.stderr


def test_nothing_kept_is_no_answer(daemon: Factory, divided_map: DividedMap, tmp_path: Path) -> None:
    """Points of the map itself: it explains every one of them."""
    one = daemon(divided_map.root)
    (tmp_path / "scans").mkdir()
    np.savez(tmp_path / "scans" / "scan_0.npz", xyz=cloud_of(divided_map)[::50])
    (tmp_path / "poses.txt").write_text(tum_line(0.0, np.eye(4)))
    words = ["follow", "--scans", f"{tmp_path}/scans", "--poses", f"{tmp_path}/poses.txt", "--quiet"]
    words += ["--mode", "distance", "--endpoint", one.endpoint]
    done = run(*words)
    assert done.returncode == 1
    assert done.stderr == "shmmap-compare: no point was kept: the map explains all 360 points\n"
    assert run(*words, "--allow-empty").returncode == 0


def test_sockets_to_sockets(
    daemon: Factory, divided_map: DividedMap, drive: list[Scan], tmp_path: Path
) -> None:
    one = daemon(divided_map.root)
    source, sink = f"ipc://{tmp_path}/in", f"ipc://{tmp_path}/out"
    command = [
        *PROGRAM,
        "follow",
        "--scans",
        source,
        "--out",
        sink,
        "--mode",
        "distance",
        "--map-radius",
        "100",
    ]
    with ScanPublisher(source) as publisher, ScanSubscriber(sink) as subscriber:
        process = subprocess.Popen(
            [*command, "--endpoint", one.endpoint, "--wait", str(LONG_S), "--quiet"],
            stdout=subprocess.DEVNULL,
        )
        try:
            assert publisher.wait_for_subscriber(LONG_S)
            for scan in drive:
                publisher.send(scan)
            publisher.send(None)
            for scan, got in zip(drive, subscriber, strict=True):
                kept = kept_by_brute_force(scan, divided_map, 0.5)
                assert got.name == scan.name
                assert not got.no_map
                assert np.array_equal(got.columns["index"], np.flatnonzero(kept))
                assert np.array_equal(got.columns["ring"], scan.columns["ring"][kept])
            assert process.wait(LONG_S) == 0
        finally:
            process.kill()
            process.wait()


def test_without_a_daemon(drive: list[Scan], divided_map: DividedMap, tmp_path: Path) -> None:
    scan = drive[1]
    name = divided_map.in_circle(0.0, 0.0, 1.0)[0]
    pose = tum_line(0.0, scan.T_map_sensor if scan.T_map_sensor is not None else np.eye(4)).split()[1:]
    done = run(
        "apply", "--map", divided_map.id(name), "--scan", f"{tmp_path}/scans/{scan.name}.npz",
        "--pose", ",".join(pose), "--pose-format", "tum", "--mode", "distance", "--json",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["points"] == 600
    missing = run("follow", "--scans", f"{tmp_path}/scans", "--endpoint", f"{tmp_path}/no.sock")
    assert missing.returncode == 69
    assert run("follow", "--scans", f"{tmp_path}/nowhere").returncode == 66


def test_scans_without_poses_are_refused(
    daemon: Factory, divided_map: DividedMap, drive: list[Scan], tmp_path: Path
) -> None:
    one = daemon(divided_map.root)
    done = run("follow", "--scans", f"{tmp_path}/scans", "--endpoint", one.endpoint)
    assert done.returncode == 2
    assert "--poses" in done.stderr
