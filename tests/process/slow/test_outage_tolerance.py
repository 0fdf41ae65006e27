# SPDX-License-Identifier: Apache-2.0
"""A vehicle drives along its route while the store of a published map is away: it does not notice."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import shmmap
from tests.process.conftest import DaemonFactory
from tests.support.command_line import publish
from tests.support.daemon_process import DaemonProcess, Deadline, counters, until
from tests.support.divided_map import DividedMap, random_points
from tests.support.web_servers import FaultyWeb, faulty_web

pytest.importorskip("zstandard", reason="zstandard is not installed")
pytest.importorskip("obstore", reason="obstore is not installed")

SIZE, ROAD_M, SHARDS = 20, 1400, 20
SPEED, OUTAGE_TOLERANCE_S, RADIUS, STEP = 20.0, 30.0, 6.0, 20
ROUTE = [(0.0, 10.0), (float(ROAD_M), 10.0)]
DRIVEN_M = int(SPEED * OUTAGE_TOLERANCE_S)
TIMEOUT_S = 60.0


@pytest.fixture
def web(tmp_path: Path) -> Iterator[FaultyWeb]:
    """A road of cells from the origin east, and some shards far from it: the list of cells comes in pages."""
    made = DividedMap(tmp_path / "road", float(SIZE))
    made.pcd_dir.mkdir(parents=True)
    rng = np.random.default_rng(3)
    far = [(640 * number, 6400) for number in range(SHARDS)]
    for corner in [*((x, 0) for x in range(0, ROAD_M, SIZE)), *far]:
        made.write_cell(f"{corner[0]}_{corner[1]}.pcd", corner, random_points(rng, corner, 3000))
    made.write_metadata()
    publish(made.root, tmp_path / "www")
    with faulty_web(tmp_path / "www") as one:
        yield one


def in_memory(one: DaemonProcess) -> set[str]:
    with shmmap.connect(one.endpoint) as client:
        return {row.id for row in client.list_cells()}


def counts_now(one: DaemonProcess) -> dict[str, int]:
    """Counters by a reply, which the statistics segment follows only with the next beat."""
    with shmmap.connect(one.endpoint) as client:
        return dict(client.stats().counters)


def until_in_memory(one: DaemonProcess, *names: str) -> None:
    until(lambda: set(names) <= in_memory(one))


def drive(one: DaemonProcess, window: shmmap.MapWindow) -> None:
    """Drive through the outage, no faster than a vehicle could."""
    for x in range(STEP, DRIVEN_M, STEP):
        until_in_memory(one, f"{x - STEP}_0.pcd", f"{x}_0.pcd")
        update = window.move_to(x, 10.0, vx=SPEED, route=ROUTE, wait=TIMEOUT_S)
        assert update.complete, (x, update.failed)
    counts = counts_now(one)
    assert counts["prefetch_misses"] == 0
    assert counts["origin_out"] == 1, "it was away all the time"


def until_out(one: DaemonProcess) -> None:
    until(lambda: counters(one)["origin_out"])


def test_cells_and_pages_along_the_route_are_in_memory(daemon: DaemonFactory, web: FaultyWeb) -> None:
    """Only a part of the list of cells fits; the pages along the route stay."""
    words = ("--poll", "1", "--outage-tolerance", str(OUTAGE_TOLERANCE_S), "--catalogue-budget", "64K")
    one = daemon(web.url, *words)
    with shmmap.MapWindow(one.endpoint, RADIUS) as window:
        assert window.move_to(1.0, 10.0, vx=SPEED, route=ROUTE, wait=TIMEOUT_S).complete
        until_in_memory(one, *(f"{x}_0.pcd" for x in range(0, DRIVEN_M + SIZE, SIZE)))
        web.refuse()
        until_out(one)
        drive(one, window)


def test_what_does_not_fit_in_memory_is_on_the_disk(daemon: DaemonFactory, web: FaultyWeb) -> None:
    """Memory has room for a few seconds of the drive; the rest comes out of the disk cache in time."""
    words = (
        "--poll",
        "1",
        "--outage-tolerance",
        str(OUTAGE_TOLERANCE_S),
        "--budget",
        "2M",
        "--prefetch-share",
        "0.2",
    )
    one = daemon(web.url, *words)
    with shmmap.MapWindow(one.endpoint, RADIUS) as window:
        assert window.move_to(1.0, 10.0, vx=SPEED, route=ROUTE, wait=TIMEOUT_S).complete
        wanted, cells = DRIVEN_M // SIZE + 1, Path(one.cache_dir)
        until(lambda: sum(path.is_file() for path in cells.rglob("objects/cells/*/*")) >= wanted)
        waiting = Deadline()
        while waiting(not (counts := counters(one))["disk_ahead"] or counts["objects_fetched"] < wanted):
            window.move_to(1.0, 10.0, vx=SPEED, route=ROUTE)
        # the list of cells may have come out of order: then what is needed first takes the place of the rest
        until_in_memory(one, "20_0.pcd", "40_0.pcd", "60_0.pcd")
        far = {f"{x}_0.pcd" for x in range(DRIVEN_M // 2, ROAD_M, SIZE)}
        assert not far <= in_memory(one), "memory has no room for all of it"
        web.refuse()
        until_out(one)
        drive(one, window)
        assert counts_now(one)["objects_from_disk"] > wanted // 2
