# SPDX-License-Identifier: Apache-2.0
"""``shmmap-ndt follow --topic`` as a node of ROS 2: scans, guesses, poses, a transform."""

from __future__ import annotations

import json
import shlex
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest
from numpy.typing import NDArray
from shmmap_clients.scans.trajectory import matrix_of, quaternion_of, read_trajectory

from tests.process.conftest import DaemonFactory
from tests.support.daemon_process import DaemonProcess
from tests.support.forked_programs import run_verb
from tests.support.ndt_programs import TownDrive, make_town_drive
from tests.support.pages import read_page
from tests.support.ros.processes import Publication, RosDomain, RosPeer, RosProgram

FRAMES: Final = 24
MODULE: Final = "shmmap_clients.ndt_scan_matcher"
MOUNTED: Final = matrix_of((0.9, -0.1, 1.7), (0.01, -0.02, 0.6, 0.8))  # T_base_link_lidar
ODOM: Final = matrix_of((-40.0, 7.0, 0.5), (0.0, 0.0, 0.6, 0.8))  # T_odom_map
# the drive is 6 m long: the first map is the last
WINDOW: Final = ["--map-radius", "200", "--lidar-radius", "80", "--update-distance", "100", "--thin", "0.5"]
CLOUD: Final = "sensor_msgs/msg/PointCloud2"
POSE: Final = "geometry_msgs/msg/PoseWithCovarianceStamped"
TF: Final = "tf2_msgs/msg/TFMessage"
(COMMAND,) = read_page("clients/README.md").commands("topic")
PROGRAM, VERB, OPTION, TOPIC, *OPTIONS = shlex.split(COMMAND)
assert (PROGRAM, VERB, OPTION) == ("shmmap-ndt", "follow", "--topic")


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> TownDrive:
    """Scans of the vehicle's frame, as the transform of those of the scanner gives them."""
    made = make_town_drive(
        tmp_path_factory.mktemp("drive"), blocks=(3, 3), density=5.0, frames=FRAMES, step=0.25
    )
    back = np.linalg.inv(MOUNTED)
    (made.scans.parent / "lidar").mkdir()
    for path in made.scans.iterdir():
        seen = (np.load(path)["xyz"] @ back[:3, :3].T + back[:3, 3]).astype(np.float32)
        np.save(made.scans.parent / "lidar" / path.stem, seen)
        np.savez(path, xyz=(seen @ MOUNTED[:3, :3].T + MOUNTED[:3, 3]).astype(np.float32))
    return made


def header(stamp_ns: int, frame: str) -> dict[str, Any]:
    return {"stamp": {"sec": stamp_ns // 10**9, "nanosec": stamp_ns % 10**9}, "frame_id": frame}


def rigid(T: NDArray[np.float64], place: str, turn: str) -> dict[str, Any]:
    """The fields of a pose or a transform."""
    xyz, q = map(float, T[:3, 3]), map(float, quaternion_of(T[:3, :3]))
    return {place: dict(zip("xyz", xyz, strict=True)), turn: dict(zip("xyzw", q, strict=True))}


def edge(parent: str, child: str, T: NDArray[np.float64], stamp_ns: int = 0) -> dict[str, Any]:
    """The fields of a message with one transform."""
    moved = rigid(T, "translation", "rotation")
    one = {"header": header(stamp_ns, parent), "child_frame_id": child, "transform": moved}
    return {"transforms": [one]}


def matrix(fields: dict[str, Any], place: str, turn: str) -> NDArray[np.float64]:
    return matrix_of(fields[place].values(), (fields[turn][axis] for axis in "xyzw"))


def arrives(topic: Any, fits: Callable[[Any], bool]) -> Any:
    """Return the first message that fits."""
    while not fits(message := topic.next()):
        pass
    return message


def stamp_ns(message: dict[str, Any]) -> int:
    stamp = message["header"]["stamp"]
    return int(stamp["sec"] * 10**9 + stamp["nanosec"])


def lines_of(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


class Vehicle:
    """A peer with a scanner on a vehicle, and the program that localizes it."""

    def __init__(
        self, domain: RosDomain, daemon: DaemonProcess, drive: TownDrive, folder: Path, *words: str
    ) -> None:
        self.peer: RosPeer = domain.peer()
        self.drive, self.folder = drive, folder
        self.truth = read_trajectory(drive.truth).T_map_sensor
        static = self.peer.advertised(TF, "/tf_static", latched=True)
        static.send(**edge("base_link", "lidar", MOUNTED))
        self.scans: Publication = self.peer.advertised(CLOUD, TOPIC)
        self.guesses: Publication = self.peer.advertised(POSE, "/initialpose")
        self.poses = self.peer.subscribed(POSE, "/ndt_pose_with_covariance", latched=False)
        given = ["--endpoint", daemon.endpoint, "--shm-dir", daemon.shm_dir, *WINDOW, "--min-range", "0"]
        given += ["--topic", TOPIC, "--json", "--json-lines", str(folder / "lines")]
        program = [MODULE, "follow", *given, *words]
        self.program = RosProgram(domain, program, output=folder / "summary", numba=True)

    def scan(self, number: int, send: Callable[..., None] | None = None) -> None:
        """Publish a scan."""
        xyz = np.load(self.drive.scans.parent / "lidar" / f"scan_{number:04}.npy")
        fields = [
            {"name": name, "offset": 4 * place, "datatype": 7, "count": 1} for place, name in enumerate("xyz")
        ]
        (send or self.scans.send)(
            header=header(number * 10**8, "lidar"),
            height=1,
            width=len(xyz),
            fields=fields,
            point_step=12,
            row_step=12 * len(xyz),
            data=xyz.tobytes(),
            is_dense=True,
        )

    def guess(self, T: NDArray[np.float64], frame: str = "map") -> None:
        """Publish a pose on ``/initialpose``."""
        self.guesses.send(header=header(0, frame), pose={"pose": rigid(T, "position", "orientation")})

    def begin(self, number: int = 0) -> None:
        """Have scans reach the program, which only takes them after the guess."""
        self.scan(FRAMES - 1, self.scans.repeat)
        self.program.wait_said(f"scans of {TOPIC} come in frame 'lidar'")
        self.scans.rest()
        self.guess(self.truth[number])
        self.program.wait_said("localizes from the pose on /initialpose")

    def pose(self, number: int) -> NDArray[np.float64]:
        """Wait for the pose of a scan."""
        message = arrives(self.poses, lambda one: stamp_ns(one) == number * 10**8)
        assert message["header"]["frame_id"] == "map"
        assert message["pose"]["covariance"][0] > 0
        return matrix(message["pose"]["pose"], "position", "orientation")

    def end(self, number: signal.Signals = signal.SIGINT) -> dict[str, Any]:
        """End the program as Ctrl-C does; returns its summary."""
        assert self.program.end(number) == 0, self.program.log
        assert "Traceback" not in self.program.log
        summary: dict[str, Any] = json.loads((self.folder / "summary").read_text())
        return summary


def test_poses_are_those_of_files(
    domain: RosDomain, daemon: DaemonFactory, drive: TownDrive, tmp_path: Path
) -> None:
    """From the guess on, scan by scan; with the transform that makes the vehicle's pose of its odometry."""
    one = daemon(drive.map_dir)
    assert "--publish-tf" in OPTIONS
    vehicle = Vehicle(domain, one, drive, tmp_path, *OPTIONS)
    seen = vehicle.peer.subscribed(TF, "/tf", latched=False)
    moving = vehicle.peer.advertised(TF, "/tf")
    clock = vehicle.peer.advertised("rosgraph_msgs/msg/Clock", "/clock")
    vehicle.begin()
    found = []
    for number in range(FRAMES):
        T_odom_base = ODOM @ vehicle.truth[number]
        moving.send(**edge("odom", "base_link", T_odom_base, number * 10**8))
        clock.send(clock=header(number * 10**8, "")["stamp"])
        vehicle.scan(number)
        found.append(vehicle.pose(number))
        (moved,) = arrives(seen, lambda one: one["transforms"][0]["child_frame_id"] == "odom")["transforms"]
        assert stamp_ns(moved) == number * 10**8
        assert moved["header"]["frame_id"] == "map"
        T_map_odom = matrix(moved["transform"], "translation", "rotation")
        np.testing.assert_allclose(T_map_odom @ T_odom_base, found[-1], atol=1e-9)
    moving.send(**edge("world", "odom", np.eye(4), 10**9))
    vehicle.program.wait_said("another node publishes the transform from world to odom")
    summary = vehicle.end()
    assert summary["frames"] == summary["trustworthy"] == FRAMES
    assert summary["scans_left_out"] == 0
    assert "s apart; with a bag" not in vehicle.program.log
    lines = lines_of(tmp_path / "lines")
    for T, line in zip(found, lines, strict=True):
        np.testing.assert_array_equal(T[:3, 3], line["pose"][:3])

    x, y, z = vehicle.truth[0][:3, 3]
    start = ",".join(map(repr, map(float, (x, y, z, *quaternion_of(vehicle.truth[0][:3, :3])))))
    words = ["follow", "--endpoint", one.endpoint, "--shm-dir", one.shm_dir, *WINDOW, "--min-range", "0"]
    words += ["--scans", str(drive.scans), "--init", start, "--pose-format", "tum", "--no-relocalize"]
    done = run_verb([*words, "--json-lines", str(tmp_path / "files")], module=MODULE)
    assert done.returncode == 0, done.stderr
    files = lines_of(tmp_path / "files")
    assert [line["iterations"] for line in files] == [line["iterations"] for line in lines]
    for other, line in zip(files, lines, strict=True):  # times of files are sums of 0.1 s
        np.testing.assert_allclose(line["pose"], other["pose"], atol=1e-9)
        np.testing.assert_allclose(line["nvtl"], other["nvtl"], atol=1e-9)


def test_the_newest_scan_counts(
    domain: RosDomain, daemon: DaemonFactory, drive: TownDrive, tmp_path: Path
) -> None:
    """While the first one waits for the map; and another guess begins again.  No transform unless asked."""
    one = daemon(drive.map_dir)
    vehicle = Vehicle(domain, one, drive, tmp_path)
    vehicle.guess(vehicle.truth[0], "odom")
    vehicle.begin()
    published = vehicle.peer.ask("published_by", "ndt_scan_matcher", "/")
    assert "/ndt_pose_with_covariance" in published
    assert "/tf" not in published
    one.send(signal.SIGSTOP)
    for number in range(6):
        vehicle.scan(number)
    one.send(signal.SIGCONT)
    vehicle.pose(5)
    vehicle.guess(vehicle.truth[FRAMES - 2])
    vehicle.scan(FRAMES - 2)  # the guess may come after it
    vehicle.scan(FRAMES - 1)
    T = vehicle.pose(FRAMES - 1)
    assert np.linalg.norm((T - vehicle.truth[FRAMES - 1])[:3, 3]) < 0.2
    summary = vehicle.end(signal.SIGTERM)
    assert summary["scans_left_out"] >= 1
    taken = [round(line["stamp_s"] * 10) for line in lines_of(tmp_path / "lines")]
    assert summary["frames"] == len(taken) < 8
    assert {5, FRAMES - 1} <= {*taken}
    assert "s apart; with a bag" in vehicle.program.log


def test_it_ends_while_it_waits(
    domain: RosDomain, daemon: DaemonFactory, drive: TownDrive, tmp_path: Path
) -> None:
    vehicle = Vehicle(domain, daemon(drive.map_dir), drive, tmp_path)
    vehicle.program.wait_said("waiting for a pose on /initialpose")
    assert vehicle.program.end(signal.SIGINT) == 1
    assert f"no scan came from {TOPIC}" in vehicle.program.log
    assert "Traceback" not in vehicle.program.log
