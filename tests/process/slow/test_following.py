# SPDX-License-Identifier: Apache-2.0
"""Eight processes follow a drive differentially: right cells and bytes at every step, one copy in memory."""

from __future__ import annotations

import os
import shutil
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.process.conftest import DaemonFactory
from tests.support.client_programs import FollowingClient
from tests.support.cpp_client import CppFollower
from tests.support.divided_map import DividedMap, make_map, random_points, read_pcd, write_pcd
from tests.support.process_costs import proportional_bytes, proportional_bytes_under
from tests.support.raw_client import RawClient

Connect = Callable[..., RawClient]
Pose = tuple[float, float]
Follower = FollowingClient | CppFollower
PROCESSES = 8


@pytest.fixture
def followers(request: pytest.FixtureRequest) -> Iterator[Callable[[str], list[Follower]]]:
    """Start eight clients, half of them with a window; half of each are in C++, where there is g++."""
    started: list[Follower] = []
    program: Path | None = request.getfixturevalue("cpp_program") if shutil.which("g++") else None

    def start(endpoint: str) -> list[Follower]:
        for number in range(PROCESSES):
            mode = ("differential", "window")[number % 2]
            if program is not None and number >= PROCESSES // 2:
                started.append(CppFollower(program, endpoint, mode))
            else:
                started.append(FollowingClient(endpoint, mode))
        return started

    yield start
    for client in started:
        client.kill()


def written_map(root: Path) -> DividedMap:
    """Read back a map that the project's own writer made: corners from its YAML."""
    made = DividedMap(root)
    for line in (root / "pointcloud_map_metadata.yaml").read_text().splitlines():
        name, value = line.rsplit(":", 1)
        if name.endswith(".pcd"):
            x, y = value.strip(" []").split(",")
            made.corners[name.strip("'\"")] = (int(x), int(y))
    return made


def cut(columns: dict[str, np.ndarray], out: Path) -> DividedMap:
    """Cut a cloud with the project's own writer, as a user would."""
    from shmmap.dividing.map_writer import MapWriter

    xyz = np.column_stack([columns["x"], columns["y"], columns["z"]])
    with MapWriter(out, cell_size=20.0, durable=False) as writer:
        writer.add({"xyz": xyz, "intensity": columns["intensity"]})
        writer.finish()
    made = written_map(out)
    assert sum(len(made.points(name)["x"]) for name in made.corners) == len(xyz)
    return made


class Expected:
    """What the files hold, per cell: CRC-32 of xyz and of the intensity, and which state of the file."""

    def __init__(self, made: DividedMap) -> None:
        self.made = made
        self.state: dict[str, int] = dict.fromkeys(made.corners, 0)
        self._content: dict[str, tuple[int, int, int]] = {}

    def content(self, name: str) -> tuple[int, int, int]:
        """Points and checksums of a cell, read independently."""
        if name not in self._content:
            source = self.made.points(name)
            xyz = np.column_stack([source["x"], source["y"], source["z"]])
            self._content[name] = (
                len(xyz),
                zlib.crc32(xyz.tobytes()),
                zlib.crc32(source["intensity"].tobytes()),
            )
        return self._content[name]

    def change(self, seed: int, near: Pose) -> None:
        """Change two cells, delete one and add one close to all clients."""
        rng = np.random.default_rng(seed)
        around = self.made.in_circle(*near, 30.0)
        for name in around[:2]:
            corner = self.made.corners[name]
            self.made.write_cell(name, corner, random_points(rng, corner, 300 + seed))
            self.state[name] += 1
            self._content.pop(name, None)
        gone = around[2]
        corner = self.made.corners[gone]
        self.made.remove_cell(gone)
        new = f"new_{seed}.pcd"
        self.made.write_cell(new, corner, random_points(rng, corner, 400 + seed))
        self.state[new] = 0
        self.made.write_metadata()


def follow(
    clients: list[Follower],
    expected: Expected,
    poses: list[Pose],
    radius: float,
    reload: Callable[[], None],
    changes_at: set[int],
) -> None:
    """Drive; at some steps the map changes and is reloaded; check every answer of every process."""
    made = expected.made
    held: dict[str, int] = {}  # name -> state of the file
    for step, (x, y) in enumerate(poses):
        if step in changes_at:
            expected.change(step, (x, y))
            reload()
        wanted = {name: expected.state[name] for name in made.in_circle(x, y, radius)}
        new = {name for name, state in wanted.items() if held.get(name) != state}
        removed = set(held) - set(wanted)
        for client in clients:
            client.ask(x, y, radius)
        versions: dict[str, int] = {}
        for client in clients:
            seen = client.answer()
            assert {row[0].rsplit("/", 1)[1] for row in seen["new"]} == new, step
            assert len(seen["new"]) == len(new)
            assert {i.rsplit("/", 1)[1] for i in seen["removed"]} == removed, step
            assert {row[0] for row in seen["held"]} == {made.id(name) for name in wanted}, step
            for cell_id, version, *content in seen["new"]:
                assert tuple(content) == expected.content(cell_id.rsplit("/", 1)[1])
                assert versions.setdefault(cell_id, version) == version  # the same for all clients
        held = wanted
    for client in clients:
        if isinstance(client, CppFollower):
            contents = {cell_id: tuple(content) for cell_id, *content in client.contents()}
            assert contents == {made.id(name): expected.content(name) for name in held}


def drive(count: int, half_side: float) -> list[Pose]:
    """A closed loop, some corners cut, some places visited twice."""
    turn = np.linspace(0, 4 * np.pi, count)
    return [(half_side * np.cos(t), half_side * np.sin(1.5 * t)) for t in turn]


def start(
    daemon: DaemonFactory,
    connect: Connect,
    made: DividedMap,
    followers: Callable[[str], list[Follower]],
) -> tuple[list[Follower], Callable[[], None]]:
    one = daemon(made.root)
    control = connect(one)

    def reload() -> None:
        control.ask("reload")

    return followers(one.endpoint), reload


def test_on_a_generated_map(
    daemon: DaemonFactory,
    connect: Connect,
    tmp_path: Path,
    followers: Callable[[str], list[Follower]],
) -> None:
    made = make_map(tmp_path / "map", columns=14, rows=14, points=300)
    clients, reload = start(daemon, connect, made, followers)
    follow(clients, Expected(made), drive(60, 120.0), 40.0, reload, {15, 16, 40})


def test_on_the_real_map(
    daemon: DaemonFactory,
    connect: Connect,
    tmp_path: Path,
    data_dir: Path,
    followers: Callable[[str], list[Follower]],
) -> None:
    """Every other one of the recorded poses, radius 40 m."""
    source = read_pcd(data_dir / "kitti0005_map" / "map_static_v005.pcd")
    made = cut(source, tmp_path / "map")
    assert len(made.corners) == 59
    table = np.loadtxt(data_dir / "kitti0005_scans" / "poses_all_tum.txt")
    poses = [(float(x), float(y)) for x, y in table[::2, 1:3]]
    clients, reload = start(daemon, connect, made, followers)
    follow(clients, Expected(made), poses, 40.0, reload, {25, 50})


def test_on_the_tiled_map(
    daemon: DaemonFactory,
    connect: Connect,
    tmp_path: Path,
    data_dir: Path,
    followers: Callable[[str], list[Follower]],
) -> None:
    """5 900 cells: the real map, ten by ten times at 220 m; a route across it, radius 150 m.

    Thinned to every 60th point; ``SHMMAP_TEST_TILED_EVERY=1`` drives through all 302 million (4.8 GB).
    """
    from tests.benchmarks.tile_map import tile_map

    source = read_pcd(data_dir / "kitti0005_map" / "map_static_v005.pcd")
    cells, first = np.unique(
        np.floor(source["x"] / 20).astype(np.int64) * 1000 + np.floor(source["y"] / 20).astype(np.int64),
        return_index=True,
    )
    every = int(os.environ.get("SHMMAP_TEST_TILED_EVERY", "60"))
    keep = np.union1d(np.arange(0, len(source["x"]), every), first)  # every cell keeps a point at least
    assert len(cells) == 59
    write_pcd(tmp_path / "thin.pcd", {name: column[keep] for name, column in source.items()})
    tile_map(tmp_path / "thin.pcd", tmp_path / "map")
    made = written_map(tmp_path / "map")
    assert len(made.corners) == 5900
    steps = np.linspace(0, 1, 60)
    poses = [(float(2000 * t), float(1000 + 900 * np.sin(5 * t))) for t in steps]
    clients, reload = start(daemon, connect, made, followers)
    follow(clients, Expected(made), poses, 150.0, reload, {20, 45})


# --- many processes, one copy ------------------------------------------------------------------------

READERS = 8


def test_eight_processes_share_one_copy(daemon: DaemonFactory, tmp_path: Path) -> None:
    """100 MB held by eight processes, every byte read by each: summed PSS is that of one copy.

    The interpreters' own memory is measured before, when the same processes are connected and have
    computed the same over one cell.
    """
    made = make_map(tmp_path / "map", columns=8, rows=8, points=105_000)
    one = daemon(made.root, "--budget", "512M")
    clients = [FollowingClient(one.endpoint, "area") for _ in range(READERS)]
    try:
        own = _ask_all(clients, 70.0, 70.0, 1.0)
        shared_before = sum(proportional_bytes_under(c.process.pid, one.shm_dir) for c in clients)
        held = _ask_all(clients, 0.0, 0.0, 500.0)
        shared = sum(proportional_bytes_under(c.process.pid, one.shm_dir) for c in clients)
        copy = one.segment_bytes()
        assert copy >= 100 << 20
        assert shared <= 1.02 * copy
        assert held - (own - shared_before) <= 1.1 * copy
    finally:
        for client in clients:
            client.kill()


def _ask_all(clients: list[FollowingClient], x: float, y: float, radius: float) -> int:
    """Have all read what is there; returns their summed PSS while they hold it."""
    for client in clients:
        client.ask(x, y, radius)
    answers = [client.answer() for client in clients]
    assert all(len(a["new"]) == len(answers[0]["new"]) > 0 for a in answers)
    return sum(proportional_bytes(client.process.pid) for client in clients)
