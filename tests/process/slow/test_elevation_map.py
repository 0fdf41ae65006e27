# SPDX-License-Identifier: Apache-2.0
"""``shmmap-elevation`` against real daemons: known ground, right seams, a cache, and interrupted runs."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from shmmap_clients.elevation_map import ElevationRule, WindowHeights, build_elevation_map, surface
from shmmap_clients.elevation_map.build import BuildProgress, MapChanged

import shmmap
from shmmap.dividing.map_writer import MapWriter
from shmmap.simulation.town import Town
from tests.support.daemon_process import DaemonProcess, Deadline
from tests.support.divided_map import DividedMap, random_points
from tests.support.forked_programs import run_verb

Factory = Callable[..., DaemonProcess]
LONG_S = 120.0


def whole_cloud(made: DividedMap) -> NDArray[Any]:
    parts = [made.points(name) for name in sorted(made.corners)]
    return np.concatenate([np.stack([p["x"], p["y"], p["z"]], axis=1) for p in parts])


def in_one_go(xyz: NDArray[Any], rule: ElevationRule) -> dict[tuple[int, int], float]:
    """Heights of all columns from all points at once, as if there were no cells."""
    index = np.floor(xyz[:, :2].astype(np.float64) * (1 / rule.resolution)).astype(np.int64)
    low = index.min(axis=0)
    key = (index[:, 1] - low[1]) * 100_000 + index[:, 0] - low[0]
    if rule.name == "surface":
        columns, heights = surface.surface_heights(xyz, key, rule)
    else:
        columns, member = np.unique(key, return_inverse=True)
        groups = [xyz[member.reshape(-1) == n, 2].astype(np.float64) for n in range(len(columns))]
        heights = np.array([float(getattr(group, rule.name)()) for group in groups])
    return {
        (int(c % 100_000 + low[0]), int(c // 100_000 + low[1])): float(z)
        for c, z in zip(columns, heights, strict=True)
        if not np.isnan(z)
    }


@pytest.mark.parametrize("name", ["surface", "min", "mean", "max"])
def test_columns_know_no_cell_borders(
    daemon: Factory, divided_map: DividedMap, tmp_path: Path, name: str
) -> None:
    rule = ElevationRule(name, 1.3, tolerance=4.0)  # does not divide the cells' 20 m
    one = daemon(divided_map.root)
    with shmmap.connect(one.endpoint) as client:
        built = build_elevation_map(client, rule, tmp_path / "cache", wait_s=LONG_S)
    assert (built.cells, built.loaded, built.stray, built.failed) == (36, 36, 0, ())
    heights = built.grid.rows(0, built.grid.shape[0])
    j, i = np.nonzero(~np.isnan(heights))
    first = built.grid.first
    got = {(int(a) + first[0], int(b) + first[1]): float(heights[b, a]) for a, b in zip(i, j, strict=True)}
    expected = in_one_go(whole_cloud(divided_map), rule)
    assert got.keys() == expected.keys()
    assert max(abs(got[key] - expected[key]) for key in got) < 1e-5
    assert len(got) > 1000


def test_generated_ground_is_met(daemon: Factory, tmp_path: Path) -> None:
    town = Town(seed=3, blocks=(1, 1), density=250.0)
    town.write(tmp_path / "town")
    one = daemon(tmp_path / "town")
    with shmmap.connect(one.endpoint) as client:
        built = build_elevation_map(client, ElevationRule(), tmp_path / "cache", wait_s=LONG_S)
    grid = built.grid
    heights, _ = grid.filled(0, grid.shape[0], 0.0)
    x = grid.origin[0] + (np.arange(grid.shape[1]) + 0.5) * grid.resolution
    y = grid.origin[1] + (np.arange(grid.shape[0]) + 0.5) * grid.resolution
    truth = town.ground_height(*np.meshgrid(x, y))
    # edges: columns with anything but ground in them (cars, walls, leaves), or with a curb
    cloud = np.concatenate([tile["xyz"] for tile in town.tiles()])
    above = np.abs(cloud[:, 2] - town.ground_height(cloud[:, 0], cloud[:, 1])) > 0.1
    index = np.floor(cloud[above, :2].astype(np.float64) * (1 / 0.3)).astype(int) - grid.first
    clear = ~np.isnan(heights)
    clear[index[:, 1], index[:, 0]] = False
    away = np.minimum(np.abs((x + 40) % 80 - 40)[None, :], np.abs((y + 40) % 80 - 40)[:, None])
    clear &= np.abs(away - 4.0) > 0.3
    error = np.abs(heights - truth)[clear]
    assert clear.sum() > 10_000
    assert np.percentile(error, 99) < 0.01  # points scatter by 15 mm, some 22 make a column
    assert error.max() < 0.03


def test_an_interrupted_build_goes_on_and_a_finished_one_is_kept(
    daemon: Factory, divided_map: DividedMap, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("shmmap_clients.elevation_map.build._EVERY", 7)
    one = daemon(divided_map.root)
    rule, cache = ElevationRule("surface", 1.3, tolerance=4.0), tmp_path / "cache"

    class Interrupted(Exception):
        pass

    def stop_at_17(progress: BuildProgress) -> None:
        if progress.done == 17:
            raise Interrupted

    with shmmap.connect(one.endpoint) as client:
        with pytest.raises(Interrupted):
            build_elevation_map(client, rule, cache, wait_s=LONG_S, progress=stop_at_17)
        resumed = build_elevation_map(client, rule, cache, wait_s=LONG_S)
        assert resumed.loaded == 36 - 14
        again = build_elevation_map(client, rule, cache, wait_s=LONG_S)
        assert again.loaded == 0
        fresh = build_elevation_map(client, rule, tmp_path / "other", wait_s=LONG_S)
        assert again.grid.path.read_bytes() == fresh.grid.path.read_bytes()

        # another state of the map is another entry of the cache
        name = sorted(divided_map.corners)[0]
        corner = divided_map.corners[name]
        divided_map.write_cell(name, corner, random_points(np.random.default_rng(5), corner, 400))
        client.reload()
        changed = build_elevation_map(client, rule, cache, wait_s=LONG_S)
        assert changed.loaded == 36
        assert changed.map_version != fresh.map_version

        def rewrite(progress: BuildProgress) -> None:
            if progress.done == 3:
                last = sorted(divided_map.corners)[-1]
                corner = divided_map.corners[last]
                divided_map.write_cell(last, corner, random_points(np.random.default_rng(6), corner, 300))
                client.reload()

        with pytest.raises(MapChanged):
            build_elevation_map(client, rule, tmp_path / "third", wait_s=LONG_S, progress=rewrite)


def test_two_runs_do_not_write_over_each_other(
    daemon: Factory, divided_map: DividedMap, tmp_path: Path
) -> None:
    one = daemon(divided_map.root)
    rule, cache = ElevationRule("surface", 1.3, tolerance=4.0), tmp_path / "cache"
    with shmmap.connect(one.endpoint) as client, shmmap.connect(one.endpoint) as other:

        def another_run(progress: BuildProgress) -> None:
            if progress.done == 5:
                with pytest.raises(shmmap.errors.InstanceBusy):
                    build_elevation_map(other, rule, cache, wait_s=LONG_S)
                build_elevation_map(other, rule, tmp_path / "other", wait_s=LONG_S)

        built = build_elevation_map(client, rule, cache, wait_s=LONG_S, progress=another_run)
        kept = build_elevation_map(other, rule, cache, wait_s=LONG_S)
        alone = build_elevation_map(other, rule, tmp_path / "other", wait_s=LONG_S)
    assert (built.loaded, kept.loaded, alone.loaded) == (36, 0, 0)
    assert kept.grid.path.read_bytes() == alone.grid.path.read_bytes()


def test_heights_follow_a_window(daemon: Factory, divided_map: DividedMap) -> None:
    one = daemon(divided_map.root)
    rng = np.random.default_rng(8)
    cloud = whole_cloud(divided_map)
    for name in ("min", "mean", "max"):
        rule = ElevationRule(name, 1.3)
        expected = in_one_go(cloud, rule)
        layers = ("elevation(resolution=2.6)", rule.layer)  # not the only one of its kind
        with shmmap.MapWindow(one.endpoint, 40.0, layers=layers, update_distance=0.0) as window:
            for x, y in ((-30.0, 5.0), (12.0, -7.0)):
                window.move_to(x, y, wait=LONG_S)
                xy = rng.uniform((x - 27, y - 27), (x + 27, y + 27), (400, 2))
                got = WindowHeights(window, rule).at(xy)
                keys = np.floor(xy * (1 / rule.resolution)).astype(int).tolist()
                want = np.array([expected.get((i, j), np.nan) for i, j in keys])
                assert np.array_equal(np.isnan(got), np.isnan(want))
                assert np.nanmax(np.abs(got - want)) < 1e-5
            nowhere = np.array([[np.nan, 0.0], [0.0, np.inf], [-1e300, 0.0], [1e12, -1e12]])
            assert np.isnan(WindowHeights(window, rule).at(nowhere)).all()
    with pytest.raises(shmmap.BadRequest), shmmap.MapWindow(one.endpoint, 40.0) as window:
        WindowHeights(window, ElevationRule())


def test_the_program(daemon: Factory, divided_map: DividedMap, tmp_path: Path) -> None:
    one = daemon(divided_map.root)
    (divided_map.pcd_dir / sorted(divided_map.corners)[5]).write_bytes(b"no cloud")
    command = [
        "build",
        "--resolution",
        "1.0",
        "--tolerance",
        "4",
        "--cache",
        f"{tmp_path}/cache",
        "--endpoint",
        one.endpoint,
    ]
    words = ["--out", f"{tmp_path}/e.npz", "--hillshade", f"{tmp_path}/h.png", "--json"]
    with shmmap.connect(one.endpoint) as client:
        client.reload()
    done = run_verb([*command, *words], module="shmmap_clients.elevation_map")
    assert done.returncode == 1, done.stderr
    document = json.loads(done.stdout)
    assert [Path(failure["id"]).name for failure in document["failed"]] == [sorted(divided_map.corners)[5]]
    assert "36 of 36 cells" in done.stderr
    with np.load(tmp_path / "e.npz") as read:
        assert read["height"].shape == (document["rows"], document["columns"])
        assert int((read["kind"] == 1).sum()) == document["measured"] > 0
    assert (tmp_path / "h.png").read_bytes()[1:4] == b"PNG"
    wrong = run_verb([*command, "--out", "e.xyz"], module="shmmap_clients.elevation_map")
    assert wrong.returncode == 2


def elevation(*words: str, code: int = 0) -> subprocess.CompletedProcess[str]:
    """Run the program, which is to end with this code."""
    done = run_verb(["build", "--quiet", "--json", *words], module="shmmap_clients.elevation_map")
    assert done.returncode == code, done.stderr
    return done


def test_a_sparse_map_is_warned_about(daemon: Factory, divided_map: DividedMap, tmp_path: Path) -> None:
    one = daemon(divided_map.root)
    words = ["--cache", f"{tmp_path}/cache", "--endpoint", one.endpoint]
    sparse = elevation(*words, "--resolution", "1.3", "--tolerance", "4")
    document = json.loads(sparse.stdout)
    share = document["measured"] / document["occupied"]
    assert document["measured_share"] == pytest.approx(share)
    assert 0.0 < share < 0.5
    assert sparse.stderr.startswith(
        f"shmmap-elevation: warning: {document['measured']} of {document['occupied']} columns with points"
        f" ({100 * share:.1f} %) have a height; a column of 1.3 m needs 3 points within 4 m of each other"
    )
    again = json.loads(elevation(*words, "--resolution", "1.3", "--tolerance", "4").stdout)
    assert again == document | {"loaded": 0}, "from the cache"
    dense = elevation(*words, "--resolution", "5", "--tolerance", "20")
    assert dense.stderr == ""
    assert json.loads(dense.stdout)["measured_share"] > 0.9


def test_no_height_at_all_is_no_answer(daemon: Factory, divided_map: DividedMap, tmp_path: Path) -> None:
    one = daemon(divided_map.root)
    words = ["--cache", f"{tmp_path}/cache", "--endpoint", one.endpoint, "--resolution", "0.5"]
    words += ["--min-points", "400", "--out", f"{tmp_path}/e.npz"]
    nothing = elevation(*words, code=1)
    assert nothing.stderr.startswith("shmmap-elevation: no column has a height: 0 of ")
    assert nothing.stderr.endswith("the map spans x -60 .. 60 m, y -60 .. 60 m\n")
    assert json.loads(nothing.stdout)["measured"] == 0
    elevation(*words, "--allow-empty")


def a_map_of(folder: Path, *parts: NDArray[np.float32]) -> Path:
    with MapWriter(folder, durable=False) as writer:
        writer.add({"xyz": np.concatenate(parts)})
        writer.finish()
    return folder


def ground(x: float, y: float, points: int = 40_000) -> NDArray[np.float32]:
    """A square of 60 m, all of one height."""
    xy = np.random.default_rng(0).uniform((x, y), (x + 60, y + 60), (points, 2))
    return np.column_stack([xy, np.full(points, 2.5)]).astype(np.float32)


@pytest.mark.parametrize("stray", [(9000.0, 9000.0), (40.0, -9e5)])
def test_a_stray_point_is_named_and_costs_nothing(
    daemon: Factory, tmp_path: Path, stray: tuple[float, float]
) -> None:
    points = np.array([[*stray, 100.0]], np.float32)
    one = daemon(a_map_of(tmp_path / "map", ground(0, 0), points))
    words = ["--cache", f"{tmp_path}/cache", "--endpoint", one.endpoint, "--rule", "mean"]
    words += ["--resolution", "0.5"]
    done = elevation(*words, "--out", f"{tmp_path}/e.npz", f"{tmp_path}/e.tif", f"{tmp_path}/e.png")
    document = json.loads(done.stdout)
    assert document["rows"] < 300 > document["columns"]
    assert document["measured"] > 10_000
    [far] = document["far"]
    assert far["metres"] > 8000
    assert done.stderr.startswith(f"shmmap-elevation: warning: {far['id']} lies ")
    assert "km from all other cells" in done.stderr
    written = sorted(path.name for path in tmp_path.glob("*e.*"))
    assert written == ["e.npz", "e.pgw", "e.png", "e.png.json", "e.tif"]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_signal_leaves_no_unfinished_file(daemon: Factory, tmp_path: Path, number: signal.Signals) -> None:
    """Two parts of a map kilometres apart: a large grid, whose file takes seconds to write."""
    one = daemon(a_map_of(tmp_path / "map", ground(0, 0, 5000), ground(8000, 8000, 5000)))
    (tmp_path / "out").mkdir()
    words = ["--cache", f"{tmp_path}/cache", "--endpoint", one.endpoint, "--out", f"{tmp_path}/out/e.npz"]
    command = [sys.executable, "-m", "shmmap_clients.elevation_map", "build", "--quiet", *words]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        waiting = Deadline()
        while waiting(not any((tmp_path / "out").iterdir())):
            time.sleep(0.01)
        assert process.poll() is None
        process.send_signal(number)
        _, said = process.communicate(timeout=LONG_S)
    assert process.returncode == 128 + number
    assert said == ""
    assert not list((tmp_path / "out").iterdir())
