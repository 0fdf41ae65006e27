# SPDX-License-Identifier: Apache-2.0
"""``shmmap-ros-bridge`` against real daemons, asked by clients of three implementations of DDS."""

from __future__ import annotations

import math
import re
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("cyclonedds", reason="needs the package cyclonedds")

from cyclonedds.qos import Policy
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from shmmap_clients.ros_bridge.live_worker import LIVE_SERVICES
from shmmap_clients.ros_bridge.messages import (
    DIFFERENTIAL,
    PARTIAL,
    SELECTED,
    AreaInfo,
    MapMetaData,
    PointCloud2,
)
from shmmap_clients.ros_bridge.parameters import PARAMETER_SERVICES
from shmmap_clients.ros_bridge.type_hashes import type_hash

from tests.process.conftest import DaemonFactory
from tests.support.bridge_process import (
    PROGRAM,
    BridgeProcess,
    bridge_environment,
    built_cyclone_peer,
    built_fast_peer,
)
from tests.support.daemon_process import DaemonProcess, until
from tests.support.divided_map import DividedMap
from tests.support.pages import read_page
from tests.support.ros.replies import Reply, expected, from_lines, from_message, path_of
from tests.support.ros_peer import KINDS, NAMES, RosPeer, asked, reload, service_qos

Ask = Callable[..., Reply]


@pytest.fixture(scope="module")
def programs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path | None]:
    folder = tmp_path_factory.mktemp("peers")
    return {"cyclone": built_cyclone_peer(folder), "fast": built_fast_peer(folder)}


@pytest.fixture(params=["python", "cyclone", "fast"])
def ask(request: pytest.FixtureRequest, dds: int, programs: dict[str, Path | None]) -> Ask:
    """Ask a service by one of the peers."""
    if request.param == "python":
        peer = request.getfixturevalue("peer")
        return lambda verb, **what: asked(peer, verb, **what)
    program = programs[request.param]
    if program is None:
        packages = {"cyclone": "cyclonedds-dev cyclonedds-tools gcc", "fast": "libfastrtps-dev g++"}
        pytest.skip(f"needs {packages[request.param]}")

    def run(verb: str, *, area: Sequence[float] = (), ids: Sequence[str] = ()) -> Reply:
        words = [str(program), str(dds), verb, NAMES[verb], *(repr(float(one)) for one in area), *ids]
        done = subprocess.run(words, capture_output=True, text=True, timeout=120, env=bridge_environment())
        assert done.returncode == 0, done.stderr
        return from_lines(done.stdout)

    return run


def in_order(town: DividedMap, wanted: Callable[[tuple[float, ...]], bool]) -> list[str]:
    """Names of the cells, in the order of their ids."""
    names = sorted(town.corners, key=town.id)
    return [name for name in names if wanted(town.box(name))]


# --- what is answered ---------------------------------------------------------------------------------


@pytest.mark.usefixtures("bridge")
def test_three_services_to_the_byte(ask: Ask, divided_map: DividedMap) -> None:
    near = in_order(
        divided_map, lambda box: box[0] - 15 <= 3 <= box[2] + 15 and box[1] - 15 <= -4 <= box[3] + 15
    )
    assert 4 <= len(near) < len(divided_map.corners)
    found = ask("partial", area=(3, -4, 15))
    assert found.plain == expected(divided_map, near)
    (far,) = ask("selected", ids=[divided_map.id("40_40.pcd")]).ids
    has = [found.ids[1], "gone.pcd", far, found.ids[2], divided_map.id(near[3])]
    left = [name for name in near if name not in near[1:3]]
    removed = [has[1], has[2], has[4]]
    assert ask("differential", area=(3, -4, 15), ids=has).plain == expected(divided_map, left, removed)
    wanted = ["40_40.pcd", near[0], "40_40.pcd"]
    ids = [far, "unknown", divided_map.id(near[0]), far]
    assert ask("selected", ids=ids).plain == expected(divided_map, wanted)
    assert ask("selected", ids=[]) == expected(divided_map, [])


def test_endpoints_have_the_hashes_of_their_types(bridge: BridgeProcess, peer: RosPeer) -> None:
    """In their user data, where ROS reads them."""
    client = peer.client(NAMES["partial"], PARTIAL)
    client.wait_for_service()
    (reader,) = client.writer.get_matched_subscriptions()
    (writer,) = client.reader.get_matched_publications()
    for kind, endpoint in (
        (PARTIAL.request, client.writer.get_matched_subscription_data(reader)),
        (PARTIAL.reply, client.reader.get_matched_publication_data(writer)),
    ):
        said = endpoint.qos[Policy.Userdata].data.decode()
        assert re.fullmatch(r"serviceid=[0-9a-f.]+;" + re.escape(type_hash(kind)), said), said
    reader = DataReader(
        peer.participant,
        Topic(peer.participant, "rt/map/pointcloud_map_metadata", MapMetaData),
        service_qos(latched=True, depth=1),
    )
    until(reader.get_matched_publications)
    (writer,) = reader.get_matched_publications()
    said = reader.get_matched_publication_data(writer).qos[Policy.Userdata].data.decode()
    assert said == type_hash(MapMetaData)


@pytest.mark.usefixtures("bridge")
def test_areas_that_make_no_sense_are_answered_as_autoware_does(
    peer: RosPeer, divided_map: DividedMap
) -> None:
    everything = in_order(divided_map, lambda _: True)
    inside = in_order(
        divided_map, lambda box: box[0] + 5 <= 10 <= box[2] - 5 and box[1] + 5 <= 10 <= box[3] - 5
    )
    assert inside == ["0_0.pcd"]
    paths = [divided_map.id("0_0.pcd"), divided_map.id("20_0.pcd")]
    has = [*asked(peer, "selected", ids=paths).ids, "x"]
    for area, names in {
        (0.0, 0.0, math.inf): everything,
        (math.nan, 0.0, 100.0): [],
        (0.0, 0.0, math.nan): [],
        (10.0, 10.0, -5.0): inside,
        (10.0, 10.0, -11.0): [],
    }.items():
        ids = asked(peer, "partial", area=area).ids
        assert [path_of(one) for one in ids] == [divided_map.id(name) for name in names], area
        found = asked(peer, "differential", area=area, ids=has)
        assert found.ids == [one for one in ids if one not in has], area
        assert found.removed == [one for one in has if one not in ids], area


def test_points_have_the_fields_of_the_file(
    daemon: DaemonFactory, dds: int, peer: RosPeer, tmp_path: Path
) -> None:
    """x y z alone are 12 bytes; other types stay as they are, without gaps."""
    town = DividedMap(tmp_path / "map")
    town.pcd_dir.mkdir(parents=True)
    random = np.random.default_rng(1)
    plain = {axis: random.uniform(0, 20, 100).astype("<f4") for axis in "xyz"}
    town.write_cell("0_0.pcd", (0, 0), plain)
    ring, intensity = random.integers(0, 64, 100).astype("u1"), random.uniform(0, 1, 100).astype("<f4")
    town.write_cell("20_0.pcd", (20, 0), {**plain, "ring": ring, "intensity": intensity})
    town.write_metadata()
    with BridgeProcess(daemon(town.root), dds):
        found = asked(peer, "partial", area=(20, 10, 5))
    assert found.plain == expected(town, ["0_0.pcd", "20_0.pcd"])
    assert [cell.shape[3] for cell in found.cells] == [12, 17]


def test_a_changed_cell_comes_once_to_each_client(
    bridge: BridgeProcess, served: DaemonProcess, peer: RosPeer, divided_map: DividedMap
) -> None:
    """Under a new id; over a restart of the bridge, too."""
    clients = [peer.client(NAMES["differential"], DIFFERENTIAL) for _ in range(2)]
    area = AreaInfo(3.0, -4.0, 15.0)
    ids = from_message(clients[0].call(area=area, cached_ids=[])).ids
    file = Path(path_of(ids[0])).name
    divided_map.change(file, seed=5)
    reload(served)
    for client, restart in zip(clients, (False, True), strict=True):
        if restart:
            bridge.kill()
            bridge.start()
        found = from_message(client.call(area=area, cached_ids=ids))
        assert found.removed == ids[:1]
        assert found.ids != ids[:1]
        assert found.plain.cells == expected(divided_map, [file]).cells
        again = from_message(client.call(area=area, cached_ids=[*ids[1:], *found.ids]))
        assert (again.ids, again.removed) == ([], []), "once"


def test_ids_as_autoware_s(served: DaemonProcess, dds: int, peer: RosPeer, divided_map: DividedMap) -> None:
    """Without versions, where it is asked for: then a change goes unnoticed."""
    with BridgeProcess(served, dds, "--plain-ids"):
        near = in_order(divided_map, lambda box: box[:2] == (0, 0))
        assert asked(peer, "selected", ids=[divided_map.id(near[0])]) == expected(divided_map, near)
        found = asked(peer, "partial", area=(3, -4, 15))
        listed = peer.latched("/map/pointcloud_map_metadata", MapMetaData)
        assert set(found.ids) < {one.cell_id for one in listed.metadata_list}
        divided_map.change("0_0.pcd", seed=5)
        reload(served)
        assert asked(peer, "differential", area=(3, -4, 15), ids=[*found.ids, "x"]).removed == ["x"]


def test_a_cell_that_cannot_be_loaded_is_left_out_and_logged(
    bridge: BridgeProcess, peer: RosPeer, divided_map: DividedMap
) -> None:
    Path(divided_map.id("0_0.pcd")).write_bytes(b"this is no cloud")
    found = asked(peer, "partial", area=(10, 10, 5))
    assert found.ids == []
    bridge.wait_said("left out of an answer")


# --- topics and parameters ----------------------------------------------------------------------------


def test_the_list_of_cells_is_latched_and_follows_the_map(
    bridge: BridgeProcess, served: DaemonProcess, peer: RosPeer, divided_map: DividedMap
) -> None:
    listed = peer.latched("/map/pointcloud_map_metadata", MapMetaData)
    assert listed.header.frame_id == "map"
    assert listed.header.stamp.sec > 0
    names = [one.cell_id for one in listed.metadata_list]
    assert asked(peer, "selected", ids=names).ids == names
    listed_cells = {path_of(one.cell_id): one.metadata for one in listed.metadata_list}
    assert list(listed_cells) == sorted(divided_map.id(name) for name in divided_map.corners)
    for name in divided_map.corners:
        box = listed_cells[divided_map.id(name)]
        assert (box.min_x, box.min_y, box.max_x, box.max_y) == divided_map.box(name)
    divided_map.remove_cell("0_0.pcd")
    divided_map.write_metadata()
    reload(served)
    reader = peer.following("/map/pointcloud_map_metadata", MapMetaData)
    assert any(len(one.metadata_list) == len(listed_cells) - 1 for one in reader)


def test_the_whole_map_is_one_cloud_where_it_is_asked_for(
    served: DaemonProcess, dds: int, peer: RosPeer, divided_map: DividedMap
) -> None:
    with BridgeProcess(served, dds, "--whole-map"):
        cloud = peer.latched("/map/pointcloud_map", PointCloud2)
    cells = expected(divided_map, in_order(divided_map, lambda _: True)).cells
    assert bytes(cloud.data) == b"".join(cell.data for cell in cells)
    assert (cloud.header.frame_id, cloud.point_step, cloud.width) == (
        "map",
        16,
        sum(c.shape[1] for c in cells),
    )
    size = len(cloud.data)
    words = [*PROGRAM, "--endpoint", served.endpoint, "--domain", str(dds), "--whole-map"]
    done = subprocess.run(
        [*words, "--whole-map-limit", "0.0001"],
        capture_output=True,
        text=True,
        timeout=60,
        env=bridge_environment(),
    )
    assert done.returncode == 2
    listed_cells = float(done.stderr.split("takes about ")[1].split(" GB")[0])
    assert listed_cells == pytest.approx(size / 1e9, rel=0.1)
    assert "0.0001 GB is the most" in done.stderr


def test_parameters_are_there_and_cannot_be_set(
    bridge: BridgeProcess, peer: RosPeer, divided_map: DividedMap
) -> None:
    from shmmap_clients.ros_bridge.parameters import Parameter, ParameterValue

    clients = {
        name: peer.client(f"/map/pointcloud_map_loader/{name}", kind)
        for name, kind in PARAMETER_SERVICES.items()
    }
    names = ["enable_partial_load", "pcd_paths_or_directory"]
    partial, paths = clients["get_parameters"].call(names=names).values
    assert (partial.type, partial.bool_value) == (1, True)
    assert (paths.type, paths.string_array_value) == (9, [str(divided_map.root)])
    assert clients["get_parameters"].call(names=["enable_partial_load", "nothing"]).values == []
    assert list(clients["get_parameter_types"].call(names=names).types) == [1, 9]
    listed = clients["list_parameters"].call(prefixes=[], depth=0).result
    assert names[0] in listed.names
    described = clients["describe_parameters"].call(names=names).descriptors
    assert [(one.name, one.type, one.read_only) for one in described] == [
        (names[0], 1, True),
        (names[1], 9, True),
    ]
    off = ParameterValue(1, False, 0, 0.0, "", [], [], [], [], [])
    results = (
        clients["set_parameters"].call(parameters=[Parameter(names[0], off), Parameter("x", off)]).results
    )
    assert [one.successful for one in results] == [False, False]
    assert "read-only" in results[0].reason
    assert "was not declared" in results[1].reason
    result = clients["set_parameters_atomically"].call(parameters=[Parameter(names[0], off)]).result
    assert (result.successful, "read-only" in result.reason) == (False, True)
    assert clients["get_parameters"].call(names=names[:1]).values[0].bool_value


def test_other_names(served: DaemonProcess, dds: int, peer: RosPeer) -> None:
    options = [
        "--namespace",
        "/town",
        "--node",
        "loader",
        "--name",
        "partial=near",
        "--name",
        "selected=/by_id",
    ]
    with BridgeProcess(served, dds, *options) as bridge:
        assert peer.client("/town/near", PARTIAL).call(area=AreaInfo(0, 0, 5)).new_pointcloud_with_ids
        assert peer.client("/by_id", SELECTED).call(cell_ids=[]).new_pointcloud_with_ids == []
        assert peer.client("/town/loader/get_parameters", PARAMETER_SERVICES["get_parameters"]).call(names=[])
        assert bridge.status["node"] == "/town/loader"


def test_the_page_is_true(served: DaemonProcess, dds: int, peer: RosPeer) -> None:
    """Its command starts a bridge, and every service and topic that it names is there."""
    page = read_page("clients/shmmap_clients/ros_bridge/ROS_BRIDGE.md")
    (command,) = page.commands("bridge")
    program, *words = command.split()
    assert program == "shmmap-ros-bridge"
    assert words == ["--domain", "0"], "replaced here by the test's own"
    listed = set(re.findall(r"`(/map/get_\w+)`", page.text))
    assert listed == set(NAMES.values())
    with BridgeProcess(served, dds):
        for verb, name in NAMES.items():
            peer.client(name, KINDS[verb]).wait_for_service()
        assert peer.latched("/map/pointcloud_map_metadata", MapMetaData)
    for name in ("/map/pointcloud_map", *LIVE_SERVICES, "occupied_voxels", "free_voxels"):
        assert f"{name}`" in page.text, name
