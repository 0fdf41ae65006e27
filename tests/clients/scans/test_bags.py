# SPDX-License-Identifier: Apache-2.0
"""Scans and poses from rosbag2 bags, as `rosbags` writes them; and what is refused."""

from __future__ import annotations

import contextlib
import re
import sqlite3
import subprocess
import sys
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from shmmap_clients.ndt_scan_matcher.cli import main as ndt
from shmmap_clients.scan_drive import open_scans, read_one_scan
from shmmap_clients.scans.bag import Bag, is_bag
from shmmap_clients.scans.bag_scans import BagOptions, BagScans
from shmmap_clients.scans.point_cloud2 import columns_of
from shmmap_clients.scans.scan_file import ScanReader
from shmmap_clients.scans.scan_sequence import Scan
from shmmap_clients.scans.trajectory import interpolate, matrix_of, tum_line

from shmmap import BadRequest, MapDataError
from shmmap.errors import MapMissing, ShmmapError

pytest.importorskip("rosbags", reason="rosbags is not installed")
from rosbags.rosbag2 import CompressionMode

from tests.support import bags
from tests.support.bags import LAYOUTS, MCAP, SQLITE, cloud, storage_file, write_bag

PERIOD_NS = 10**8
BEGIN_NS = 1_764_394_432 * 10**9
MOUNTED = matrix_of((0.9, -0.1, 1.7), (0.01, -0.02, 0.6, 0.8))  # T_base_link_lidar
XYZ = np.random.default_rng(4).uniform(-40.0, 40.0, (600, 3)).astype(np.float32)
PLUGINS = pytest.mark.parametrize("plugin", [SQLITE, MCAP], ids=["sqlite3", "mcap"])


def T_at(number: float) -> NDArray[np.float64]:
    """A turn: poses that a constant velocity leads through."""
    angle = 0.02 * number
    turned = (0.0, 0.0, np.sin(angle / 2), np.cos(angle / 2))
    return matrix_of((50 * np.sin(angle), 50 * (1 - np.cos(angle)), 0.3), turned)


def ns(number: float) -> int:
    return BEGIN_NS + round(number * PERIOD_NS)


def clouds(count: int = 6, **settings: Any) -> list[bags.Entry]:
    return [("/points", ns(n), cloud(XYZ + n, ns(n), **settings)) for n in range(count)]


def poses(
    topic: str = "/pose", count: int = 6, make: Any = bags.odometry, **settings: Any
) -> list[bags.Entry]:
    return [(topic, ns(n), make(T_at(n), ns(n), **settings)) for n in range(count)]


def scans_of(path: Path, poses: str | None = None, **options: Any) -> tuple[list[Scan], list[str]]:
    """Scans, and what was said."""
    said: list[str] = []
    with ExitStack() as stack:
        reader = ScanReader(min_range=0.0, say=said.append)
        found = list(open_scans(str(path), poses, stack, reader, BagOptions(**options)))
    return found, said


def refused(kind: type[ShmmapError], path: Path, poses: str | None = None, **options: Any) -> ShmmapError:
    with pytest.raises(kind) as raised:
        scans_of(path, poses, **options)
    return raised.value


@PLUGINS
@pytest.mark.parametrize("layout", LAYOUTS)
def test_points_are_those_written(tmp_path: Path, plugin: Any, layout: str) -> None:
    bag = write_bag(tmp_path / "bag", clouds(layout=LAYOUTS[layout]), plugin)
    for path in (bag, storage_file(bag)):
        scans, said = scans_of(path)
        assert [scan.name for scan in scans[:2]] == ["1764394432.000000000", "1764394432.100000000"]
        assert [scan.stamp_s for scan in scans] == [float(scan.name) for scan in scans]
        for number, scan in enumerate(scans):
            assert np.array_equal(scan.xyz, XYZ + number)
            assert scan.xyz.dtype == (np.float64 if layout == "doubles" else np.float32)
            assert scan.T_map_sensor is None
        assert said == [f"scans of {path} are from /points, without poses"]


def test_any_layout_and_what_contradicts_itself() -> None:
    layout: Any = {
        "names": ["t", "z", "x", "y", "echo"],
        "formats": [">f8", ">f4", ">f8", ">f4", ("i1", (3,))],
    }
    echo, t = np.arange(1800, dtype=np.int8).reshape(-1, 3), np.arange(600.0)
    organised = cloud(XYZ, layout=layout, rows=20, row_padding=13, echo=echo, t=t)
    columns = columns_of(organised, "here")
    assert np.array_equal(columns["xyz"], XYZ)
    assert np.array_equal(columns["echo"], echo)
    assert np.array_equal(columns["t"], t)
    assert all(values.dtype.isnative for values in columns.values())
    assert list(columns) == ["xyz", "t", "echo"]
    plain = cloud(XYZ)
    assert np.array_equal(columns_of(replace(plain, row_step=0), "here")["xyz"], XYZ), "one row has no other"
    zero_counts = [replace(field, count=0) for field in plain.fields]
    assert np.array_equal(columns_of(replace(plain, fields=zero_counts), "here")["xyz"], XYZ)
    assert len(columns_of(replace(plain, width=0, fields=[], data=plain.data[:0]), "here")["xyz"]) == 0
    x, y, z = plain.fields
    integers = [replace(x, datatype=5), y, z]
    for wrong, said in (
        (
            replace(plain, data=plain.data[:-1]),
            "here: 7199 bytes are no 1 rows of 7200 bytes with 600 points",
        ),
        (replace(plain, width=599, row_step=599 * 12), "7200 bytes are no"),
        (replace(organised, row_step=1), "are no 20 rows of 1 bytes"),
        (replace(plain, width=2**32 - 1, height=2**32 - 1), "are no 4294967295 rows"),
        (replace(plain, point_step=8), "field 'z' ends after a point's 8 bytes"),
        (replace(plain, fields=[x, y, replace(z, count=2**31)]), "field 'z' ends after"),
        (replace(plain, fields=[x, y]), "field z is missing: points are float32 or float64 x, y, z"),
        (replace(plain, fields=integers), "field x is i4: points are float32"),
        (replace(plain, fields=[x, y, z, y]), "two fields are called 'y'"),
        (replace(plain, fields=[x, y, replace(z, datatype=11)]), "field 'z' has the unknown type 11"),
    ):
        with pytest.raises(MapDataError, match=re.escape(said)):
            columns_of(wrong, "here")


def test_points_are_left_out_as_of_files_and_before_they_are_moved(tmp_path: Path) -> None:
    xyz = XYZ.copy()
    xyz[::7], xyz[3::7] = np.nan, 0.1
    static = ("/tf_static", ns(0), bags.transforms(("base_link", "lidar", MOUNTED)))
    bag = write_bag(tmp_path / "bag", [static, ("/points", ns(0), cloud(xyz, ns(0), "lidar"))])
    np.savez(tmp_path / "scan.npz", xyz=xyz)
    file, of_bag = ScanReader(), ScanReader()
    expected = read_one_scan(f"{tmp_path}/scan.npz", file, BagOptions())
    found = read_one_scan(f"{bag}@0", of_bag, BagOptions())
    assert of_bag.counts == file.counts == {"too_near": 86, "not_finite": 86}
    assert found.rows is not None
    assert expected.rows is not None
    assert np.array_equal(found.rows, expected.rows)
    moved = (expected.xyz @ MOUNTED[:3, :3].T + MOUNTED[:3, 3]).astype(np.float32)
    assert np.array_equal(found.xyz, moved)
    own = read_one_scan(f"{bag}@0", ScanReader(), BagOptions(base_frame="lidar"))
    assert np.array_equal(own.xyz, expected.xyz)


def test_frames_are_found_over_several_transforms(tmp_path: Path) -> None:
    a, b, c = MOUNTED, T_at(9), T_at(30)
    entries: list[bags.Entry] = [
        ("/tf_static", ns(0), bags.transforms(("roof", "/lidar", a), ("base_footprint", "base_link", c))),
        ("/tf_static", ns(0), bags.transforms(("base_footprint", "roof", b), ("lidar", "lens", a))),
        *clouds(1, frame="lidar"),
    ]
    bag = write_bag(tmp_path / "bag", entries)
    T = np.linalg.inv(c) @ b @ a
    (scan,), _ = scans_of(bag)
    np.testing.assert_allclose(scan.xyz, XYZ @ T[:3, :3].T + T[:3, 3], atol=1e-4)
    (scan,), _ = scans_of(bag, frame="sensor")
    assert np.array_equal(scan.xyz, XYZ)
    said = str(refused(MapDataError, bag, base_frame="chassis"))
    assert "points of /points are in frame 'lidar', and no chain of transforms of /tf_static leads" in said
    assert (
        "to 'chassis'; it has base_footprint, base_link, lens, lidar, roof (--base-frame lidar would" in said
    )
    circle = bags.transforms(("a", "lidar", a), ("lidar", "a", a))
    bag = write_bag(tmp_path / "circle", [("/tf_static", ns(0), circle), *clouds(1, frame="lidar")])
    refused(MapDataError, bag)
    refused(MapDataError, write_bag(tmp_path / "none", clouds(1, frame="lidar")))


@PLUGINS
@pytest.mark.parametrize("make", [bags.odometry, bags.pose_stamped, bags.pose_with_covariance])
def test_poses_of_the_only_topic_in_the_map(tmp_path: Path, plugin: Any, make: Any) -> None:
    goal = ("/goal", ns(0), bags.pose_stamped(T_at(99), ns(0)))
    bag = write_bag(tmp_path / "bag", [goal, *poses(make=make, count=20), *clouds(20)], plugin)
    scans, said = scans_of(bag)
    assert said == [f"scans of {bag} are from /points, poses from /pose in frame map"]
    for number, scan in enumerate(scans):
        np.testing.assert_allclose(scan.pose, T_at(number), atol=1e-12)


def test_poses_between_those_recorded_and_where_there_are_none(tmp_path: Path) -> None:
    entries = [("/pose", ns(n), bags.odometry(T_at(n), ns(n))) for n in (0.5, 1.5, 2.5, 3.5, 30.5, 31.5)]
    bag = write_bag(tmp_path / "bag", [*entries, *clouds(34)])
    scans, said = scans_of(bag)
    assert [round((scan.stamp_s - BEGIN_NS / 1e9) * 10) for scan in scans] == [1, 2, 3, 31]
    for number, scan in zip((1, 2, 3, 31), scans, strict=True):
        np.testing.assert_allclose(scan.pose, T_at(number), atol=3e-3)  # half a metre of arc
    assert said[1:] == ["scan 1764394432.000000000 has no pose at its time: left out, as others like it"]
    assert len(scans_of(bag, without_pose="begin")[0]) == 33
    assert len(scans_of(bag, without_pose="keep")[0]) == 34


def test_poses_from_tf(tmp_path: Path) -> None:
    drift = matrix_of((3, -4, 0.5), (0, 0, 0.1, 0.99))
    steps = [
        (
            "/tf",
            ns(n),
            bags.transforms(("odom", "base_footprint", T_at(n)), ("base", "wheel", drift), stamp_ns=ns(n)),
        )
        for n in range(6)
    ]
    above = [("/tf", ns(n), bags.transforms(("map", "odom", drift), stamp_ns=ns(n))) for n in (0, 6)]
    static = ("/tf_static", ns(0), bags.transforms(("base_footprint", "base_link", MOUNTED)))
    bag = write_bag(tmp_path / "bag", [static, *steps, *above, *clouds()])
    scans, said = scans_of(bag)
    assert said == [f"scans of {bag} are from /points, poses from /tf"]
    for number, scan in enumerate(scans):
        np.testing.assert_allclose(scan.pose, drift @ T_at(number) @ MOUNTED, atol=1e-9)
    fixed = bags.transforms(("map", "odom", drift), ("base_footprint", "base_link", MOUNTED))
    bag = write_bag(tmp_path / "fixed", [("/tf_static", ns(0), fixed), *steps, *clouds()])
    np.testing.assert_allclose(scans_of(bag)[0][3].pose, drift @ T_at(3) @ MOUNTED, atol=1e-9)
    bag = write_bag(tmp_path / "short", [static, *steps, *clouds()])
    assert scans_of(bag)[0][0].T_map_sensor is None, "they lead to odom, not to map"
    assert "do not lead from 'base_link' to 'map'" in str(refused(MapDataError, bag, "/tf"))
    assert scans_of(bag, "/tf", map_frame="odom")[0][0].T_map_sensor is not None


def test_of_transforms_only_those_on_the_chain_count(tmp_path: Path) -> None:
    zero = bags.transforms(("odom", "wheel", T_at(0)), ("map", "wheel", T_at(0)), stamp_ns=ns(0))
    zero.transforms[0].transform.rotation.w = 0.0
    steps = [("/tf", ns(n), bags.transforms(("map", "base_link", T_at(n)), stamp_ns=ns(n))) for n in range(6)]
    bag = write_bag(tmp_path / "bag", [("/tf", ns(0), zero), ("/tf_static", ns(0), zero), *steps, *clouds()])
    np.testing.assert_allclose(scans_of(bag)[0][4].pose, T_at(4), atol=1e-12)
    other = ("/tf", ns(3), bags.transforms(("world", "base_link", T_at(3)), stamp_ns=ns(3)))
    said = str(refused(MapDataError, write_bag(tmp_path / "two", [*steps, other, *clouds()])))
    assert "in /tf, 'base_link' is in 'map' and in 'world'" in said


def test_poses_of_another_frame_of_the_vehicle(tmp_path: Path) -> None:
    static = (
        "/tf_static",
        ns(0),
        bags.transforms(("base_link", "lidar", MOUNTED), ("imu", "base_link", T_at(7))),
    )
    bag = write_bag(tmp_path / "bag", [static, *poses(child="imu"), *clouds(frame="lidar")])
    for frame, other in (("base", np.eye(4)), ("sensor", MOUNTED)):
        for number, scan in enumerate(scans_of(bag, frame=frame)[0]):
            np.testing.assert_allclose(scan.pose, T_at(number) @ T_at(7) @ other, atol=1e-12)
    said = str(refused(MapDataError, write_bag(tmp_path / "other", [*poses(child="imu"), *clouds()])))
    assert "poses of /pose are of 'imu'; the vehicle is in frame 'base_link', and no chain" in said
    assert "--base-frame imu would" in said


def test_poses_from_a_file(tmp_path: Path) -> None:
    file = tmp_path / "poses.txt"
    file.write_text("\n".join(tum_line(ns(n) / 10**9, T_at(n)) for n in range(6)))
    bag = write_bag(tmp_path / "bag", [*poses(make=bags.pose_stamped, count=1), *clouds()])
    scans, said = scans_of(bag, str(file))
    assert said == [f"scans of {bag} are from /points, poses from {file}"]
    np.testing.assert_allclose(scans[5].pose, T_at(5), atol=1e-8)
    error = refused(MapMissing, bag, "/none")
    assert error.message == f"--poses: there is no file /none, and no such topic in {bag}"
    assert error.hint == "it has /pose (geometry_msgs/msg/PoseStamped, 1)"


def test_several_topics_that_fit_are_listed(tmp_path: Path) -> None:
    other = [("/rear", time, message) for _, time, message in clouds()]
    odom = poses("/odom", frame="odom")
    bag = write_bag(tmp_path / "bag", [*clouds(), *other, *poses(), *poses("/ekf"), *odom])
    error = refused(BadRequest, bag)
    assert error.message == (
        f"{bag}: several topics fit: /points (sensor_msgs/msg/PointCloud2, 6),"
        " /rear (sensor_msgs/msg/PointCloud2, 6)"
    )
    assert error.hint == "choose one: --topic /points"
    error = refused(BadRequest, bag, topic="/rear", poses_option="--truth")
    assert (
        f"{bag}: several topics have poses in frame map: /ekf (nav_msgs/msg/Odometry, 6), /pose"
        in error.message
    )
    assert error.hint == "choose one: --truth /ekf"
    assert scans_of(bag, "/pose", topic="/rear")[0][0].T_map_sensor is not None
    assert "in frame odom" in scans_of(bag, "/odom", topic="/rear")[1][0]
    assert "topic /odom is nav_msgs/msg/Odometry, not" in str(refused(BadRequest, bag, topic="/odom"))
    assert "no topic /nowhere" in str(refused(BadRequest, bag, topic="/nowhere"))
    assert "topic /points is sensor" in str(refused(BadRequest, bag, "/points", topic="/rear"))
    bag = write_bag(tmp_path / "odom", [*clouds(), *odom])
    scans, said = scans_of(bag)
    assert scans[0].T_map_sensor is None
    assert said[0] == "poses of /odom are in frame odom, not map: --poses /odom takes them"


@pytest.mark.parametrize("make", [bags.twist_stamped, bags.twist_with_covariance])
def test_motion_from_velocities(tmp_path: Path, make: Any) -> None:
    speed = np.array([10.0, 0.0, 0.0, 0.0, 0.0, 0.2])  # the circle of `T_at`
    entries = [("/speed", ns(n), make(speed, ns(n))) for n in range(0, 60, 3)]
    with Bag(write_bag(tmp_path / "bag", [*clouds(2), *entries, *poses("/odom", 60, frame="odom")])) as bag:
        scans = BagScans(bag, BagOptions(), ScanReader())
        speeds, odometry = scans.motion("/speed"), scans.motion("/odom")
        with pytest.raises(BadRequest, match="topic /points is sensor_msgs"):
            scans.motion("/points")
        with pytest.raises(MapMissing, match="no file /none, and no such topic"):
            scans.motion("/none")
    now = ns(42) / 10**9
    one, other = interpolate(speeds, now), interpolate(odometry, now)
    assert one is not None
    assert other is not None
    np.testing.assert_allclose(one[:3, :3], other[:3, :3], atol=1e-6)
    np.testing.assert_allclose(one[:2, 3], other[:2, 3], atol=1e-2)
    wrong = [("/speed", ns(n), make(speed, ns(n), "wheel")) for n in range(3)]
    with (
        Bag(write_bag(tmp_path / "wrong", [*clouds(2), *wrong])) as bag,
        pytest.raises(MapDataError, match="in frame 'wheel', not 'base_link'"),
    ):
        BagScans(bag, BagOptions(), ScanReader()).motion("/speed")


@PLUGINS
def test_the_scan_nearest_to_a_time(tmp_path: Path, plugin: Any) -> None:
    first = ("/other", BEGIN_NS, bags.pose_stamped(T_at(0), BEGIN_NS))
    entries = [("/points", ns(n), cloud(XYZ + n, ns(n))) for n in (30, 31, 900)]
    bag = write_bag(tmp_path / "bag@7", [first, *entries], plugin)
    for seconds, number in ((0, 30), (3.04, 30), (3.06, 31), (40, 31), (50, 900), (90, 900)):
        scan = read_one_scan(f"{bag}@{seconds}", ScanReader(), BagOptions())
        assert scan.name == f"{ns(number) // 10**9}.{ns(number) % 10**9:09}"
        assert np.array_equal(scan.xyz, XYZ + number)
    for text, said in (
        (f"{bag}@90.1", "lasts 90 s"),
        (f"{bag}@-1", "no scan at -1 s"),
        (f"{bag}@nan", "at nan s"),
    ):
        with pytest.raises(BadRequest, match=said):
            read_one_scan(text, ScanReader(), BagOptions())
    with pytest.raises(BadRequest, match="is a bag: which of its scans") as raised:
        read_one_scan(str(bag), ScanReader(), BagOptions())
    assert f"{bag}@SECONDS" in raised.value.hint
    np.savez(tmp_path / "a.db3@5.npz", xyz=XYZ)
    assert read_one_scan(f"{tmp_path}/a.db3@5.npz", ScanReader(), BagOptions()).name == "a.db3@5"


@pytest.mark.parametrize(
    ("plugin", "mode"),
    [
        (SQLITE, CompressionMode.FILE),
        (SQLITE, CompressionMode.MESSAGE),
        (MCAP, CompressionMode.FILE),
        (MCAP, CompressionMode.MESSAGE),
        (MCAP, CompressionMode.STORAGE),
    ],
)
def test_what_is_compressed_is_read_or_refused(tmp_path: Path, plugin: Any, mode: CompressionMode) -> None:
    bag = write_bag(tmp_path / "bag", clouds(), plugin, mode)
    scans, _ = scans_of(bag)
    assert [np.array_equal(scan.xyz, XYZ + n) for n, scan in enumerate(scans)] == [True] * 6
    file = storage_file(bag)
    if mode == CompressionMode.STORAGE:
        assert len(scans_of(file)[0]) == 6
    else:
        error = refused(MapDataError, file)
        assert "compressed" in error.message
        assert "directory" in error.hint


@PLUGINS
@pytest.mark.parametrize("share", [0.0, 0.02, 0.3, 0.7, 0.95, 0.999])
def test_truncated_files_are_refused(tmp_path: Path, plugin: Any, share: float) -> None:
    bag = write_bag(tmp_path / "bag", clouds(20), plugin)
    file = storage_file(bag)
    file.write_bytes(file.read_bytes()[: int(file.stat().st_size * share)])
    for path in (bag, file):
        error = refused(MapDataError, path)
        assert error.message.startswith(f"{path}")
        assert error.hint


@PLUGINS
def test_bytes_that_are_wrong_never_end_in_another_error(tmp_path: Path, plugin: Any) -> None:
    bag = write_bag(tmp_path / "bag", [*poses(), *clouds(6)], plugin)
    file = storage_file(bag)
    whole = file.read_bytes()
    rng = np.random.default_rng(1)
    for _ in range(15):
        damaged = bytearray(whole)
        for place in rng.integers(0, len(whole), 30):
            damaged[place] = rng.integers(256)
        file.write_bytes(damaged)
        for path in (bag, file):
            with contextlib.suppress(ShmmapError):
                scans_of(path)


def test_directories_that_lack_something(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "bag", clouds())
    file, metadata = storage_file(bag), bag / "metadata.yaml"
    text = metadata.read_text()
    metadata.write_text(text.replace("message_count: 6", "message_count: 9"))
    assert "metadata.yaml counts 9 messages, the files have 6" in str(refused(MapDataError, bag))
    metadata.write_text(text.replace("name: /points", "name: /cloud"))
    assert "6 messages of /cloud are missing" in str(refused(MapDataError, bag))
    with pytest.raises(MapDataError, match="are missing"):
        read_one_scan(f"{bag}@0", ScanReader(), BagOptions())
    metadata.write_text("rosbag2_bagfile_information: {version: 12}")
    assert "version 12 not supported" in str(refused(MapDataError, bag))
    metadata.write_text("{")
    assert "Could not load YAML" in str(refused(MapDataError, bag))
    metadata.unlink()
    error = refused(MapDataError, bag)
    assert error.message == f"{bag}: no metadata.yaml, which a recorder writes at its end"
    assert error.hint == f"`ros2 bag reindex {bag}` writes it, or give the file {file}"
    metadata.write_text(text)
    log = file.with_name(f"{file.name}-wal")
    log.write_bytes(b"x")
    for path in (bag, file):
        assert f"messages are in {log.name}, and not in the file yet" in str(refused(MapDataError, path))
    log.unlink()
    file.unlink()
    assert "Some database files are missing" in str(refused(MapDataError, bag))
    assert "there is no file" in str(refused(MapMissing, file))
    (tmp_path / "empty").mkdir()
    error = refused(MapMissing, tmp_path / "empty")
    assert (error.message, error.hint) == (
        f"{tmp_path}/empty has no scans",
        "names end in .pcd, .npz, .bin; those in a bag in .db3, .mcap",
    )
    np.savez(tmp_path / "empty" / "scan.npz", xyz=XYZ)
    (tmp_path / "empty" / "metadata.yaml").touch()
    assert not is_bag(tmp_path / "empty")
    assert len(scans_of(tmp_path / "empty")[0]) == 1


def test_what_is_no_bag_of_clouds(tmp_path: Path) -> None:
    scan = bags.made("LaserScan", bags.header(0, "laser"), *[0.0] * 7, np.zeros(3, "f4"), np.zeros(3, "f4"))
    bag = write_bag(tmp_path / "bag", [("/scan", 0, scan)])
    error = refused(MapMissing, bag)
    assert error.message == (
        f"{bag}: no topic has messages of sensor_msgs/msg/PointCloud2;"
        " it has /scan (sensor_msgs/msg/LaserScan, 1)"
    )
    assert "it has none" in str(refused(MapMissing, write_bag(tmp_path / "nothing", [])))
    other = write_bag(tmp_path / "other", clouds(), MCAP, serialized="protobuf")
    assert "protobuf" in str(refused(MapDataError, other))
    assert "messages of /points are serialized as protobuf" in str(refused(MapDataError, storage_file(other)))
    (tmp_path / "ros1.bag").write_bytes(b"#ROSBAG V2.0\n")
    assert "rosbags-convert" in str(refused(MapDataError, tmp_path / "ros1.bag"))
    (tmp_path / "text.mcap").write_text("nothing")
    assert "cannot be read as a bag" in str(refused(MapDataError, tmp_path / "text.mcap"))
    with sqlite3.connect(tmp_path / "other.db3") as database:
        database.execute("CREATE TABLE a (b)")
    database.close()
    assert "cannot be read as a bag" in str(refused(MapDataError, tmp_path / "other.db3"))
    both = [*clouds(1), ("/points", ns(1), bags.pose_stamped(T_at(0), ns(1)))]
    bag = write_bag(tmp_path / "both", both)
    said = str(refused(MapMissing, bag))
    assert "/points (geometry_msgs/msg/PoseStamped, sensor_msgs/msg/PointCloud2, 2)" in said


def test_poses_that_are_none(tmp_path: Path) -> None:
    broken = bags.odometry(T_at(0), ns(0))
    broken.pose.pose.orientation.w = broken.pose.pose.orientation.z = 0.0
    bag = write_bag(tmp_path / "zero", [("/pose", ns(0), broken), *clouds()])
    assert f"{bag}, /pose: the quaternion 0,0,0,0 is no rotation" in str(refused(MapDataError, bag))
    away = bags.odometry(T_at(0), ns(0))
    away.pose.pose.position.x = np.nan
    bag = write_bag(tmp_path / "nan", [("/pose", ns(0), away), *clouds()])
    assert "a position is not finite" in str(refused(MapDataError, bag))


def test_align_takes_a_scan_of_a_bag(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = write_bag(tmp_path / "bag", clouds(), MCAP)
    np.savez(tmp_path / "scan.npz", xyz=XYZ + 2)
    np.savez(tmp_path / "map.npz", xyz=np.repeat(XYZ + 2, 8, axis=0))
    words = ["align", "--map", f"{tmp_path}/map.npz", "--leaf", "8", "--backend", "numpy"]
    printed = []
    for scan in (f"{tmp_path}/scan.npz", f"{bag}@0.2"):
        ndt([*words, "--scan", scan])
        printed.append([line for line in capsys.readouterr().out.splitlines() if not line.startswith("time")])
    assert printed[0] == printed[1]
    assert ndt([*words, "--scan", str(bag)]) == 2
    assert ndt([*words, "--scan", f"{bag}@0", "--topic", "/none"]) == 2
    assert ndt([*words, "--scan", f"{bag}@0", "--base-frame", "chassis"]) == 65
    assert "shmmap-ndt: " in capsys.readouterr().err


def test_exit_codes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def follow(path: Path, *words: str, code: int) -> str:
        assert ndt(["follow", "--scans", str(path), "--init", "0,0,0,0,0,0", *words]) == code
        return capsys.readouterr().err

    whole = write_bag(tmp_path / "whole", [*clouds(), *poses(), *poses("/ekf")], MCAP)
    assert "hint: choose one: --truth /ekf" in follow(whole, code=2)
    assert "hint: for --topic it has /points" in follow(whole, "--topic", "/pose", code=2)
    assert "hint: it has /ekf" in follow(whole, "--truth", "/none", code=66)
    assert "no chain of transforms" in follow(whole, "--truth", "/ekf", "--base-frame", "chassis", code=65)
    assert "no topic has messages of" in follow(write_bag(tmp_path / "none", poses()), code=66)
    assert "no topic /none, not nav_msgs" not in follow(
        whole, "--truth", "/ekf", "--odometry", "/none", code=66
    )
    file = storage_file(whole)
    file.write_bytes(file.read_bytes()[:-1000])
    assert f"hint: `mcap recover {file}" in follow(file, code=65)
    assert "cannot be read as a bag" in follow(whole, code=65)
    (tmp_path / "empty").mkdir()
    assert "has no scans" in follow(tmp_path / "empty", code=66)
    assert "is no directory" in follow(tmp_path / "nothing", code=66)


def test_the_package_is_needed_for_bags_alone(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "bag", clouds(1))
    code = (
        "import sys; sys.modules['rosbags'] = None\n"  # as if it were not installed
        "from shmmap_clients.ndt_scan_matcher.cli import main\n"
        "sys.exit(main(sys.argv[1:]))"
    )
    words = ["follow", "--init", "0,0,0,0,0,0", "--scans"]
    done = subprocess.run([sys.executable, "-c", code, *words, str(bag)], capture_output=True, text=True)
    assert done.returncode == 69
    assert done.stderr == (
        "shmmap-ndt: a bag needs the package rosbags, which is not installed\nhint: pip install rosbags\n"
    )
    code = "import sys, shmmap_clients.scan_drive; sys.exit('rosbags' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
