# SPDX-License-Identifier: Apache-2.0
"""Nothing found is not success: said once, with where the map is, and by the exit code."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tests.process.conftest import DaemonFactory
from tests.support.cloud_bytes import write_las
from tests.support.command_line import Shmmap
from tests.support.daemon_process import first_answer, until
from tests.support.divided_map import DividedMap, make_map, read_pcd

FAR = ("--circle", "9000,-70,5")
MAP = "the map spans x -60 .. 60 m, y -60 .. 60 m"


@pytest.fixture
def shmmap(daemon: DaemonFactory, divided_map: DividedMap, tmp_path: Path) -> Shmmap:
    return Shmmap(daemon(divided_map.root), tmp_path)


def test_an_area_beside_the_map(reading: Shmmap) -> None:
    for words in (
        ("query", *FAR),
        ("query", *FAR, "--json"),
        ("query", *FAR, "--held", "0_0.pcd"),
        ("pin", *FAR),
        ("unpin", *FAR, "--json"),
        ("evict", *FAR),
        ("export", *FAR, "-o", "out.pcd"),
        ("export", *FAR, "--crop", "--json", "-o", "out.pcd"),
        ("map", *FAR),
    ):
        done = reading.run(*words)
        assert done.returncode == 1, words
        assert done.stderr == f"shmmap: no cell within 5 m of (9000, -70); {MAP}\n", words
        if "--json" in words:
            json.loads(done.stdout)
        elif words[0] in ("query", "map") and "--held" not in words:
            assert done.stdout == "", "nothing is drawn or counted where there is nothing"
        assert reading.run(*words, "--allow-empty").returncode == 0, words
    assert not (reading.cwd / "out.pcd").exists()
    for area, said in (
        (("--square", "900,0,5"), "in the square of half-side 5 m about (900, 0)"),
        (
            ("--box", "900,0,901,2", "--z", "1,2"),
            "in x 900 .. 901 m, y 0 .. 2 m, z 1 .. 2 m",
        ),
    ):
        assert f"no cell {said}; {MAP}" in reading.run("query", *area).stderr


def test_what_is_empty_and_yet_an_answer(shmmap: Shmmap) -> None:
    assert shmmap.json("ls", "--circle", "0,0,5")["cells"] == []  # nothing is in memory at all
    assert shmmap.json("ls")["cells"] == []
    assert shmmap("ls") == "nothing is in memory: cells are loaded when a client asks for them\n"
    held = shmmap.json("query", "--circle", "0,0,5")["cells"]
    names = [cell["id"] for cell in held]
    assert shmmap.json("query", "--circle", "0,0,5", "--held", *names)["cells"] == []
    assert shmmap("unpin", "--circle", "0,0,5") == "nothing is pinned\n"
    until(lambda: shmmap.json("ls")["cells"])  # the table is written a few times a second
    done = shmmap.run("ls", "--circle", "-50,-50,5")
    assert done.returncode == 1
    assert "no cell in memory within 5 m of (-50, -50); those in memory span x -20 .. 20 m" in done.stderr
    assert shmmap.run("ls", "--circle", "-50,-50,5", "--allow-empty").returncode == 0
    assert len(shmmap.json("ls", "--box", "1,1,2,2")["cells"]) == 1


def test_an_empty_layer_and_an_empty_output(reading: Shmmap, standing_map: DividedMap) -> None:
    done = reading.run("query", "--id", "0_0.pcd", "--layer", "crop(z_min=500,z_max=600)", "--wait", "60")
    assert done.returncode == 1, done.stderr
    assert "no points in 1 cell" in done.stderr
    assert reading.run(
        "query", "--id", "0_0.pcd", "--layer", "points", "crop(z_min=500,z_max=600)", "--allow-empty"
    ).returncode == 0  # fmt: skip
    corner = standing_map.points("0_0.pcd")
    assert not ((corner["x"] == 3.0) & (corner["y"] == 4.0)).any()
    done = reading.run("export", "--circle", "3,4,0", "--crop", "-o", "out.pcd")
    assert (done.returncode, list(reading.cwd.glob("*.pcd"))) == (1, [])
    assert "no point within 0 m of (3, 4) in 1 cell: nothing is written" in done.stderr


def test_areas_for_pins_and_evictions(shmmap: Shmmap, divided_map: DividedMap) -> None:
    near = [divided_map.id(name) for name in divided_map.in_circle(10, 10, 5)]
    pinned = shmmap.json("pin", "--circle", "10,10,5", "--layer", "points")
    assert [divided_map.id(cell["id"]) for cell in pinned["cells"]] == near
    assert shmmap.run("pin", "--circle", "10,10,5", "0_0.pcd").returncode == 2
    assert shmmap.run("evict", "--all", "--circle", "10,10,5").returncode == 2
    shmmap("query", "--circle", "0,0,60")
    answer = shmmap.json("evict", "--square", "10,10,5")
    assert (answer["kept"], answer["freed"] + answer["still_mapped"]) == (len(near), 0)
    assert shmmap.json("unpin", "--box", "5,5,15,15")["cells"] == []
    answer = shmmap.json("evict", "--circle", "10,10,5")
    assert (answer["kept"], answer["freed"]) == (0, len(near))


def test_lists_given_twice_add_up(reading: Shmmap, standing_map: DividedMap) -> None:
    found = reading.json("query", "--id", "0_0.pcd", "--id", "20_0.pcd", "20_20.pcd")
    assert len(found["cells"]) == 3
    held = [cell["id"] for cell in found["cells"]]
    area = ("--box", "1,1,39,39")
    words = [word for cell in held for word in ("--held", cell)]
    assert [Path(cell["id"]).name for cell in reading.json("query", *area, *words)["cells"]] == ["0_20.pcd"]
    layers = ("--layer", "points", "--layer", "voxel(leaf=1.0)", "--wait", "60")
    cells = reading.json("query", "--id", "0_0.pcd", *layers)["cells"]
    assert len({cell["layer"] for cell in cells}) == 2


def test_a_crop_has_the_points_inside_and_their_fields(reading: Shmmap, standing_map: DividedMap) -> None:
    reading("export", "--circle", "20,20,7", "--z", "2,5", "--crop", "-o", "out.pcd")
    cropped = read_pcd(reading.cwd / "out.pcd")
    wanted: dict[str, list[float]] = {name: [] for name in cropped}
    for name in standing_map.in_circle(20, 20, 7):
        points = standing_map.points(name)
        inside = (points["x"].astype(float) - 20) ** 2 + (points["y"].astype(float) - 20) ** 2 <= 49
        inside &= (points["z"] >= 2) & (points["z"] <= 5)
        for field, values in points.items():
            wanted[field] += values[inside].tolist()
    assert 0 < len(wanted["x"]) < 500
    assert {field: values.tolist() for field, values in cropped.items()} == wanted
    assert reading.run("export", "--id", "0_0.pcd", "--crop", "-o", "other.pcd").returncode == 2


def test_a_moved_map_says_so_where_nothing_is_found(daemon: DaemonFactory, tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    corner = (512000.0, 5403000.0, 300.0)
    columns = {axis: rng.random(200) * 30 + shift for axis, shift in zip("xyz", corner, strict=True)}
    write_las(tmp_path / "town.las", columns | {"intensity": np.zeros(200)}, offset=corner)
    shmmap = Shmmap(daemon(tmp_path / "town.las"), tmp_path)
    done = shmmap.run("query", "--circle", "512010,5403010,20")
    assert done.returncode == 1
    assert "no cell within 20 m of (512010, 5403010); the map spans x " in done.stderr
    assert "hint: `divide` shifted the points close to the origin: subtract (512" in done.stderr
    assert "coordinates of the cloud it was divided from" in shmmap("status")
    assert "moved by (" in shmmap.daemon.log


def test_a_client_that_asks_for_more_than_its_part(daemon: DaemonFactory, tmp_path: Path) -> None:
    made = make_map(tmp_path / "heavy", points=4200)
    shmmap = Shmmap(daemon(made.root, "--budget", "4M", "--session-quota", "1M"), tmp_path)
    done = shmmap.run("query", "--circle", "0,0,60")
    assert done.returncode == 1
    lines = [line for line in done.stdout.splitlines() if line.startswith(("failed", "  in use"))]
    assert len(lines) == 1, done.stdout
    assert "its quota of 1.0 MiB for itself alone [over_budget]" in lines[0]
    assert "0 bytes" not in done.stdout
    status = first_answer(lambda: shmmap("status"), lambda text: "\nquota " in text)
    (quota,) = [line for line in status.splitlines() if line.startswith("quota ")]
    assert "a client asked for more than its part" in quota
    (cache,) = [line for line in status.splitlines() if line.startswith("cache ")]
    assert cache.split(maxsplit=1)[1] == "large enough: nothing evicted for room, nothing refused"
