# SPDX-License-Identifier: Apache-2.0
"""Clients drive over a published map of many shards: every reply is the set difference of what is known.

Pages of the list of cells come as clients near them, and go again, for there is room for a part of them only;
during the drive another version is published, and the link is lost and found.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tests.process.conftest import DaemonFactory
from tests.support.command_line import publish
from tests.support.divided_map import DividedMap, random_points
from tests.support.published_daemon import until
from tests.support.raw_client import RawClient, circle
from tests.support.segment_reader import read_segment
from tests.support.web_servers import faulty_web

pytest.importorskip("zstandard", reason="zstandard is not installed")
pytest.importorskip("obstore", reason="obstore is not installed")

SHARDS, CELLS, RADIUS, STEP = 40, 8, 70.0, 160.0
ROADS = (0.0, 30.0, 80.0, 170.0)
"""Where each client drives, metres north of the map's southern border; the last one just passes by."""


class State:
    """What the map is in one version: names, boxes, and each cell's points."""

    def __init__(self, made: DividedMap) -> None:
        self.names = sorted(made.corners)
        self.boxes = np.array([made.box(name) for name in self.names])
        self.points = {name: made.points(name) for name in self.names}

    def touched(self, x: float, y: float) -> list[str]:
        """Names of the cells in a client's circle, in id order."""
        dx = np.maximum(np.maximum(self.boxes[:, 0] - x, x - self.boxes[:, 2]), 0.0)
        dy = np.maximum(np.maximum(self.boxes[:, 1] - y, y - self.boxes[:, 3]), 0.0)
        return [self.names[i] for i in np.flatnonzero(dx * dx + dy * dy <= RADIUS * RADIUS).tolist()]


class Driver:
    """One client, what it holds, and what it should."""

    def __init__(self, client: RawClient, y: float) -> None:
        self.client, self.y = client, y
        self.held: dict[str, int] = {}
        self.known: dict[tuple[str, int], bytes] = {}  # the points of each version that was seen

    def step(self, x: float, states: dict[int, State], wait: float | None) -> bool:
        """Ask for what is new at a place; whether all that is there is known."""
        rows = [[name, version] for name, version in self.held.items()]
        raw = self.client.ask("differential", circle(x, self.y, RADIUS), ["points"], rows, b"", wait)
        reply, covered, reason = self.client.cells_reply(raw), raw[10], raw[11] if len(raw) > 11 else ""
        state = states[reply.map_version]
        wanted = state.touched(x, self.y)
        assert not [f for f in reply.failed if f.code != "offline"]
        came = {handle.id.rsplit("/", 1)[1]: handle for handle in reply.cells if not handle.stale}
        missing = {id_.rsplit("/", 1)[1] for id_, _ in reply.pending}
        missing |= {failure.id.rsplit("/", 1)[-1] for failure in reply.failed}
        assert came.keys() <= set(wanted)
        for name, handle in came.items():
            assert self.held.get(name) != handle.version, "it is held already"
            points = read_segment(self.client.path(handle)).columns["xyz"]
            source = state.points[name]
            right = np.column_stack([source["x"], source["y"], source["z"]]).tobytes()
            assert points.tobytes() == right
            assert self.known.setdefault((name, handle.version), points.tobytes()) == right
        gone = {name.rsplit("/", 1)[-1] for name in reply.removed}
        if covered:
            assert reason == ""
            assert gone == self.held.keys() - set(wanted)
            still = [name for name in wanted if name in self.held and name not in came]
            for name in still:
                if name not in missing:
                    source = state.points[name]
                    right = np.column_stack([source["x"], source["y"], source["z"]]).tobytes()
                    assert self.known[name, self.held[name]] == right, "what is held is current"
            assert set(came) | set(still) | missing == set(wanted)
        else:
            assert gone.isdisjoint(wanted)
        for name in gone:
            self.held.pop(name, None)
        self.held |= {name: handle.version for name, handle in came.items()}
        return bool(covered) and not missing


def make_road(folder: Path) -> DividedMap:
    made = DividedMap(folder)
    made.pcd_dir.mkdir(parents=True)
    rng = np.random.default_rng(5)
    for shard in range(SHARDS):
        for number in range(CELLS):  # across the borders of shards, too
            corner = (640 * shard - 40 + 20 * (number % 4), 20 * (number // 4))
            name = f"{corner[0]}_{corner[1]}.pcd"
            made.write_cell(name, corner, random_points(rng, corner, 20))
    made.write_metadata()
    return made


def test_every_reply_is_the_set_difference(
    daemon: DaemonFactory, connect: Callable[..., RawClient], tmp_path: Path
) -> None:
    made = make_road(tmp_path / "road")
    publish(made.root, tmp_path / "www")
    with faulty_web(tmp_path / "www") as web:
        one = daemon(web.url, "--poll", "0", "--catalogue-budget", "64K", "--budget", "1M")
        drivers = [Driver(connect(one), y) for y in ROADS]
        operator = connect(one)
        states = {operator.map_version: State(made)}
        places = np.arange(-100.0, 640.0 * SHARDS, STEP).tolist()
        for number, x in enumerate(places):
            if number == len(places) // 4:
                web.fault = lambda _path: "503"
            if number == len(places) // 4 + 6:
                web.heal()
                until(lambda x: drivers[0].step(x, states, 5.0), x)
            if number == len(places) // 2:
                for seed, name in enumerate(sorted(made.corners)[::3]):
                    made.change(name, seed=seed, count=20)
                for name in sorted(made.corners)[1::9]:
                    made.remove_cell(name)
                made.write_cell("new.pcd", (int(x) + 40, 40), random_points(np.random.default_rng(9),
                                (int(x) + 40, 40), 20))  # fmt: skip
                made.write_metadata()
                publish(made.root, tmp_path / "www")
                states[operator.ask("reload")[2]] = State(made)
                assert len(states) == 2
            is_out = len(places) // 4 <= number < len(places) // 4 + 6
            for driver in drivers:
                knows_all = driver.step(x, states, None if number % 5 == 4 else 30.0)
                assert knows_all or is_out or number % 5 == 4
        seen = [len({name for name, _ in driver.known}) for driver in drivers]
        assert min(seen[:3]) > SHARDS
        assert seen[3] == 0
        counters = operator.ask("stats")[4]
        assert 0 < counters["map_cells_known"] < 0.8 * SHARDS * CELLS, "the whole list has no room"
