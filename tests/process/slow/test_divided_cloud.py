# SPDX-License-Identifier: Apache-2.0
"""A daemon that is given one cloud of any format divides it into its cache first."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
from collections.abc import Callable
from pathlib import Path

import laspy
import numpy as np
import pytest

from shmmap.dividing.divide import divide
from tests.process.conftest import DaemonFactory
from tests.support.cloud_bytes import write_las
from tests.support.clouds import Columns, rows_of, xyzircaedt
from tests.support.daemon_process import LIMIT_S, DaemonProcess, wait_ended
from tests.support.divided_map import read_pcd
from tests.support.raw_client import RawClient, circle

Connect = Callable[..., RawClient]

FAR = (512000.0, 5403000.0, 300.0)


def cloud(path: Path, count: int = 3000, *, seed: int = 0, stretch: float = 0.0) -> Columns:
    """Write a LAZ file far from its frame's origin; returns its points as the file has them."""
    columns = xyzircaedt(count, seed=seed)
    for axis, shift in zip("xyz", FAR, strict=True):
        columns[axis] = columns[axis].astype(np.float64) + shift
    columns["x"][0] += stretch
    las = write_las(path, columns, offset=FAR)
    for axis in "xyz":
        columns[axis] = np.asarray(getattr(las, axis))
    return columns


def served(client: RawClient) -> list[tuple[float, ...]]:
    """Every point of the map in the cloud's frame, read from the cells' files after all were loaded."""
    reply = client.area(circle(0.0, 0.0, 4000.0))
    assert (reply.pending, reply.failed) == ([], [])
    rows = []
    origin = frame(Path(reply.cells[0].id))
    for cell in reply.cells:
        columns = read_pcd(Path(cell.id))
        assert len(columns["x"]) == cell.points
        box = cell.box
        assert ((columns["x"] >= box[0]) & (columns["x"] < box[2])).all()
        assert ((columns["y"] >= box[1]) & (columns["y"] < box[3])).all()
        assert columns["x"].dtype == np.float32
        for axis, there in zip("xyz", origin, strict=True):
            columns[axis] = columns[axis].astype(np.float64) + there
        rows += points(columns)
    return sorted(rows, key=lambda row: row[-1])


def points(columns: Columns) -> list[tuple[float, ...]]:
    """Coordinates to the millimetre that LAS files have, and what distinguishes the points."""
    rounded = {axis: np.round(columns[axis], 3) for axis in "xyz"}
    return rows_of({**rounded, "time_stamp": columns["time_stamp"]})


def frame(cell: Path) -> list[float]:
    """Where the origin of the map of this cell lies in the frame of the cloud."""
    origin: list[float] = json.loads((cell.parent.parent / "shmmap_divide.json").read_text())["origin"]
    return origin


def divisions(one: DaemonProcess) -> int:
    """Count how often the daemon divided a cloud, in all its runs."""
    return len(re.findall(r"dividing cloud=\S+ into=", one.log))


def test_a_cloud_is_divided_once_and_as_divide_does_it(
    daemon: DaemonFactory, connect: Connect, tmp_path: Path
) -> None:
    columns = cloud(tmp_path / "town.laz")
    one = daemon(tmp_path / "town.laz")
    assert served(connect(one)) == points(columns)
    assert one.stop() == 0
    one.start()
    reply = connect(one).area(circle(0.0, 0.0, 4000.0))
    assert divisions(one) == 1
    made = divide([tmp_path / "town.laz"], tmp_path / "map")
    assert list(made.origin) == frame(Path(reply.cells[0].id))
    ours = {path.name: path.read_bytes() for path in (tmp_path / "map" / "pointcloud_map.pcd").iterdir()}
    assert {Path(cell.id).name: Path(cell.id).read_bytes() for cell in reply.cells} == ours
    assert "moved by (" in one.log


def test_a_changed_cloud_is_divided_again(daemon: DaemonFactory, connect: Connect, tmp_path: Path) -> None:
    cloud(tmp_path / "town.laz")
    one = daemon(tmp_path / "town.laz")
    client = connect(one)
    assert len(served(client)) == 3000
    for seed in (1, 2):
        columns = cloud(tmp_path / "new.laz", 2000, seed=seed)
        (tmp_path / "new.laz").rename(tmp_path / "town.laz")
        client.ask("reload")
        assert served(client) == points(columns)
    assert divisions(one) == 3
    # a survey that goes farther east moves no cell that was there before
    before = frame(cells_of(one))
    columns = cloud(tmp_path / "new.laz", 2000, seed=3, stretch=900.0)
    (tmp_path / "new.laz").rename(tmp_path / "town.laz")
    client.ask("reload")
    assert served(client) == points(columns)
    assert frame(cells_of(one)) == before
    kept = [path.name for path in cache_of(one).iterdir() if not path.name.startswith(".")]
    assert len(kept) == 2  # the map, and the link to it
    (tmp_path / "town.laz").write_bytes(b"LASF, but no more")
    with pytest.raises(Exception, match="header"):
        client.ask("reload")
    assert served(client) == points(columns)  # what was there stays in service


def test_a_stop_while_dividing(daemon: DaemonFactory, connect: Connect, tmp_path: Path) -> None:
    columns = cloud(tmp_path / "town.laz", 400_000)
    for number in (signal.SIGTERM, signal.SIGKILL):
        one = daemon(tmp_path / "town.laz", start=False)
        stopped_while_dividing(one, number)
        one.start()
        assert served(connect(one)) == points(columns)
        assert not [path for path in cache_of(one).iterdir() if path.name.endswith(".dividing")]


def stopped_while_dividing(one: DaemonProcess, number: signal.Signals) -> None:
    path = f"{one.runtime_dir}/notify"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notify:
        notify.bind(path)
        notify.settimeout(LIMIT_S)
        process = one.spawn(notify=path)
        while b"STATUS=dividing" not in (said := notify.recv(4096)):
            assert b"READY=1" not in said
        assert b"EXTEND_TIMEOUT_USEC=" in said
        children = one.children()
        process.send_signal(number)
        assert process.wait(LIMIT_S) == (0 if number == signal.SIGTERM else -number)
    os.unlink(path)
    for child in children:
        assert child == process.pid or wait_ended(child, LIMIT_S)


def test_two_daemons_of_one_cloud_divide_it_once(
    daemon: DaemonFactory, connect: Connect, tmp_path: Path
) -> None:
    columns = cloud(tmp_path / "town.laz")
    cache = str(tmp_path / "cache")
    one = daemon(tmp_path / "town.laz", "--cache-dir", cache)
    two = daemon(tmp_path / "town.laz", "--cache-dir", cache)
    assert served(connect(one)) == served(connect(two)) == points(columns)
    assert divisions(one) + divisions(two) == 1


@pytest.mark.parametrize(
    ("name", "data", "code"), [("bad.laz", b"LASF" + bytes(400), 65), ("bad.ply", b"ply\n", 65)]
)
def test_a_cloud_that_cannot_be_read(
    daemon: DaemonFactory, tmp_path: Path, name: str, data: bytes, code: int
) -> None:
    (tmp_path / name).write_bytes(data)
    one = daemon(tmp_path / name, start=False)
    assert one.run_to_end() == code
    assert name in one.log


def cells_of(one: DaemonProcess) -> Path:
    """One of the cells in service."""
    return next((cache_of(one) / "map" / "pointcloud_map.pcd").iterdir())


def cache_of(one: DaemonProcess) -> Path:
    """Where a daemon keeps its divided cloud."""
    (found,) = (one.cache_dir / "shmmap" / "divided").iterdir()
    return found


def test_a_cloud_in_feet_is_refused_with_the_factor_or_converted(
    daemon: DaemonFactory, connect: Connect, tmp_path: Path
) -> None:
    """As `divide` does it; the division is kept apart from those of other units."""
    wkt = 'PROJCS["here (ftUS)",GEOGCS["G",DATUM["D"]],UNIT["US survey foot",0.3048006096012192]]'
    las = laspy.LasData(laspy.LasHeader(point_format=6, version="1.4"))
    las.header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(wkt))
    las.x, las.y, las.z = np.arange(500.0), np.arange(500.0), np.full(500, 10.0)
    las.write(str(tmp_path / "feet.las"))
    one = daemon(tmp_path / "feet.las", start=False)
    assert one.run_to_end() == 65
    assert "not in metres: x, y and z are in US survey feet (0.304800609601 m)" in one.log
    assert "--unit auto multiplies them by 0.304800609601" in one.log
    for unit, farthest in (("auto", 499 * 1200 / 3937), ("m", 499.0)):
        one = daemon(tmp_path / "feet.las", "--unit", unit)
        reply = connect(one).area(circle(0.0, 0.0, 4000.0))
        x = np.concatenate([read_pcd(Path(cell.id))["x"] for cell in reply.cells])
        assert len(x) == 500
        assert float(x.max()) == pytest.approx(farthest, abs=1e-3)
