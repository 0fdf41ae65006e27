# SPDX-License-Identifier: Apache-2.0
"""``shmmap-ros-bridge`` while daemons, bridges and clients die, and among incompatible peers."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import struct
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("cyclonedds", reason="needs the package cyclonedds")

from shmmap_clients.ros_bridge.messages import DIFFERENTIAL, PARTIAL, SELECTED, AreaInfo
from shmmap_clients.ros_bridge.parameters import PARAMETER_SERVICES

from tests.process.conftest import DaemonFactory
from tests.support.bridge_process import PROGRAM, BridgeProcess, bridge_environment, built_fast_peer
from tests.support.daemon_process import DaemonProcess, stop
from tests.support.divided_map import DividedMap, make_map
from tests.support.ros.replies import from_message, path_of
from tests.support.ros_peer import NAMES, RosPeer, asked, reload

CLIENTS = int(os.environ.get("SHMMAP_TEST_ROS_CLIENTS", "40"))
"""How many clients come and go; the full number is 1000."""


def threads_and_files(pid: int) -> tuple[int, int]:
    return len(os.listdir(f"/proc/{pid}/task")), len(os.listdir(f"/proc/{pid}/fd"))


# --- deaths -------------------------------------------------------------------------------------------


def test_clients_are_answered_again_when_the_daemon_is_back(
    bridge: BridgeProcess, served: DaemonProcess, peer: RosPeer
) -> None:
    """Who asked meanwhile gets its answer, and one that has gone is not waited for."""
    client = peer.client(NAMES["differential"], DIFFERENTIAL)
    area = AreaInfo(0.0, 0.0, 15.0)
    before = from_message(client.call(area=area, cached_ids=[]))
    served.kill()
    gone = peer.client(NAMES["partial"], PARTIAL)
    gone.wait_for_service()
    gone.send(area=area)
    bridge.wait_said("requests wait")
    number = client.send(area=area, cached_ids=before.ids[:1])
    parameters = peer.client(
        "/map/pointcloud_map_loader/get_parameters", PARAMETER_SERVICES["get_parameters"]
    )
    assert parameters.call(names=["use_sim_time"]).values, "it needs no daemon for this"
    gone.close()
    served.start()
    after = from_message(client.receive(number))
    assert after.cells == before.cells[1:]
    bridge.wait_said("answered again")


def test_clients_are_answered_again_by_the_next_bridge(
    served: DaemonProcess, dds: int, peer: RosPeer, divided_map: DividedMap
) -> None:
    """Killed or ended, while the map changes: the ids of a client say what it has."""
    client = peer.client(NAMES["differential"], DIFFERENTIAL)
    area = AreaInfo(0.0, 0.0, 15.0)
    with BridgeProcess(served, dds) as bridge:
        ids = from_message(client.call(area=area, cached_ids=[])).ids
        for seed, end in enumerate((bridge.kill, bridge.stop)):
            end()
            divided_map.change(Path(path_of(ids[1])).name, seed=seed)
            reload(served)
            bridge.start()
            number = client.send(
                area=area, cached_ids=ids
            )  # before it is found: a client knows nothing of it
            again = client.call(area=area, cached_ids=ids)
            assert again.number > number
            found = from_message(again)
            assert found.removed == ids[1:2]
            assert path_of(*found.ids) == path_of(ids[1])
            ids[1:2] = found.ids
            assert from_message(client.call(area=area, cached_ids=ids)).ids == []


ENDED_ANYWHERE = """
import signal, sys
from shmmap_clients.ros_bridge import cli
from shmmap_clients.ros_bridge.node import RosBridge

def end(frame, event, _):
    callers = []
    while frame is not None:
        callers.append(frame.f_code)
        frame = frame.f_back
    is_handling = RosBridge.stop.__code__ in callers or any(one.co_name == "<lambda>" for one in callers)
    if RosBridge.run.__code__ in callers and not is_handling:
        signal.raise_signal(signal.SIGTERM)

sys.setprofile(end)
sys.exit(cli.main(sys.argv[1:]))
"""


def test_a_signal_may_come_at_any_place(served: DaemonProcess, dds: int) -> None:
    """Here at each call of the thread that waits for it: no lock may be taken twice."""
    done = subprocess.run(
        [sys.executable, "-c", ENDED_ANYWHERE, "--endpoint", served.endpoint, "--domain", str(dds)],
        capture_output=True,
        text=True,
        timeout=240,
        env=bridge_environment(),
    )
    assert (done.returncode, "ready:" in done.stderr) == (0, True), done.stderr


def test_one_bridge_a_domain(bridge: BridgeProcess, served: DaemonProcess, dds: int) -> None:
    words = [*PROGRAM, "--endpoint", served.endpoint, "--domain", str(dds)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60, env=bridge_environment())
    assert done.returncode == 75
    assert "another bridge of this daemon runs in this domain" in done.stderr
    assert bridge.process is not None
    assert bridge.process.poll() is None


def test_clients_that_come_and_go_leave_nothing(bridge: BridgeProcess, peer: RosPeer) -> None:
    """Each a participant of its own, that asks and leaves."""
    area = AreaInfo(0.0, 0.0, 15.0)
    asked(peer, "partial", area=(0, 0, 5))
    bridge.wait_status(clients=0)
    before = threads_and_files(bridge.pid)
    for _ in range(CLIENTS):
        with peer.another() as one:
            client = one.client(NAMES["differential"], DIFFERENTIAL)
            assert client.call(area=area, cached_ids=[]).new_pointcloud_with_ids
    bridge.wait_status(clients=0)
    assert threads_and_files(bridge.pid) == before


# --- incompatible peers -------------------------------------------------------------------------------


def test_nonsense_harms_no_client(bridge: BridgeProcess, dds: int, peer: RosPeer, tmp_path: Path) -> None:
    """What is no request, has lengths beyond its end, or texts that are none."""
    program = built_fast_peer(tmp_path)
    if program is None:
        pytest.skip("needs libfastrtps-dev g++")
    head = b"\0\1\0\0" + struct.pack("<Qq", 7, 1)
    area = struct.pack("<3f", 0.0, 0.0, 15.0)
    nonsense = [
        head,
        head + area,
        head + area + struct.pack("<I", 2**32 - 1),
        head + area + struct.pack("<II", 1, 2**31),
        head + area + struct.pack("<II", 1, 4) + b"\xff\xfe\xfd\0",
        head + area + struct.pack("<II", 1, 0),
        head + area + struct.pack("<I", 10**6) + struct.pack("<I", 1) * 4,
        head + area + struct.pack("<II", 1, 3) + b"abc",
        b"\0\3\0\0" + head[4:] + area + bytes(4),
        b"\0\0\0\0" + struct.pack(">Qq3fI", 7, 1, 0.0, 0.0, 15.0, 0),
        b"\0\1\0\0",
        bytes(range(256)) * 40,
    ]
    words = [str(program), str(dds), "raw", NAMES["differential"], *(one.hex() for one in nonsense)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=120, env=bridge_environment())
    assert (done.returncode, done.stdout) == (0, "end\n"), done.stderr
    ids = ["\u2028", "", "a" * 100_000]
    found = asked(peer, "differential", area=(3e38, -3e38, 3e38), ids=ids)
    assert found.removed == ids
    assert len(asked(peer, "partial", area=(0, 0, 5)).cells) == 4


def test_a_flood_of_requests_keeps_no_client_out(bridge: BridgeProcess, peer: RosPeer) -> None:
    flood = peer.client(NAMES["partial"], PARTIAL)
    flood.wait_for_service()
    for _ in range(300):
        flood.send(area=AreaInfo(0.0, 0.0, 1e6))
    assert len(asked(peer, "selected", ids=[]).cells) == 0


def test_what_is_more_than_the_daemon_takes_at_once(bridge: BridgeProcess, peer: RosPeer) -> None:
    """Ids in slices, of the known ones: never an empty answer for a full one, and no other client waits."""
    everything = asked(peer, "partial", area=(0, 0, 1e6))
    known, unknown = everything.ids, [f"/nowhere/{number:080}.pcd" for number in range(60_000)]
    assert sum(map(len, unknown)) > 4 << 20
    few = [f"{number}.pcd" for number in range(25_000)]
    for more in (few, unknown):
        assert asked(peer, "selected", ids=[*more, *known, known[0]]).ids == [*known, known[0]]
        found = asked(peer, "differential", area=(0, 0, 5), ids=[*more, *known[1:]])
        near = asked(peer, "partial", area=(0, 0, 5)).ids
        assert found.removed == [one for one in (*more, *known[1:]) if one not in set(near)]
        assert found.ids == [one for one in near if one == known[0]]


def test_a_request_whose_cells_do_not_come_holds_up_no_other(
    bridge: BridgeProcess, served: DaemonProcess, peer: RosPeer, divided_map: DividedMap
) -> None:
    """Its loaders stand still: requests for what is in memory are answered meanwhile."""
    warm = asked(peer, "partial", area=(-50, -50, 2))
    assert warm.ids
    loaders = served.stop_loaders()
    slow = peer.client(NAMES["partial"], PARTIAL)
    slow.wait_for_service()
    number = slow.send(area=AreaInfo(50.0, 50.0, 2.0))
    for _ in range(3):
        assert asked(peer, "partial", area=(-50, -50, 2)).ids == warm.ids
    for pid in loaders:
        os.kill(pid, signal.SIGCONT)
    assert from_message(slow.receive(number)).ids


def test_a_client_that_has_stopped_holds_up_no_other(
    daemon: DaemonFactory, dds: int, peer: RosPeer, tmp_path: Path
) -> None:
    """All clients of a service read the same replies; one that has stopped acknowledges none of them."""
    town = make_map(tmp_path / "large", columns=2, rows=2, points=20_000)
    with BridgeProcess(daemon(town.root), dds):
        words = [sys.executable, "-m", "tests.support.ros_peer", str(dds)]
        pipe = subprocess.PIPE
        with subprocess.Popen(
            words, stdin=pipe, stdout=pipe, text=True, env=bridge_environment()
        ) as listener:
            assert listener.stdout is not None
            assert listener.stdout.readline() == "4\n"
            stop(listener.pid)
            try:
                for _ in range(20):
                    assert len(asked(peer, "partial", area=(0, 0, 5)).cells) == 4
            finally:
                os.kill(listener.pid, signal.SIGCONT)
                listener.communicate()


def test_incompatible_peers_are_logged_once_and_named_by_doctor(
    bridge: BridgeProcess, served: DaemonProcess, dds: int, peer: RosPeer, tmp_path: Path
) -> None:
    program = built_fast_peer(tmp_path)
    if program is None:
        pytest.skip("needs libfastrtps-dev g++")
    doctor = [
        sys.executable, "-m", "shmmap.cli", "doctor", "--json", "--endpoint", served.endpoint,
        "--shm-dir", served.shm_dir,
    ]  # fmt: skip

    def finding() -> dict[str, str]:
        done = subprocess.run(doctor, capture_output=True, text=True, timeout=60, env=bridge_environment())
        (found,) = (one for one in json.loads(done.stdout)["findings"] if one["name"] == "ROS bridge")
        return dict(found)

    assert finding()["state"] == "ok"
    words = [str(program), str(dds), "incompatible", NAMES["partial"]]
    pipe = subprocess.PIPE
    with subprocess.Popen(words, stdin=pipe, stdout=pipe, text=True, env=bridge_environment()) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "matched\n"
        bridge.wait_status(incompatible=[{"service": NAMES["partial"], "vendor": "Fast DDS"}])
        found = finding()
        assert found["state"] == "warn"
        assert f"1 client of {NAMES['partial']}, of Fast DDS" in found["fact"]
        assert "RMW_IMPLEMENTATION=rmw_cyclonedds_cpp" in found["advice"]
        assert len(asked(peer, "partial", area=(0, 0, 5)).cells) == 4
        other.communicate()
    bridge.wait_status(incompatible=[])
    assert bridge.log.count("is no node of rmw_cyclonedds_cpp") == 1
    assert finding()["state"] == "ok"
    bridge.kill()
    assert finding()["fact"] == "none runs"
    with contextlib.suppress(FileNotFoundError):
        Path(served.runtime_dir, f"{served.instance}.ros-bridge-{dds}.json").unlink()


def test_a_client_without_a_name_is_answered(bridge: BridgeProcess, peer: RosPeer) -> None:
    """As rmw_cyclonedds_cpp answers one: it may be an old one of its own."""
    client = peer.client(NAMES["selected"], SELECTED, client_id="")
    assert client.call(cell_ids=[]).new_pointcloud_with_ids == []
    bridge.wait_said("is no node of rmw_cyclonedds_cpp, speaks CycloneDDS")
