# SPDX-License-Identifier: Apache-2.0
"""The package ``clients/ros``: what needs no rclcpp beside real daemons, and the rest where rclcpp is there.

``CMAKE_PREFIX_PATH`` names where rclcpp and the other packages of ROS 2 are, as a sourced ROS does.
"""

from __future__ import annotations

import math
import os
import re
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from shmmap_clients.ros_cells import Catalogue, CellAnswers, RecentCells
from shmmap_clients.ros_node import settings

import shmmap
from tests.cpp.conftest import DaemonFactory
from tests.support.autoware_node import SERVICES, TYPES, AutowareNode, compiled_with
from tests.support.compiled_programs import built_once
from tests.support.cpp_client import FLAGS
from tests.support.daemon_process import ROOT, DaemonProcess
from tests.support.divided_map import DividedMap, make_map
from tests.support.ros.replies import Reply, expected, from_lines
from tests.support.skips import programs_or_skip

PACKAGE = ROOT / "clients" / "ros"
SOURCE = (PACKAGE / "src" / "map_loader.cpp").read_text()
NEAR = (3.0, -4.0, 15.0)
EVERYTHING = (0.0, 0.0, 500.0)


class Services(AutowareNode):
    """The node without ROS."""

    def __init__(self, program: Path) -> None:
        super().__init__(program, "done")

    def start(self, daemon: DaemonProcess, wait_s: float = 60.0, max_waiting: int = 256, *more: str) -> None:
        """Begin, beside a daemon."""
        self.ask("start", daemon.endpoint, wait_s, max_waiting, *more)

    def send(self, verb: str, *area: float, ids: list[str] | None = None) -> int:
        """Send a request; returns its number."""
        ((number,),) = self.ask(verb, *area, *([] if ids is None else [";".join(ids)]))
        return int(number)

    def receive(self, number: int) -> Reply:
        """Wait for an answer."""
        return from_lines("".join("\t".join(line) + "\n" for line in self.ask("answer", number)))

    def call(self, verb: str, *area: float, ids: list[str] | None = None) -> Reply:
        """Ask."""
        return self.receive(self.send(verb, *area, ids=ids))

    @property
    def log(self) -> list[str]:
        """What it logged since."""
        return [line[0] for line in self.ask("log")]

    @property
    def state(self) -> tuple[bool, int, int]:
        """Whether the daemon answers, requests waiting, cells left out."""
        reachable, waiting, left_out = self.ask("state")[0][0].split()
        return reachable == "1", int(waiting), int(left_out)


@pytest.fixture(scope="module", params=TYPES)
def services_program(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the compiled program."""
    programs_or_skip("g++")
    name = f"services-{request.param}"
    program = built_once(tmp_path_factory, name, lambda to: compiled_with(request.param, SERVICES, to))
    assert program is not None
    return program


@pytest.fixture
def node(services_program: Path, daemon: DaemonFactory) -> Iterator[Services]:
    """Return a node that has not begun; nothing in it may leak or go wrong."""
    one = Services(services_program)
    yield one
    assert one.close() == 0


def named(
    daemon: DaemonProcess, town: DividedMap, files: list[str], removed: list[str] | None = None
) -> Reply:
    """What the files say, under the names of the versions that the daemon has."""
    found = expected(town, files, removed or [])
    with shmmap.connect(daemon.endpoint) as client:
        now = {cell.id: f"{cell.id}@{cell.version:016x}" for cell in client.metadata()}
    return found._replace(cells=[cell._replace(id=now[cell.id]) for cell in found.cells])


# --- answers --------------------------------------------------------------------------------------------


def test_three_services_to_the_byte(daemon: DaemonFactory, node: Services, divided_map: DividedMap) -> None:
    one = daemon(divided_map.root)
    node.start(one)
    near, far = divided_map.in_square(*NEAR), "40_40.pcd"
    assert node.call("partial", *NEAR) == named(one, divided_map, near)
    names = dict(zip(near, node.call("partial", *NEAR).ids, strict=True))
    (far_name,) = node.call("selected", ids=[divided_map.id(far)]).ids
    has = [names[near[1]], "gone.pcd", far_name, names[near[2]]]
    new = [name for name in near if name not in near[1:3]]
    assert node.call("differential", *NEAR, ids=has) == named(one, divided_map, new, has[1:3])
    ids = [far_name, "unknown", divided_map.id(near[0]), far, far_name]
    assert node.call("selected", ids=ids) == named(one, divided_map, [far, near[0], far, far])
    assert node.call("selected", ids=[]) == named(one, divided_map, [])
    assert node.log == [
        f"error an answer lacks cells: {divided_map.pcd_dir}/unknown: the map has no such cell (unknown_cell)"
    ]
    assert node.state == (True, 0, 1)


def test_answers_are_those_of_the_node_in_python(
    daemon: DaemonFactory, node: Services, divided_map: DividedMap
) -> None:
    """Whatever the area is: also infinite, negative, no number."""
    one = daemon(divided_map.root)
    node.start(one)
    python = CellAnswers(Catalogue(), RecentCells())
    nan, inf = math.nan, math.inf
    places = [NEAR, EVERYTHING, (0, 0, 0), (20, 20, 0), (1e6, 0, 3), (0, 0, -5), (0, 0, -15), (nan, 0, 5)]
    places += [
        (0, 0, nan),
        (0, 0, inf),
        (inf, 0, 5),
        (inf, 0, inf),
        (inf, nan, inf),
        (0, 0, -inf),
        (0.1, 0.1, 1e30),
    ]
    old = [f"{divided_map.id('0_0.pcd')}@{7:016x}", divided_map.id("20_20.pcd"), "elsewhere"]
    with shmmap.connect(one.endpoint) as client:
        client.around(0, 0, radius=500, wait=60)
        for x, y, radius in places:
            area = SimpleNamespace(center_x=x, center_y=y, radius=radius)
            for cached in ([], old):
                wanted = python.differential(client, area, cached, True)
                found = node.call("differential", x, y, radius, ids=cached)
                assert (found.ids, found.removed) == (wanted.names, wanted.removed), (x, y, radius)
            assert node.call("partial", x, y, radius).ids == python.partial(client, area, True).names
    assert node.log == []


def test_ids_without_versions(daemon: DaemonFactory, node: Services, divided_map: DividedMap) -> None:
    node.start(daemon(divided_map.root), 60.0, 256, "plain")
    everything = node.call("partial", *EVERYTHING)
    assert everything == expected(divided_map, sorted(divided_map.corners))
    assert node.call("selected", ids=everything.ids) == everything
    assert node.call("differential", *EVERYTHING, ids=everything.ids).cells == []


def test_the_endpoint_may_be_an_instances_name(
    daemon: DaemonFactory, services_program: Path, divided_map: DividedMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = daemon(divided_map.root)
    socket = Path(one.endpoint)
    monkeypatch.setenv("SHMMAP_ENDPOINT", "/nowhere.sock")
    monkeypatch.setenv("SHMMAP_RUNTIME_DIR", str(socket.parent))
    node = Services(services_program)
    node.ask("start", socket.stem, 60.0, 256)
    assert len(node.call("partial", *EVERYTHING).cells) == 36
    assert node.close() == 0


def test_a_changed_cell_comes_once_over_restarts_of_node_and_daemon(
    daemon: DaemonFactory, node: Services, services_program: Path, divided_map: DividedMap
) -> None:
    one = daemon(divided_map.root)
    node.start(one)
    held = node.call("partial", *NEAR).ids
    divided_map.change("0_0.pcd", seed=3)
    one.kill()
    one.start()
    other = Services(services_program)
    other.start(one)
    for each in (node, other):
        found = each.call("differential", *NEAR, ids=held)
        assert len(found.cells) == len(found.removed) == 1
        assert found.cells == named(one, divided_map, ["0_0.pcd"]).cells
        has = [name for name in held if name not in found.removed] + found.ids
        assert each.call("differential", *NEAR, ids=has) == named(one, divided_map, [])
    assert other.close() == 0


# --- what waits -----------------------------------------------------------------------------------------


def test_no_request_waits_for_another(daemon: DaemonFactory, node: Services, divided_map: DividedMap) -> None:
    one = daemon(divided_map.root)
    node.start(one)
    warm, *cold = sorted(divided_map.corners)
    node.call("selected", ids=[divided_map.id(warm)])
    loaders = one.stop_loaders()
    numbers = [node.send("selected", ids=[divided_map.id(name)]) for name in cold[:20]]
    assert node.call("selected", ids=[divided_map.id(warm)]) == named(one, divided_map, [warm])
    assert node.state == (True, 20, 0)
    for pid in loaders:
        os.kill(pid, signal.SIGCONT)
    for name, number in zip(cold, numbers, strict=False):
        assert node.receive(number) == named(one, divided_map, [name])
    assert node.log == []


def test_what_is_there_goes_when_the_time_is_over(
    daemon: DaemonFactory, node: Services, divided_map: DividedMap
) -> None:
    one = daemon(divided_map.root)
    near = divided_map.in_square(*NEAR)
    with shmmap.connect(one.endpoint) as client:
        client.selected([divided_map.id(near[0])], wait=60)
    loaders = one.stop_loaders()
    node.start(one, 0.3)
    assert node.call("partial", *NEAR) == named(one, divided_map, near[:1])
    ((line,), (reachable, _, left_out)) = node.log, node.state
    assert "it is still being loaded" in line
    assert (reachable, left_out) == (True, len(near) - 1)
    for pid in loaders:
        os.kill(pid, signal.SIGCONT)


def test_without_a_daemon_requests_wait(
    daemon: DaemonFactory, node: Services, divided_map: DividedMap
) -> None:
    """The time of cells does not run meanwhile; it is logged once, and so is the end of it."""
    one = daemon(divided_map.root, start=False)
    node.start(one, 20.0)
    numbers = [node.send("partial", *NEAR) for _ in range(12)]
    assert node.ask("look") == []
    one.start()
    wanted = named(one, divided_map, divided_map.in_square(*NEAR))
    assert [node.receive(number) for number in numbers] == [wanted] * 12
    assert [line[0].rpartition("/")[2] for line in node.ask("look")] == sorted(divided_map.corners)
    one.kill()
    numbers = [node.send("partial", *NEAR) for _ in range(12)]
    assert node.ask("look") == []
    assert not {str(number) for number in numbers} & {line[0] for line in node.ask("answered")}
    assert node.state == (False, 12, 0)
    one.start()
    assert [node.receive(number) for number in numbers] == [wanted] * 12
    assert [line.split(":")[0] for line in node.log] == [
        "warn requests wait until the daemon answers",
        "info the daemon answers again",
    ] * 2


def test_above_a_limit_the_oldest_is_given_up(
    daemon: DaemonFactory, node: Services, divided_map: DividedMap
) -> None:
    one = daemon(divided_map.root)
    node.start(one, 60.0, 3)
    node.call("partial", 10, 10, 1)
    loaders = one.stop_loaders()
    first, *others = [node.send("partial", x, 30, 1) for x in (-50, -30, -10, 10)]
    assert node.receive(first).cells == []
    assert node.log == ["error a request is answered with nothing: as many younger ones wait as may"]
    for pid in loaders:
        os.kill(pid, signal.SIGCONT)
    assert [len(node.receive(number).cells) for number in others] == [1] * 3


@pytest.mark.parametrize("away", [False, True])
def test_its_end_waits_for_no_request(
    daemon: DaemonFactory, node: Services, divided_map: DividedMap, *, away: bool
) -> None:
    one = daemon(divided_map.root)
    node.start(one, 3600.0)
    node.call("partial", 10, 10, 1)
    loaders = [] if away else one.stop_loaders()
    if away:
        one.kill()
    numbers = [node.send("partial", *EVERYTHING) for _ in range(20)]
    node.ask("stop")
    assert node.ask("answered") == [["0"]]
    assert len(numbers) == 20
    for pid in loaders:
        os.kill(pid, signal.SIGCONT)


# --- the map as a whole ---------------------------------------------------------------------------------


def test_the_list_of_cells_follows_the_map(
    daemon: DaemonFactory, node: Services, divided_map: DividedMap
) -> None:
    one = daemon(divided_map.root)
    node.start(one)
    assert [line[0] for line in node.ask("look")] == sorted(map(divided_map.id, divided_map.corners))
    assert node.ask("look") == []
    divided_map.remove_cell("0_0.pcd")
    divided_map.write_metadata()
    with shmmap.connect(one.endpoint) as client:
        client.reload()
    assert len(node.ask("look")) == 35


def test_the_whole_map_as_one_cloud(daemon: DaemonFactory, node: Services, tmp_path: Path) -> None:
    """With the fields of the first cell: others of other cells are left out, and what they lack is zero."""
    town = make_map(tmp_path / "map", columns=3, rows=1)
    names = sorted(town.corners)
    first, second, third = (town.points(name) for name in names)
    second = {**{axis: second[axis] for axis in "xyz"}, "ring": np.arange(len(second["x"]), dtype=np.uint16)}
    town.write_cell(names[1], town.corners[names[1]], second)
    one = daemon(town.root)
    node.start(one)

    def rows(columns: dict[str, Any]) -> bytes:
        given = [columns.get(name, np.zeros(len(columns["x"]), np.float32)) for name in first]
        return np.stack(given, axis=1).astype(np.float32).tobytes()

    found = {
        line[0].partition(" ")[0]: line[0].partition(" ")[2] for line in node.ask("whole", "points", 10**9)
    }
    assert bytes.fromhex(found["data"]) == rows(first) + rows(second) + rows(third)
    assert found["cloud"] == "0 0 map"
    points = sum(len(one["x"]) for one in (first, second, third))
    assert found["shape"] == f"1 {points} 0 16 {16 * points} 1"
    ((refused,),) = node.ask("whole", "points", 10_000)
    assert refused.startswith("bad_request the whole map takes about ")


def test_a_map_with_a_hole_is_no_whole_one(daemon: DaemonFactory, node: Services, tmp_path: Path) -> None:
    town = make_map(tmp_path / "map", columns=2, rows=1)
    (town.pcd_dir / sorted(town.corners)[1]).write_bytes(b"no cloud")
    node.start(daemon(town.root))
    ((refused,),) = node.ask("whole", "points", 10**9)
    assert refused.startswith("load_failed ")


# --- the package ----------------------------------------------------------------------------------------


def test_names_and_parameters_are_those_of_the_node_in_python() -> None:
    remaps = re.findall(r'^    "(\S+):=(\S+)",$', SOURCE, re.MULTILINE)
    assert dict(remaps) == settings.REMAPS
    shown_only_there = {"live", "base_frame"}
    for name, (_, description) in settings.PARAMETERS.items():
        if name in shown_only_there or name.startswith(("around.", "projected_map.")):
            continue
        assert f'"{name}"' in SOURCE, name
        assert f'"{description}"' in SOURCE, name


def test_the_manifest_is_one_that_ros_takes() -> None:
    """And names what CMake looks for."""
    code = "import sys; from catkin_pkg import package; p = package.parse_package(sys.argv[1]); p.validate()"
    code += "; print(p.name, p.version, p.get_build_type(), *sorted(one.name for one in p.build_depends))"
    done = subprocess.run(
        ["/usr/bin/python3", "-c", code, str(PACKAGE)], check=False, capture_output=True, text=True
    )
    if "No module named 'catkin_pkg'" in done.stderr:
        pytest.skip("catkin_pkg is missing (colcon, python3-colcon-ros)")
    name, version, build_type, *needs = done.stdout.split()
    assert (name, version, build_type) == ("shmmap_ros", shmmap.__version__, "ament_cmake"), done.stderr
    (found,) = re.findall(
        r"^foreach\(package (.*)\)$", (PACKAGE / "CMakeLists.txt").read_text(), re.MULTILINE
    )
    assert {*found.split()} == {*needs} - {"sensor_msgs"}, "which come with those of the map"


def test_the_launch_file() -> None:
    """Each implementation is started once, with the same parameters, under Autoware's name."""
    launch = ElementTree.parse(PACKAGE / "launch" / "pointcloud_map_loader.launch.xml").getroot()
    (choice,) = (one for one in launch.iter("arg") if one.get("name") == "implementation")
    assert choice.get("default") == "cpp"
    assert [one.get("value") for one in choice] == ["cpp", "python"]
    cpp, python = launch.findall("node")
    (component,) = launch.iter("composable_node")
    for one in (cpp, python, component):
        assert (one.get("name"), one.get("namespace")) == ("pointcloud_map_loader", "/map")
        assert [sorted(child.attrib.items()) for child in one] == [
            sorted(child.attrib.items()) for child in cpp
        ]
    assert (cpp.get("pkg"), cpp.get("exec")) == ("shmmap_ros", "pointcloud_map_loader")
    assert component.get("plugin") == "shmmap_ros::MapLoader"
    assert python.get("pkg") is None, "pip makes no package of ROS"
    given = re.findall(
        r"^    (\w+): ", (PACKAGE / "launch" / "pointcloud_map_loader.param.yaml").read_text(), re.M
    )
    assert {*given} < {*settings.PARAMETERS}


@pytest.mark.parametrize("compiler", ["g++", "clang++"])
def test_headers_stand_alone(compiler: str, tmp_path: Path) -> None:
    programs_or_skip(compiler)
    for name in ("requests", "whole_map"):
        source = tmp_path / f"{name}.cpp"
        source.write_text(f"#include <shmmap_ros/{name}.hpp>\n#include <shmmap_ros/{name}.hpp>\n")
        options = ["-std=c++17", "-fsyntax-only", *FLAGS, f"-I{PACKAGE / 'include'}"]
        subprocess.run([compiler, *options, str(source)], check=True)
