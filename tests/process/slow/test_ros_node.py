# SPDX-License-Identifier: Apache-2.0
"""``shmmap-ros-node`` against real daemons, asked by real ROS nodes over Fast DDS, ROS 2's default."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import shmmap
from tests.process.conftest import DaemonFactory
from tests.support.daemon_process import DaemonProcess, counters, first_answer, until
from tests.support.divided_map import DividedMap, make_map
from tests.support.ros.environment import environment_folder
from tests.support.ros.processes import (
    NODE,
    SERVICES,
    RosDomain,
    RosNode,
    RosPeer,
    Subscription,
    fields,
)
from tests.support.ros.replies import Reply, expected

METADATA = ("autoware_map_msgs/msg/PointCloudMapMetaData", "/map/pointcloud_map_metadata")
CLOUD = "sensor_msgs/msg/PointCloud2"
SELECTED = ("-p", "enable_selected_load:=true")
NEAR = (3.0, -4.0, 15.0)


@pytest.fixture
def peer(domain: RosDomain) -> RosPeer:
    """A process with ROS nodes that ask."""
    return domain.peer()


@pytest.fixture
def node(domain: RosDomain, served: DaemonProcess) -> RosNode:
    """The node, with all services."""
    return domain.node(served, *SELECTED)


def names(daemon: DaemonProcess) -> dict[str, str]:
    """Names of the cells in messages, by their ids."""
    with shmmap.connect(daemon.endpoint) as client:
        return {cell.id: f"{cell.id}@{cell.version:016x}" for cell in client.metadata()}


def reload(daemon: DaemonProcess) -> None:
    """Have the daemon read its map again."""
    with shmmap.connect(daemon.endpoint) as client:
        client.reload()


def answer(
    daemon: DaemonProcess, town: DividedMap, files: list[str], removed: list[str] | None = None
) -> Reply:
    """What the files say, under the names of the versions that the daemon has."""
    found, now = expected(town, files, removed or []), names(daemon)
    return found._replace(cells=[cell._replace(id=now[cell.id]) for cell in found.cells])


def waiting(diagnostics: Subscription) -> int:
    """How many requests wait, as the node says next."""
    (status,) = diagnostics.next()["status"]
    return int(next(one["value"] for one in status["values"] if one["key"] == "requests waiting"))


def diagnosed(peer: RosPeer) -> Subscription:
    """What the node says of itself, once a second."""
    return peer.subscribed("diagnostic_msgs/msg/DiagnosticArray", "/diagnostics", latched=False)


# --- what is answered ---------------------------------------------------------------------------------


@pytest.mark.usefixtures("node")
def test_three_services_to_the_byte(peer: RosPeer, served: DaemonProcess, divided_map: DividedMap) -> None:
    near, far = divided_map.in_square(*NEAR), "40_40.pcd"
    assert 4 <= len(near) < len(divided_map.corners)
    assert far not in near
    assert peer.asked("partial", area=NEAR) == answer(served, divided_map, near)
    now = names(served)
    has = [now[divided_map.id(near[1])], "gone.pcd", now[divided_map.id(far)], now[divided_map.id(near[2])]]
    new = [name for name in near if name not in near[1:3]]
    assert peer.asked("differential", area=NEAR, ids=has) == answer(served, divided_map, new, has[1:3])
    wanted = [far, near[0], far]
    ids = [now[divided_map.id(far)], "unknown", *map(divided_map.id, wanted[1:])]
    assert peer.asked("selected", ids=ids) == answer(served, divided_map, wanted)
    assert peer.asked("selected", ids=[]) == answer(served, divided_map, [])


@pytest.mark.usefixtures("node")
def test_an_id_without_a_version_is_outdated(
    peer: RosPeer, served: DaemonProcess, divided_map: DividedMap
) -> None:
    near = divided_map.in_square(*NEAR)
    plain = divided_map.id(near[0])
    now = names(served)
    has = [plain, *(now[divided_map.id(name)] for name in near[1:])]
    assert peer.asked("differential", area=NEAR, ids=has) == answer(served, divided_map, near[:1], [plain])


def test_a_path_may_hold_the_sign_before_versions(
    daemon: DaemonFactory, domain: RosDomain, peer: RosPeer, tmp_path: Path
) -> None:
    town = make_map(tmp_path / "a@b@0123456789abcdef" / "map", columns=2, rows=1)
    left, right = sorted(town.corners)
    town.write_cell("x@0123456789abcdef.pcd", town.corners[left], town.points(left))
    town.remove_cell(left)
    town.write_metadata()
    one = daemon(town.root)
    domain.node(one, *SELECTED)
    everything = peer.asked("partial", area=(0, 0, 1e3))
    assert everything == answer(one, town, sorted(town.corners))
    assert peer.asked("differential", area=(0, 0, 1e3), ids=everything.ids).cells == []
    for ids in (everything.ids, list(map(town.id, sorted(town.corners)))):
        assert peer.asked("selected", ids=ids) == everything
    town.change(right, seed=3)
    reload(one)
    found = peer.asked("differential", area=(0, 0, 1e3), ids=everything.ids)
    assert found == answer(one, town, [right], [name for name in everything.ids if town.id(right) in name])


class Requester:
    """A node as Autoware's compare filter: what it has under a name it keeps, whatever comes under it."""

    def __init__(self, peer: RosPeer) -> None:
        self._client = peer.client("differential")
        self.cells: dict[str, bytes] = {}

    def ask(self) -> int:
        """Ask for what is new; returns how many cells came."""
        found = self._client.call(**fields("differential", area=NEAR, ids=list(self.cells)))
        for name in found.removed:
            del self.cells[name]
        for cell in found.cells:
            self.cells.setdefault(cell.id, cell.data)
        return len(found.cells)


def test_a_changed_cell_comes_once_to_each_requester_over_restarts_of_node_and_daemon(
    peer: RosPeer, node: RosNode, served: DaemonProcess, divided_map: DividedMap
) -> None:
    near = divided_map.in_square(*NEAR)
    requesters = [Requester(peer) for _ in range(2)]

    def nothing() -> None:
        pass

    def another_node() -> None:
        assert node.end(signal.SIGTERM) == 0
        node.start()

    def another_daemon() -> None:
        served.kill()
        served.start()

    assert [one.ask() for one in requesters] == [len(near)] * 2
    for seed, between in enumerate((nothing, another_node, another_daemon)):
        before = peer.servers("differential")
        divided_map.change(near[seed], seed=seed)
        between()
        reload(served)
        if between is another_node:
            peer.wait_other_server("differential", before)
        assert [one.ask() for one in requesters] == [1, 1]
        assert [one.ask() for one in requesters] == [0, 0], "once"
        wanted = {cell.id: cell.data for cell in answer(served, divided_map, near).cells}
        assert [one.cells for one in requesters] == [wanted] * 2


# --- topics, parameters, the graph --------------------------------------------------------------------


def test_the_list_of_cells_is_latched_and_follows_the_map_whatever_else_is_off(
    domain: RosDomain, peer: RosPeer, served: DaemonProcess, divided_map: DividedMap
) -> None:
    domain.node(served, "-p", "enable_partial_load:=false", "-p", "enable_selected_load:=false")
    metadata = peer.subscribed(*METADATA)

    def checked(message: dict[str, Any]) -> None:
        assert message["header"]["frame_id"] == "map"
        assert message["header"]["stamp"]["sec"] > 0
        now = names(served)
        boxes = {one["cell_id"]: tuple(one["metadata"].values()) for one in message["metadata_list"]}
        files = sorted(divided_map.corners)
        assert list(boxes.items()) == [(now[divided_map.id(one)], divided_map.box(one)) for one in files]

    checked(metadata.next())
    divided_map.remove_cell("0_0.pcd")
    divided_map.change("20_0.pcd", seed=2)
    divided_map.write_metadata()
    reload(served)
    checked(metadata.next())
    checked(peer.subscribed(*METADATA).next())
    services = peer.ask("services_of", *reversed(NODE.rsplit("/", 1)))
    assert not {SERVICES["partial"][1], SERVICES["selected"][1]} & services.keys()


def test_the_whole_map_and_a_coarser_one(
    domain: RosDomain, peer: RosPeer, served: DaemonProcess, divided_map: DividedMap
) -> None:
    domain.node(
        served,
        *(
            "-p",
            "enable_whole_load:=true",
            "-p",
            "enable_downsampled_whole_load:=true",
            "-p",
            "leaf_size:=2.0",
        ),
    )
    cells = expected(divided_map, sorted(divided_map.corners)).cells
    cloud = peer.subscribed(CLOUD, "/map/pointcloud_map").next()
    assert cloud["data"] == b"".join(cell.data for cell in cells)
    assert (cloud["header"]["frame_id"], cloud["point_step"]) == ("map", 16)
    coarse = peer.subscribed(CLOUD, "/map/debug/downsampled_pointcloud_map").next()
    assert 0 < coarse["width"] < cloud["width"]
    whole, part = (
        np.frombuffer(one["data"], np.float32).reshape(one["width"], -1)[:, :3] for one in (cloud, coarse)
    )
    voxels = [np.unique(np.floor(points / 2.0), axis=0) for points in (whole, part)]
    assert len(part) >= len(voxels[0]), "a point in each voxel, of each cell"
    assert {*map(tuple, voxels[1])} <= {*map(tuple, voxels[0])}


@pytest.mark.usefixtures("node")
def test_parameters_are_there_and_cannot_be_set(peer: RosPeer) -> None:
    """``map_height_fitter`` asks for ``enable_partial_load``."""

    def parameters(verb: str, **what: Any) -> Any:
        kind = "".join(word.capitalize() for word in verb.split("_"))
        return peer.client_of(f"rcl_interfaces/srv/{kind}", f"{NODE}/{verb}").call(**what)

    values = parameters("get_parameters", names=["enable_partial_load", "enable_whole_load"])["values"]
    assert [(one["type"], one["bool_value"]) for one in values] == [(1, True), (1, False)]
    given = ["enable_partial_load", "pcd_paths_or_directory", "pcd_metadata_path", "leaf_size", "frame_id"]
    listed = parameters("list_parameters", prefixes=[], depth=0)["result"]["names"]
    assert {*given, "endpoint", "wait", "plain_ids", "enable_downsampled_whole_load"} <= {*listed}
    off = {"name": "enable_partial_load", "value": {"type": 1, "bool_value": False}}
    (result,) = parameters("set_parameters", parameters=[off])["results"]
    assert not result["successful"]


@pytest.mark.usefixtures("node")
def test_it_is_a_node_with_types_that_ros_knows(peer: RosPeer) -> None:
    hashes: dict[str, str] = {}
    for path in environment_folder().glob("share/autoware_map_msgs/*/*.json"):
        found = json.loads(path.read_text())["type_hashes"]
        hashes |= {one["type_name"]: one["hash_string"] for one in found}
    until(lambda: NODE in peer.ask("nodes"))
    for kind, name in SERVICES.values():
        ask = lambda name=name: peer.ask("hashes", f"rr{name}Reply", no_mangle=True)  # noqa: E731
        ((_, found),) = first_answer(ask, bool)
        assert found == hashes[f"{kind}_Response"]
    ((_, found),) = first_answer(lambda: peer.ask("hashes", METADATA[1]), bool)
    assert found == hashes[METADATA[0]]
    space, name = NODE.rsplit("/", 1)
    services = first_answer(lambda: peer.ask("services_of", name, space), lambda some: len(some) > 8)
    for kind, service in SERVICES.values():
        assert services[service] == [kind]
    assert peer.ask("published_by", name, space)[METADATA[1]] == [METADATA[0]]


def test_it_is_started_as_autowares_launch_file_starts_the_loader(
    domain: RosDomain, peer: RosPeer, served: DaemonProcess, divided_map: DividedMap, tmp_path: Path
) -> None:
    """As launch_ros reads the element; with other names, so that remaps are seen to count."""
    parameters = tmp_path / "pointcloud_map_loader.param.yaml"
    parameters.write_text(
        "/**:\n  ros__parameters:\n    enable_whole_load: true\n    enable_downsampled_whole_load: false\n"
        "    enable_partial_load: true\n    enable_selected_load: false\n"
        "    enable_internal_differential_visualization: false\n    leaf_size: 3.0\n"
        f"    pcd_paths_or_directory: [{divided_map.pcd_dir}]\n"
        f"    pcd_metadata_path: {divided_map.root}/x.yaml\n"
    )
    remaps = {
        "__node": "loader",
        "__ns": "/town",
        "output/pointcloud_map": "cloud",
        "output/pointcloud_map_metadata": "metadata",
        "output/debug/downsampled_pointcloud_map": "debug/downsampled_pointcloud_map",
        "service/get_partial_pcd_map": "/other/get_partial",
        "service/get_differential_pcd_map": "/other/get_differential",
        "service/get_selected_pcd_map": "/other/get_selected",
    }
    words = [word for old, new in remaps.items() for word in ("-r", f"{old}:={new}")]
    node = domain.node(served, *words, "--params-file", str(parameters))
    client = peer.client_of(SERVICES["differential"][0], "/other/get_differential")
    near = divided_map.in_square(*NEAR)
    found = client.call(**fields("differential", area=NEAR))
    assert found == answer(served, divided_map, near)
    assert peer.subscribed(CLOUD, "/town/cloud").next()["width"]
    assert len(peer.subscribed(METADATA[0], "/town/metadata").next()["metadata_list"]) == 36
    services = peer.ask("services_of", "loader", "/town")
    assert "/other/get_partial" in services
    assert not any("selected" in name or name.startswith("/map/") for name in services)
    assert node.log.count("pcd_metadata_path") == 1, "they are accepted, and not used"


# --- what waits, and what dies ------------------------------------------------------------------------


@pytest.mark.usefixtures("node")
def test_a_request_for_what_is_in_memory_waits_for_no_other(
    peer: RosPeer, served: DaemonProcess, divided_map: DividedMap
) -> None:
    warm, *cold = sorted(divided_map.corners)
    client, other = peer.client("selected", depth=100), peer.client("selected")
    asks = [fields("selected", ids=[divided_map.id(name)]) for name in cold[:20]]
    for one in (client, other):
        assert one.call(**fields("selected", ids=[divided_map.id(warm)])).cells
    diagnostics = diagnosed(peer)
    loaders = served.stop_loaders()
    numbers = peer.send_all([client] * len(asks), asks)
    first_answer(lambda: waiting(diagnostics), lambda count: count == len(asks))
    assert other.call(**fields("selected", ids=[divided_map.id(warm)])).cells
    assert not {*numbers} & {*peer.ask("answered")}
    for pid in loaders:
        os.kill(pid, signal.SIGCONT)
    for name, number in zip(cold, numbers, strict=False):
        assert client.receive(number) == answer(served, divided_map, [name])


@pytest.mark.usefixtures("node")
def test_clients_that_ask_while_there_is_no_daemon_are_answered_when_it_is_back(
    domain: RosDomain, served: DaemonProcess, divided_map: DividedMap
) -> None:
    peers = [domain.peer() for _ in range(12)]
    clients = [one.client("partial") for one in peers]
    for client in clients:
        client.call(**fields("partial", area=NEAR))
    diagnostics = diagnosed(peers[0])
    diagnostics.next()
    served.kill()
    numbers = [client.send(**fields("partial", area=NEAR)) for client in clients]
    first_answer(lambda: waiting(diagnostics), lambda count: count == len(clients))
    get = peers[0].client_of("rcl_interfaces/srv/GetParameters", f"{NODE}/get_parameters")
    assert get.call(names=["use_sim_time"])["values"], "it needs no daemon for this"
    served.start()
    wanted = answer(served, divided_map, divided_map.in_square(*NEAR))
    for client, number in zip(clients, numbers, strict=True):
        assert client.receive(number) == wanted


@pytest.mark.usefixtures("node")
def test_all_clients_of_a_process_that_ask_at_once_are_answered(
    peer: RosPeer, served: DaemonProcess, divided_map: DividedMap
) -> None:
    """All of them read all answers: with the usual depth of ten, over Fast DDS, most would get none."""
    clients = [peer.client("partial", depth=100) for _ in range(30)]
    for client in clients:
        client.call(**fields("partial", area=(10, 10, 5)))
    numbers = peer.send_all(clients, [fields("partial", area=(10, 10, 5))] * len(clients))
    wanted = answer(served, divided_map, divided_map.in_square(10, 10, 5))
    for client, number in zip(clients, numbers, strict=True):
        assert client.receive(number) == wanted


def test_clients_are_answered_by_the_next_node(peer: RosPeer, node: RosNode) -> None:
    client = peer.client("partial")
    found = client.call(**fields("partial", area=NEAR))
    assert found.cells
    before = peer.servers("partial")
    node.end(signal.SIGKILL)
    node.start()
    peer.wait_other_server("partial", before)
    assert client.call(**fields("partial", area=NEAR)) == found


def test_clients_that_come_and_go_leave_nothing(peer: RosPeer, node: RosNode, served: DaemonProcess) -> None:
    """Each a participant of its own, that asks and leaves."""

    def held() -> tuple[int, int, int]:
        threads, descriptors = (len(os.listdir(f"/proc/{node.pid}/{what}")) for what in ("task", "fd"))
        return threads, descriptors, counters(served)["sessions"]

    def come_and_go(who: str) -> None:
        assert peer.client("partial", who=who).call(**fields("partial", area=NEAR)).cells
        peer.ask("close", who=who)

    client = peer.client("partial", depth=100)
    client.call(**fields("partial", area=NEAR))
    for number in peer.send_all([client] * 40, [fields("partial", area=NEAR)] * 40):
        client.receive(number)  # now each of its threads has been at work
    come_and_go("first")
    before = held()
    for turn in range(30):
        come_and_go(str(turn))
    until(lambda: np.all(np.subtract(held(), before) <= 0), lambda: f"{held()}, before {before}")


# --- its end ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_it_ends_while_requests_wait(
    peer: RosPeer, node: RosNode, served: DaemonProcess, number: signal.Signals
) -> None:
    client = peer.client("partial", depth=100)
    assert client.call(**fields("partial", area=NEAR)).cells
    diagnostics = diagnosed(peer)
    loaders = served.stop_loaders()
    peer.send_all([client] * 20, [fields("partial", area=(0, 0, 1e3))] * 20)
    first_answer(lambda: waiting(diagnostics), lambda count: count == 20)
    assert (node.end(number), "Traceback" in node.log) == (0, False), node.log
    for pid in loaders:
        os.kill(pid, signal.SIGCONT)


INTERRUPTED = """
import os, signal, sys
from _signal import signal as signal_of_c
from shmmap_clients.ros_node import cli

interrupt_at, count = int(sys.argv.pop(1)), 0

def watch(frame, event, what):
    global count
    count += count > 0 or (event == "c_return" and what is signal_of_c)  # its first line
    is_up = event == "call" and frame.f_code.co_name == "spin_once"
    if is_up or count == interrupt_at:
        sys.setprofile(None)
        print(count, flush=True)
        os.kill(os.getpid(), signal.SIGINT)

sys.setprofile(watch)
sys.exit(cli.main(sys.argv[1:]))
"""


def test_it_may_be_interrupted_while_it_starts(domain: RosDomain, served: DaemonProcess) -> None:
    """At ten places, from its first line to where it serves; Fast DDS is kept off /dev/shm."""

    def interrupted(at: int) -> int:
        words = ["-c", INTERRUPTED, str(at), "--ros-args", "-p", f"endpoint:={served.endpoint}"]
        environment = {**domain.environment, "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4"}
        command = [str(domain.python), *words]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120)
        assert (done.returncode, "Traceback" in done.stderr) == (0, False), (at, done.stderr)
        return int(done.stdout)

    last = interrupted(10**9)
    for part in range(9):
        interrupted(1 + part * last // 9)
