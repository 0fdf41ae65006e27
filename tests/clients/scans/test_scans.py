# SPDX-License-Identifier: Apache-2.0
"""Poses and routes from files, scans from directories, scans over sockets."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shmmap_clients.scans
from numpy.typing import NDArray
from shmmap_clients.scans import scan_stream
from shmmap_clients.scans.scan_file import read_scan
from shmmap_clients.scans.scan_sequence import Scan, ScanSequence
from shmmap_clients.scans.scan_stream import ScanPublisher, ScanSubscriber, decode_scan, encode_scan
from shmmap_clients.scans.trajectory import (
    Trajectory,
    matrix_of,
    quaternion_of,
    read_route,
    read_trajectory,
    tum_line,
)

from shmmap import BadRequest, MapDataError
from shmmap.errors import MapMissing


def test_scans_are_read_and_thinned_by_public_names(tmp_path: Path) -> None:
    """As the package's documentation has it; an NPZ in steps of 4 mm takes a third of the bytes."""
    metres = np.array([(1.1, 1.1, 0.2), (1.3, 1.5, 0.4), (7.0, 1.0, 0.0), (np.nan, 0, 0)], np.float32)
    np.savez(tmp_path / "s_1.npz", xyz=metres)
    np.savez(tmp_path / "s_2.npz", xyz_4mm=np.round(metres[:3] / 0.004).astype(np.int16), ring=np.arange(3))
    assert shmmap_clients.scans.__doc__ is not None
    assert all(f"`{name}`" in shmmap_clients.scans.__doc__ for name in shmmap_clients.scans.__all__)
    assert "``xyz_4mm``" in shmmap_clients.scans.__doc__
    for name in ("s_1.npz", "s_2.npz"):
        points = shmmap_clients.scans.read_scan(tmp_path / name)
        np.testing.assert_allclose(points, metres[:3], atol=0.002)
        thin = shmmap_clients.scans.thinned(points, 1.0)
        np.testing.assert_allclose(thin, [(1.2, 1.3, 0.3), (7.0, 1.0, 0.0)], atol=0.002)
    first, second = shmmap_clients.scans.ScanSequence(tmp_path)
    assert (first.name, len(first.xyz), second.columns["ring"].tolist()) == ("s_1", 3, [0, 1, 2])


def test_rotations_there_and_back() -> None:
    rng = np.random.default_rng(1)
    quaternions = rng.normal(size=(200, 4))
    quaternions[:4] = np.eye(4)  # half turns about each axis, and none
    v = rng.normal(size=3)
    for q in quaternions / np.linalg.norm(quaternions, axis=1)[:, None]:
        T = matrix_of((1, 2, 3), q)
        assert np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
        # q v q* by the vector formula
        t = 2 * np.cross(q[:3], v)
        assert np.allclose(T[:3, :3] @ v, v + q[3] * t + np.cross(q[:3], t))
        back = np.array(quaternion_of(T[:3, :3]))
        assert np.allclose(back, q if back @ q > 0 else -q, atol=1e-9)


def test_a_trajectory_is_read_and_written(tmp_path: Path) -> None:
    path = tmp_path / "poses.txt"
    T = matrix_of((1.5, -2.0, 0.25), (0.1, -0.2, 0.3, 0.9))
    path.write_text(f"# t x y z qx qy qz qw\n\n{tum_line(0.1, np.eye(4))}\n{tum_line(0.2, T)}  # last\n")
    read = read_trajectory(path)
    assert read.stamps_s.tolist() == [0.1, 0.2]
    assert np.allclose(read.T_map_sensor[1], T, atol=1e-8)
    assert repr(read) == "<Trajectory of 2 poses, 0.100 to 0.200 s>"


def poses_at(path: Path, stamps: list[str], quaternion: str = "0 0 0 1") -> Trajectory:
    path.write_text("".join(f"{stamp} {n} 0 0 {quaternion}\n" for n, stamp in enumerate(stamps)))
    return read_trajectory(path)


@pytest.mark.parametrize("begin_s", [0, 1, 86_400, 259_200, 1_700_000_000])  # a drive, uptimes, a clock
@pytest.mark.parametrize("period_ms", [10, 100, 1000])
@pytest.mark.parametrize(
    ("unit", "per_s"),
    [("seconds", 1), ("milliseconds", 10**3), ("microseconds", 10**6), ("nanoseconds", 10**9)],
)
def test_the_unit_of_times_is_recognised(
    tmp_path: Path, begin_s: int, period_ms: int, unit: str, per_s: int
) -> None:
    truth = [begin_s + n * period_ms / 1000 for n in range(8)]
    whole = [begin_s * per_s + n * period_ms * per_s // 1000 for n in range(8)]
    read = poses_at(
        tmp_path / "p.txt", [f"{s:.3f}" for s in truth] if per_s == 1 else [str(w) for w in whole]
    )
    if unit == "milliseconds" and begin_s < 86_400:  # or numbers of frames: in doubt
        assert f"{period_ms} apart and read as seconds" in read.notes[0]
        return
    np.testing.assert_allclose(read.stamps_s, truth, rtol=0, atol=1e-6)
    said = () if per_s == 1 else (f"times in {tmp_path / 'p.txt'} are read as {unit}",)
    assert tuple(note.partition(",")[0] for note in read.notes) == said


def test_numbers_of_frames_and_single_times_stay(tmp_path: Path) -> None:
    assert poses_at(tmp_path / "p.txt", ["0", "1", "2"]).stamps_s.tolist() == [0.0, 1.0, 2.0]
    assert poses_at(tmp_path / "p.txt", ["7"]).notes == ()
    assert poses_at(tmp_path / "p.txt", ["5", "5", "5"]).notes == ()
    every_eighth = poses_at(tmp_path / "p.txt", ["0", "8", "16"])
    assert every_eighth.stamps_s.tolist() == [0.0, 8.0, 16.0]
    assert "numbers of frames" in every_eighth.notes[0]
    assert poses_at(tmp_path / "p.txt", ["1700000000123456789"]).stamps_s == pytest.approx(1700000000.123457)


def test_quaternions_with_w_first_are_named_and_not_turned(tmp_path: Path) -> None:
    yaws = np.linspace(-0.4, 2.0, 20)
    lines = [f"{n / 10} {n} 0 0 {np.cos(yaw / 2)} 0.01 0 {np.sin(yaw / 2)}" for n, yaw in enumerate(yaws)]
    (tmp_path / "p.txt").write_text("\n".join(lines))
    read = read_trajectory(tmp_path / "p.txt")
    assert len(read.notes) == 1
    assert "look like w first" in read.notes[0]
    assert np.allclose(
        read.T_map_sensor[3, :3, :3], matrix_of((0, 0, 0), map(float, lines[3].split()[4:]))[:3, :3]
    )
    # the same with w last, a camera's frame, and a scanner that hangs upside down
    upside_down = [(np.cos(yaw / 2), np.sin(yaw / 2), 0.0, 0.0) for yaw in yaws]
    camera = [(0.0, np.sin(yaw / 2), 0.0, np.cos(yaw / 2)) for yaw in yaws]
    for turns in ([(0.0, 0.01, np.sin(yaw / 2), np.cos(yaw / 2)) for yaw in yaws], camera, upside_down):
        text = "\n".join(f"{n / 10} {n} 0 0 {' '.join(map(str, q))}" for n, q in enumerate(turns))
        (tmp_path / "p.txt").write_text(text)
        assert read_trajectory(tmp_path / "p.txt").notes == ()


@pytest.mark.parametrize("line", ["1 2 3", "a b c d e f g h", "0 0 0 0 0 0 0 0", "0 nan 0 0 0 0 0 1"])
def test_a_wrong_line_is_named(tmp_path: Path, line: str) -> None:
    path = tmp_path / "poses.txt"
    path.write_text(f"0 0 0 0 0 0 0 1\n{line}\n")
    with pytest.raises(MapDataError, match="line 2"):
        read_trajectory(path)


@pytest.mark.parametrize("read", [read_trajectory, read_route])
def test_files_without_poses_or_places(tmp_path: Path, read: Callable[[Path], object]) -> None:
    (tmp_path / "empty").write_text("# nothing but this\n")
    (tmp_path / "binary.csv").write_bytes(b"\xff\xfe\x00")
    (tmp_path / "folder.csv").mkdir()
    for name, said in (("empty", "no poses"), ("binary.csv", "not a text file"), ("folder.csv", "directory")):
        with pytest.raises(MapDataError, match=said):
            read(tmp_path / name)
    with pytest.raises(MapMissing, match=r"route\.csv"):
        read(tmp_path / "route.csv")


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("route.tum", "# t x y z q\n1.0 1.5 -2 7 0 0 0 1\n2.0 3 4e1 7 0 0 0.7071068 0.7071068\n"),
        ("route.csv", "1.5,-2\n3,4e1\n"),
        ("route.CSV", "\ufeffx,y,z\n1.5,-2,7\n\n3, 40,\n"),
        ("route.csv", '# planned\n"z","y","x"\n7,-2,1.5 # here it begins\n7,40,3,\n'),
    ],
)
def test_places_of_a_route(tmp_path: Path, name: str, text: str) -> None:
    file = tmp_path / name
    file.write_text(text, encoding="utf-8")
    assert read_route(file).tolist() == [[1.5, -2.0], [3.0, 40.0]]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "no places"),
        ("x,y\n", "no places"),
        ("1,2\n3\n", "line 2: not `x,y`"),
        ("x,y\n1,2\n\n3,nan\n", "line 4: not `x,y`"),
        ("east,north\n1,2\n", "line 1: not `x,y`"),
        ("x,lat\n1,2\n", "line 1: not `x,y`"),
        ("1e308,1e308\n", "line 1: not `x,y`"),
        ("1 2\n", "line 1: not `x,y`"),
    ],
)
def test_what_is_no_route_is_refused(tmp_path: Path, text: str, said: str) -> None:
    file = tmp_path / "route.csv"
    file.write_text(text)
    with pytest.raises(MapDataError, match=said) as refused:
        read_route(file)
    assert str(file) in str(refused.value)


def write_scans(directory: Path, names: list[str]) -> None:
    directory.mkdir()
    for n, name in enumerate(names):
        np.savez(directory / f"{name}.npz", xyz=np.full((3 + n, 3), n, np.float32))
    (directory / "README").write_text("not a scan")


def test_poses_go_to_scans_by_place_or_by_number(tmp_path: Path) -> None:
    write_scans(tmp_path / "a", ["s_2", "s_0", "s_4"])
    poses = tmp_path / "poses.txt"
    lines = [tum_line(float(n), matrix_of((10.0 * n, 0, 0), (0, 0, 0, 1))) for n in range(5)]
    poses.write_text("\n".join(lines))
    scans = list(ScanSequence(tmp_path / "a", read_trajectory(poses)))
    assert [scan.name for scan in scans] == ["s_0", "s_2", "s_4"]
    assert [scan.stamp_s for scan in scans] == [0.0, 2.0, 4.0]
    assert [float(scan.T_map_sensor[0, 3]) for scan in scans if scan.T_map_sensor is not None] == [0, 20, 40]
    assert [len(scan.xyz) for scan in scans] == [4, 3, 5]
    poses.write_text("\n".join(lines[:3]))
    assert [scan.stamp_s for scan in ScanSequence(tmp_path / "a", read_trajectory(poses))] == [0.0, 1.0, 2.0]
    poses.write_text("\n".join(lines[:4]))
    with pytest.raises(BadRequest, match="s_4"):
        ScanSequence(tmp_path / "a", read_trajectory(poses))
    bare = list(ScanSequence(tmp_path / "a"))
    assert [scan.T_map_sensor for scan in bare] == [None] * 3
    with pytest.raises(MapMissing):
        ScanSequence(tmp_path / "b")
    (tmp_path / "empty").mkdir()
    with pytest.raises(MapMissing):
        ScanSequence(tmp_path / "empty")


def test_files_that_are_no_scans_are_named(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    np.savez_compressed(tmp_path / "good.npz", xyz=rng.normal(size=(5000, 3)))
    assert read_scan(tmp_path / "good.npz").shape == (5000, 3)
    good = (tmp_path / "good.npz").read_bytes()
    np.save(tmp_path / "one.npy", np.zeros((3, 3)))
    (tmp_path / "one.npy").rename(tmp_path / "array.npz")
    (tmp_path / "text.npz").write_text("no archive")
    (tmp_path / "empty.npz").write_bytes(b"")
    (tmp_path / "cut.npz").write_bytes(good[:-40])
    np.savez(tmp_path / "flat.npz", xyz=np.zeros(9))
    np.savez(tmp_path / "other.npz", points=np.zeros((9, 3)))
    np.savez(tmp_path / "objects.npz", xyz=np.array([None]))
    (tmp_path / "odd.bin").write_bytes(bytes(17))
    for name in ("folder.npz", "folder.bin"):
        (tmp_path / name).mkdir()
    for at in range(0, len(good), len(good) // 97):  # damage anywhere: an error, or what does not matter
        damaged = bytearray(good)
        damaged[at] ^= 0x55
        (tmp_path / "damaged.npz").write_bytes(damaged)
        with contextlib.suppress(MapDataError):
            assert read_scan(tmp_path / "damaged.npz").shape == (5000, 3)
    for path in {*tmp_path.iterdir()} - {tmp_path / "good.npz", tmp_path / "damaged.npz"}:
        with pytest.raises(MapDataError, match=path.name):
            read_scan(path)
    with pytest.raises(MapMissing):
        read_scan(tmp_path / "nothing.npz")


def make_scan(pose: bool = True) -> Scan:
    columns: dict[str, NDArray[Any]] = {
        "xyz": np.arange(12, dtype=np.float32).reshape(4, 3),
        "intensity": np.arange(4, dtype=np.uint8),
        "normal": np.ones((4, 2), np.float64),
    }
    return Scan("one", 12.5, columns, matrix_of((1, 2, 3), (0, 0, 0.6, 0.8)) if pose else None)


@pytest.mark.parametrize("pose", [True, False])
def test_a_message_there_and_back(pose: bool) -> None:
    scan = make_scan(pose)
    back = decode_scan(encode_scan(scan))
    assert back is not None
    assert (back.name, back.stamp_s) == ("one", 12.5)
    assert (back.T_map_sensor is not None) == pose
    for name, values in scan.columns.items():
        assert back.columns[name].dtype == values.dtype
        assert np.array_equal(back.columns[name], values)
    assert decode_scan(encode_scan(None)) is None


def test_messages_that_are_no_scans() -> None:
    good = encode_scan(make_scan())
    for wrong in ([b""], [b"\x80"], good[:-1], [good[0], b"123", *good[2:]], [*good, b""]):
        with pytest.raises(BadRequest):
            decode_scan(wrong)
    for pose in (np.zeros((4, 4)), np.diag([1.0, 2.0, 1.0, 1.0]), np.full((4, 4), np.nan)):
        with pytest.raises(BadRequest, match="rotation"):
            decode_scan(encode_scan(Scan("one", 0.0, make_scan().columns, pose)))
    with pytest.raises(BadRequest, match="time"):
        decode_scan(encode_scan(Scan("one", float("nan"), make_scan().columns)))


def test_scans_over_a_socket(tmp_path: Path) -> None:
    endpoint = f"ipc://{tmp_path}/scans"
    with ScanPublisher(endpoint) as publisher, ScanSubscriber(endpoint) as subscriber:
        assert publisher.wait_for_subscriber(30.0)
        for n in range(3):
            publisher.send(Scan(f"s{n}", n, make_scan().columns))
        publisher.send(None)
        assert [scan.name for scan in subscriber] == ["s0", "s1", "s2"]
    with pytest.raises(BadRequest, match="cannot bind"):
        ScanPublisher("nowhere")
    with pytest.raises(BadRequest, match="cannot connect"):
        ScanSubscriber("nowhere")


def test_a_slow_reader_receives_the_end(tmp_path: Path) -> None:
    endpoint = f"ipc://{tmp_path}/scans"
    sent = 1000  # more than fit into both queues
    publisher = ScanPublisher(endpoint)
    with ScanSubscriber(endpoint) as subscriber:
        assert publisher.wait_for_subscriber(30.0)
        for n in range(sent):
            publisher.send(Scan(str(n), n, {"xyz": np.zeros((1000, 3), np.float32)}))
        publisher.send(None)
        closing = threading.Thread(target=publisher.close)
        closing.start()
        received = [int(scan.name) for scan in subscriber]
        closing.join()
        assert list(subscriber) == []
    assert 0 < len(received) < sent  # it was slow: it has missed some
    assert received == sorted(set(received))


def test_a_subscriber_that_does_not_read_holds_up_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scan_stream, "_LINGER_MS", 50)
    endpoint = f"ipc://{tmp_path}/scans"
    with ScanPublisher(endpoint) as publisher:
        assert not publisher.wait_for_subscriber(0.0)
        publisher.send(None)
    with ScanSubscriber(endpoint), ScanPublisher(endpoint) as publisher:
        assert publisher.wait_for_subscriber(30.0)
        publisher.send(None)  # and closes, the reader still there


def test_times_in_two_units_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "poses.tum"
    for other in ("1600000000200", "1600000000200000000"):
        path.write_text(
            "".join(f"{stamp} 0 0 0 0 0 0 1\n" for stamp in ("1600000000", "1600000000.1", other))
        )
        with pytest.raises(MapDataError, match="different units"):
            read_trajectory(path)
