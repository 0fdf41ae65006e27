# SPDX-License-Identifier: Apache-2.0
"""An answer that lacks something says so in Python, as the command line does; `strict` raises it."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import shmmap
from shmmap.errors import LoadFailed, LoadTimeout, ShmmapWarning, UnknownCell
from tests.support.command_line import Shmmap
from tests.support.daemon_process import ROOT, DaemonProcess
from tests.support.divided_map import DividedMap, make_map

Factory = Callable[..., DaemonProcess]
Ask = Callable[..., Any]

ASKS: dict[str, Callable[[shmmap.Client], Ask]] = {
    "around": lambda client: lambda x, y, r, **o: client.around(x, y, r, **o),
    "area": lambda client: lambda x, y, r, **o: client.area(shmmap.Circle(x, y, r), **o),
    "differential": lambda client: lambda x, y, r, **o: client.differential(shmmap.Circle(x, y, r), [], **o),
    "points_around": lambda client: lambda x, y, r, **o: client.points_around(x, y, r, **o),
}


@pytest.fixture(autouse=True)
def errors_are_said() -> Iterator[None]:
    """An unexpected warning is an error."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


@pytest.fixture
def client(standing: DaemonProcess) -> Iterator[shmmap.Client]:
    with shmmap.connect(standing.endpoint) as made:
        yield made


@pytest.mark.parametrize("name", ASKS)
def test_beside_the_map(standing: DaemonProcess, client: shmmap.Client, tmp_path: Path, name: str) -> None:
    ask = ASKS[name](client)
    said = Shmmap(standing, tmp_path).run("query", "--circle", "9000,-70,5").stderr
    with pytest.warns(ShmmapWarning) as caught:
        assert len(ask(9000, -70, 5)) == 0
    assert [f"shmmap: {one.message}\n" for one in caught] == [said]
    assert caught[0].filename == __file__, "where the program asked"
    with pytest.raises(UnknownCell, match=r"no cell within 5 m of \(9000, -70\); the map spans"):
        ask(9000, -70, 5, strict=True)
    assert len(ask(9000, -70, 5, strict=None)) == 0
    assert len(ask(0, 0, 5, wait=60)) == len(ask(0, 0, 5, strict=True)) == 4, "nothing lacks, nothing is said"


def test_an_empty_difference_is_an_answer(client: shmmap.Client) -> None:
    held = client.around(0, 0, 5)
    assert len(client.differential(shmmap.Circle(0, 0, 5), held)) == 0
    gone = client.differential(shmmap.Circle(9000, 0, 5), held, strict=True)
    assert len(gone.removed) == 4


def test_failed_cells(daemon: Factory, divided_map: DividedMap, tmp_path: Path) -> None:
    broken = divided_map.pcd_dir / "0_0.pcd"
    broken.write_bytes(broken.read_bytes()[:-100])
    one = daemon(divided_map.root)
    printed = Shmmap(one, tmp_path).run("query", "--circle", "1,1,5").stdout
    (line,) = [line for line in printed.splitlines() if line.startswith("failed: ")]
    with shmmap.connect(one.endpoint) as client:
        with pytest.warns(ShmmapWarning) as caught:
            cells = client.around(1, 1, 5)
        first, *rest = str(caught[0].message).splitlines()
        assert first == "3 of 4 cells are there:"
        assert " ".join(" ".join(rest).split()).startswith(" ".join(line.split())[:60])
        assert len(cells) == 3
        with pytest.raises(LoadFailed) as raised:
            client.around(1, 1, 5, strict=True)
        assert raised.value.cell_id == divided_map.id("0_0.pcd")
        with shmmap.MapWindow(client, 5.0, background=False) as window:
            assert window.move_to(1.0, 1.0).failed, "a window says it in its update"


def test_pending_cells(served: DaemonProcess, tmp_path: Path) -> None:
    """One that is loaded, three that no loader loads in time."""
    with shmmap.connect(served.endpoint) as client:
        assert client.selected("0_0.pcd", wait=60).complete
        served.stop_loaders()
        with pytest.warns(ShmmapWarning) as caught:
            cells = client.around(1, 1, 5, wait=0.2)
        lines = str(caught[0].message).splitlines()
        assert lines[0] == "1 of 4 cells are there:"
        assert sorted(lines[1:-1]) == sorted(f"pending: {one.id} (points)" for one in cells.pending)
        assert (
            lines[-1]
            == "hint: what is pending is still being loaded: ask again, or wait longer: wait=SECONDS"
        )
        assert len(lines) == 5
        done = Shmmap(served, tmp_path).run("query", "--circle", "1,1,5", "--wait", "0.2")
        assert done.returncode == 1
        said = r"shmmap: 3 layers of cells are still pending after 0\.2 s: .*\d+ loaders?.*\n"
        assert re.match(said + r"hint: .* wait longer: --wait SECONDS", done.stderr), done.stderr
        with pytest.raises(LoadTimeout, match=r"still being loaded, and 2 more \(ask again, or wait longer"):
            client.around(1, 1, 5, wait=0.2, strict=True)
        assert len(client.around(1, 1, 5, wait=None).pending) == 3, "no request waited for them"
        with pytest.warns(ShmmapWarning, match="and 25 more"):
            client.around(0, 0, 100, wait=0.01)


def test_unknown_cells(standing: DaemonProcess, client: shmmap.Client, tmp_path: Path) -> None:
    done = Shmmap(standing, tmp_path).run("query", "--id", "0_0.pdc")
    with pytest.warns(ShmmapWarning) as caught:
        client.selected(["0_0.pdc", "0_0.pcd"])
    first, failure, hint = str(caught[0].message).splitlines()
    assert first == "1 of 2 cells are there:"
    assert " ".join(failure.split()) == " ".join(done.stdout.split())
    assert f"{hint}\n" == done.stderr == "hint: did you mean 0_0.pcd?\n"
    with pytest.raises(UnknownCell):
        client.selected("0_0.pdc", strict=True)


def test_an_empty_layer(daemon: Factory, tmp_path: Path) -> None:
    one = daemon(make_map(tmp_path / "map", columns=1, rows=1, points=0).root)
    with shmmap.connect(one.endpoint) as client:
        with pytest.warns(ShmmapWarning, match="points: no points in 1 cell"):
            client.area(shmmap.Box(-1e4, -1e4, 1e4, 1e4))
        with pytest.raises(UnknownCell, match="no points in 1 cell"):
            client.area(shmmap.Box(-1e4, -1e4, 1e4, 1e4), strict=True)


def test_it_is_said_once_for_each_place_in_a_program(standing: DaemonProcess) -> None:
    code = (
        "import sys, shmmap\n"
        "client = shmmap.connect(sys.argv[1])\n"
        "for _ in range(5):\n"
        "    client.around(9000, 0, 5)\n"
        "with shmmap.MapWindow(client, 5.0) as window:\n"
        "    for x in range(9000, 9100, 10):\n"
        "        window.move_to(x, 0, wait=5)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, standing.endpoint], capture_output=True, text=True, check=False, cwd=ROOT
    )
    assert done.returncode == 0
    assert done.stderr.count("no cell within 5 m of (9000, 0)") == 1
    assert done.stderr.startswith("<string>:4: ShmmapWarning: ")


def test_points_within_a_radius(client: shmmap.Client, standing_map: DividedMap) -> None:
    near = client.points_around(3.0, 4.0, 25.0)
    whole = client.around(3.0, 4.0, 25.0)
    xyz = np.concatenate([cell.xyz for cell in whole])
    inside = np.hypot(xyz[:, 0].astype(float) - 3.0, xyz[:, 1].astype(float) - 4.0) <= 25.0
    assert near.covered
    assert near.count() == len(near.gather()) == np.count_nonzero(inside) < len(xyz)
    np.testing.assert_array_equal(near.gather(), xyz[inside])
    with shmmap.MapWindow(client, 40.0) as window:
        window.move_to(3.0, 4.0, wait=60.0)
        np.testing.assert_array_equal(window.points_around(3.0, 4.0, 25.0).gather(), near.gather())
    low = client.points_around(3.0, 4.0, 25.0, layer="voxel(leaf=4.0)", wait=60)
    assert 0 < low.count() < near.count()
    assert [cell.layer for cell in low.cells] == ["voxel(leaf=4.0)"] * len(low)


def test_the_origin_of_the_map(daemon: Factory, divided_map: DividedMap) -> None:
    report = {"format": "shmmap divided map", "version": 1, "origin": [500_000.5, 5_400_000.25, 30.0]}
    report |= {"crs": "WGS 84 / UTM zone 32N (EPSG:32632)", "unit_m": [0.3048, 1.0]}
    (Path(divided_map.root) / "shmmap_divide.json").write_text(json.dumps(report))
    one = daemon(divided_map.root)
    with shmmap.connect(one.endpoint) as client:
        assert client.map_origin == (500_000.5, 5_400_000.25, 30.0, report["crs"], (0.3048, 1.0))
        with pytest.warns(ShmmapWarning, match=r"subtract \(500000\.5, 5400000\.25, 30\) from coordinates"):
            client.around(500_010, 5_400_010, 50)


def test_a_map_of_others_has_no_origin(client: shmmap.Client) -> None:
    assert client.map_origin == (0.0, 0.0, 0.0, None, (1.0, 1.0))
