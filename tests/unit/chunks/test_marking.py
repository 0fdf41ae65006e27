# SPDX-License-Identifier: Apache-2.0
"""Marks equal those of a slow reference voxel by voxel, for any scan and sensor; and their bytes."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace
from numpy.typing import NDArray

from shmmap.chunks import marking
from shmmap.chunks.marking import Marker
from shmmap.chunks.marks import Marks, decode_marks, encode_marks, marks_bytes
from shmmap.chunks.occupancy import ScanCounts, ScanFilter
from shmmap.chunks.voxels import voxels_of
from shmmap.errors import BadRequest
from tests.support.live_drive import SlowOccupancy, Voxel

Points = NDArray[np.floating]


def pose_at(position: tuple[float, float, float], yaw: float = 0.0) -> NDArray[np.float64]:
    """A sensor that has turned about the z axis."""
    pose = np.eye(4)
    pose[:2, :2] = [[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]]
    pose[:3, 3] = position
    return pose


def sets_of(marks: Marks) -> tuple[set[Voxel], set[Voxel]]:
    """Voxels that are hit, and that are passed through."""
    found: tuple[set[Voxel], set[Voxel]] = (set(), set())
    starts = marks.starts.tolist()
    for number, (key, hits) in enumerate(zip(marks.chunks, marks.hits.tolist(), strict=True)):
        for at in range(starts[number], starts[number + 1]):
            word, bits = int(marks.words[at]), int(marks.bits[at])
            places = [word * 64 + bit for bit in range(64) if bits >> bit & 1]
            which = found[0 if at < starts[number] + hits else 1]
            which.update((x, y, z) for x, y, z in voxels_of(key, np.array(places)).tolist())
    return found


def assert_equal_to_the_slow_one(marker: Marker, points: Points, pose: NDArray[np.float64]) -> Marks:
    wanted = marker.filter
    slow = SlowOccupancy(
        marker.resolution, min_range=wanted.min_range, max_range=wanted.max_range, min_z=wanted.min_z,
        max_z=wanted.max_z,
    )  # fmt: skip
    marks, counts = marker.mark(points, pose)
    hits, misses = sets_of(marks)
    expected = slow.marks(points.tolist(), pose.tolist()[:3])
    assert hits == expected[0]
    assert misses == expected[1]
    assert sum(getattr(counts, name) for name in counts.__struct_fields__) == len(points)
    return marks


SENSORS = [
    (0.0, 0.0, 0.0), (0.01, -0.01, 0.0), (12.8, -12.8, 6.4), (-1000.05, 2000.15, -30.0),
    (89571.3, 42301.7, 12.0),
]  # fmt: skip


@pytest.mark.parametrize("sensor", SENSORS)
@pytest.mark.parametrize(("resolution", "max_range"), [(0.2, 30.0), (0.05, 5.0), (1.0, 9.0)])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_scan(sensor: tuple[float, float, float], resolution: float, max_range: float, dtype: type) -> None:
    """Near, far and near the greatest range; one marker for all scans."""
    rng = np.random.default_rng(int(100 * resolution))
    marker = Marker(resolution, ScanFilter(0.5, max_range, -3.0, 3.0))
    for yaw in (0.0, 0.7, math.pi):
        points: Points = rng.normal(0.0, max_range / 2, (150, 3)).astype(dtype)
        points[:, 2] /= max_range / 3
        assert_equal_to_the_slow_one(marker, points, pose_at(sensor, yaw))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_points_on_the_borders_of_voxels_and_chunks(dtype: type) -> None:
    """And as near to the borders as floats can be: Rolling-Bonxai had such a voxel in one of two chunks."""
    rng = np.random.default_rng(3)
    marker = Marker(0.1, ScanFilter(0.0, 20.0, -20.0, 20.0))
    points: Points = (rng.integers(-70, 70, (300, 3)) * 0.1).astype(dtype)
    beside = [np.nextafter(points[:100], points.dtype.type(side)) for side in (-np.inf, np.inf)]
    points = np.concatenate([points, *beside])
    for sensor in ((0.0, 0.0, 0.0), (6.4, 6.4, 6.4), (-6.4, 0.1, -0.1), (0.3, 0.7, 0.6)):
        assert_equal_to_the_slow_one(marker, points, pose_at(sensor))


SMALL = st.integers(-40, 40).map(lambda number: number * 0.25)


@settings(max_examples=150, deadline=None)
@given(
    st.lists(st.tuples(SMALL, SMALL, SMALL), max_size=25),
    st.tuples(SMALL, SMALL, SMALL),
    st.sampled_from([0.0, math.pi / 2, 1.0]),
)
def test_any_scan(
    points: list[tuple[float, float, float]], sensor: tuple[float, float, float], yaw: float
) -> None:
    scan = np.array(points, np.float64).reshape(-1, 3)
    assert_equal_to_the_slow_one(Marker(0.5, ScanFilter(0.0, 7.0, -9.0, 9.0)), scan, pose_at(sensor, yaw))


def test_the_longest_rays() -> None:
    """4000 steps along every axis, up and down, and to the middle between two voxels."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-40.0, 40.0, (24, 3))
    points[np.arange(24), np.arange(24) % 3] = rng.choice([-40.0, 40.0], 24)
    points[12:, :2] = np.sign(points[12:, :2]) * [40.0, 20.0]
    marker = Marker(0.01, ScanFilter(0.5, 40.3, -99.0, 99.0))
    assert_equal_to_the_slow_one(marker, points, pose_at((0.005, -0.005, 0.005)))


def test_the_order_of_points_does_not_count() -> None:
    """A ray that is cut may end in a voxel that another one hits: in Bonxai whichever comes first counts."""
    marker = Marker(0.5, ScanFilter(0.0, 4.1, -9.0, 9.0))
    hit, cut = [4.05, 0.1, 0.1], [8.0, 0.1, 0.1]
    one, _ = marker.mark(np.array([hit, cut]), pose_at((0.0, 0.0, 0.0)))
    other, _ = marker.mark(np.array([cut, hit]), pose_at((0.0, 0.0, 0.0)))
    assert sets_of(one) == sets_of(other)
    assert sets_of(one)[0] == {(8, 0, 0)}
    points = np.random.default_rng(1).normal(0, 3, (400, 3))
    straight, _ = marker.mark(points, pose_at((1.0, 2.0, 3.0)))
    turned, _ = marker.mark(points[::-1], pose_at((1.0, 2.0, 3.0)))
    assert all(
        np.array_equal(getattr(straight, name), getattr(turned, name)) for name in straight.__struct_fields__
    )


@pytest.mark.parametrize("between", range(6))
def test_a_scan_is_marked_the_same_however_many_came_between(between: int) -> None:
    """Bonxai cast no ray to the end of one that it had seen exactly three scans before."""
    marker = Marker(0.2, ScanFilter(0.0, 30.0, -40.0, 40.0))
    points = np.random.default_rng(5).normal(0.0, 4.0, (100, 3))
    first = sets_of(marker.mark(points, pose_at((0.1, 0.1, 0.1)))[0])
    for number in range(between):
        marker.mark(np.array([[-8.0, 0.1, 0.1 + number]]), pose_at((0.1, 0.1, 0.1)))
    assert sets_of(marker.mark(points, pose_at((0.1, 0.1, 0.1)))[0]) == first


def test_what_becomes_of_each_point_is_counted() -> None:
    points = np.array(
        [
            [1, 0, 0],
            [9, 0, 0],
            [0.1, 0, 0],
            [1, 0, 3],
            [np.nan, 0, 0],
            [0, np.inf, 0],
            [5, 0, 0],
            [0, -np.inf, 9],
        ],
        np.float32,
    )
    marks, counts = Marker(0.1).mark(points, pose_at((0.0, 0.0, 0.0)))
    assert counts == ScanCounts(near=1, far=2, too_near=1, outside_z=1, not_finite=3)
    assert sets_of(marks)[0] == {(10, 0, 0)}


def test_a_scan_of_nothing() -> None:
    marker = Marker(0.1)
    for points in (np.empty((0, 3)), np.full((4, 3), np.nan)):
        marks, _ = marker.mark(points, pose_at((0.0, 0.0, 0.0)))
        assert (len(marks.keys), len(marks.words)) == (0, 0)


def test_a_ray_within_one_voxel_passes_through_nothing() -> None:
    marks, _ = Marker(1.0, ScanFilter(0.0, 5.0)).mark(np.array([[0.3, 0.3, 0.3]]), pose_at((0.1, 0.1, 0.1)))
    assert sets_of(marks) == ({(0, 0, 0)}, set())


def test_more_chunks_than_there_was_memory_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(marking, "FIRST_SLOTS", 1)
    points = np.random.default_rng(2).normal(0, 12, (60, 3))
    marker = Marker(0.1, ScanFilter(0.5, 30.0, -30.0, 30.0))
    marks = assert_equal_to_the_slow_one(marker, points, pose_at((0.0, 0.0, 0.0)))
    assert len(marks.keys) > 8
    monkeypatch.setattr(marking, "MAX_CHUNKS", 4)
    small = Marker(0.1, ScanFilter(0.5, 30.0, -30.0, 30.0))
    with pytest.raises(BadRequest, match="more than 4 chunks"):
        small.mark(points, pose_at((0.0, 0.0, 0.0)))
    assert_equal_to_the_slow_one(small, points[:1] / 100 + 0.5, pose_at((0.0, 0.0, 0.0)))


@pytest.mark.parametrize(
    ("points", "pose", "said"),
    [
        (np.zeros((3, 2)), np.eye(4), r"shape \(N, 3\)"),
        (np.zeros((3, 3)), np.eye(3), r"shape \(3, 4\)"),
        (np.zeros((3, 3)), 2 * np.eye(4), "a rotation"),
        (np.zeros((3, 3)), np.diag([1.0, 1.0, -1.0, 1.0]), "mirrors"),
        (np.zeros((3, 3)), pose_at((np.nan, 0.0, 0.0)), "a rotation and a finite position"),
        (np.zeros((3, 3)), pose_at((1.0737417e8, 0.0, 0.0)), "further than"),
        (np.zeros((3, 3)), pose_at((0.0, -5.4e7, 0.0)), "further than 5.369e"),
        (np.zeros((3, 3)), pose_at((0.0, 0.0, 1e300)), "further than"),
        (np.zeros((3, 3)), np.vstack([np.eye(4)[:3], [1.0, 2.0, 3.0, 1.0]]), "transposed"),
        (np.zeros((3, 3)), np.eye(4)[None], "shape"),
        (np.zeros((3, 3)), None, "pose: need an array of numbers"),
        (np.zeros((3, 3)), "identity", "pose: need an array of numbers"),
        (np.zeros((3, 3)), np.ma.masked_equal(np.eye(4), 1.0), "finite"),
        (None, np.eye(4), "points: need an array of numbers"),
        ([[1.0, 2.0, 3.0], [1.0]], np.eye(4), "points: need an array of numbers"),
        ([["a", "b", "c"]], np.eye(4), "points: need an array of numbers"),
        (np.zeros((3, 3), complex), np.eye(4), "points: need an array of numbers"),
        ([1.0, 2.0, 3.0], np.eye(4), "shape"),
    ],
)
def test_what_is_no_scan_is_refused(points: Any, pose: Any, said: str) -> None:
    with pytest.raises(BadRequest, match=said):
        Marker(0.1).mark(points, pose)


def test_lists_and_whole_numbers_are_scans_too() -> None:
    points = np.random.default_rng(4).integers(-8, 8, (50, 3))
    expected = sets_of(Marker(0.1).mark(points.astype(float), np.eye(4))[0])
    for same in (points, points.tolist(), points.astype(np.int16), np.asfortranarray(points)):
        assert sets_of(Marker(0.1).mark(same, np.eye(3, 4).tolist())[0]) == expected


@pytest.mark.parametrize("kind", [np.float32, np.float64, np.int32])
def test_points_that_are_masked_do_not_count(kind: type[np.generic]) -> None:
    """Not even where one coordinate of them is masked."""
    points = np.random.default_rng(4).integers(2, 9, (40, 3)).astype(kind)
    mask = np.zeros(points.shape, bool)
    mask[::4, 1] = mask[1] = True
    found, counts = Marker(0.1).mark(np.ma.MaskedArray(points, mask), np.eye(4))
    expected, _ = Marker(0.1).mark(points[~mask.any(axis=1)], np.eye(4))
    assert sets_of(found) == sets_of(expected)
    _, of_nan = Marker(0.1).mark(np.where(mask, np.nan, points.astype(float)), np.eye(4))
    assert counts == of_nan


def test_marks_come_in_the_order_of_their_chunks() -> None:
    points = np.random.default_rng(4).normal(0, 8, (300, 3))
    marks, _ = Marker(0.1, ScanFilter(0.5, 12.0, -30.0, 30.0)).mark(points, pose_at((-3.0, 5.0, 0.0)))
    keys = [tuple(key) for key in marks.keys.tolist()]
    assert keys == sorted(keys)
    assert len(keys) > 8


# --- marks as they are sent, byte by byte -----------------------------------------------------------------


MAP_ID = bytes(range(16))
MARKS = Marks(
    keys=np.array([[-1, 0, 2], [3, 0, 0]], np.int32),
    hits=np.array([1, 0], np.uint32),
    misses=np.array([1, 2], np.uint32),
    bits=np.array([1, 1 << 63, 0x0102030405060708, 2], np.uint64),
    words=np.array([4095, 7, 1, 258], np.uint16),
)
GOLDEN = (
    "53484d4d41524b530100000004030201"  # SHMMARKS, 1.0, byte order
    "000102030405060708090a0b0c0d0e0f"  # the map
    "07000000020000002a00000000000000"  # mapper 7, 2 chunks, scan 42
    "04000000000000000000000000000000"  # 4 words
    "ffffffff0000000002000000010000000100000000000000"  # -1, 0, 2: a word of hits, one of misses
    "030000000000000000000000000000000200000000000000"  # 3, 0, 0: two of misses
    "0100000000000000000000000000008008070605040302010200000000000000"
    "ff0f070001000201"
)  # fmt: skip


def test_golden_bytes_of_marks() -> None:
    data = encode_marks(MARKS, MAP_ID, 7, 42)
    assert data.hex() == GOLDEN
    assert len(data) == marks_bytes(2, 4)


def test_marks_there_and_back() -> None:
    marks = decode_marks(bytes.fromhex(GOLDEN), MAP_ID, 7, 42)
    for name in marks.__struct_fields__:
        assert np.array_equal(getattr(marks, name), getattr(MARKS, name)), name
    assert marks.starts.tolist() == [0, 2, 4]
    assert [key.text for key in marks.chunks] == ["-1_0_2", "3_0_0"]


def test_marks_of_nothing() -> None:
    nothing = Marks(MARKS.keys[:0], MARKS.hits[:0], MARKS.misses[:0], MARKS.bits[:0], MARKS.words[:0])
    assert len(decode_marks(encode_marks(nothing, MAP_ID, 1, 1), MAP_ID, 1, 1).keys) == 0


def patched(at: int, form: str, *values: object) -> Callable[[bytearray], None]:
    return lambda data: struct.pack_into(form, data, at, *values)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (patched(0, "<B", 0), "something else"),
        (patched(12, "<I", 0x04030201), "something else"),
        (patched(8, "<H", 2), r"version 2\.0"),
        (patched(16, "<B", 99), "not scan 42"),
        (patched(32, "<I", 8), "mapper 8"),
        (patched(40, "<Q", 43), "scan 43"),
        (patched(36, "<I", 4097), "4097 chunks"),
        (patched(36, "<I", 3), "not those of 3 chunks"),
        (patched(48, "<Q", 2**63), "bytes, not those"),
        (patched(48, "<Q", 5), "and 5 words"),
        (patched(64, "<i", 2**24), "further away"),
        (patched(64, "<i", -(2**31)), "further away"),
        (patched(64, "<3i", 3, 0, 0), "named twice"),
        (patched(76, "<I", 2), "more or fewer"),
        (patched(76, "<I", 2**32 - 1), "more or fewer"),
        (patched(144, "<H", 4096), "no place"),
        (patched(112, "<Q", 0), "no voxels"),
        (patched(148, "<H", 258), "rising order"),
    ],
)
def test_what_is_no_marks_is_refused(change: Callable[[bytearray], None], said: str) -> None:
    data = bytearray.fromhex(GOLDEN)
    change(data)
    with pytest.raises(BadRequest, match=said):
        decode_marks(bytes(data), MAP_ID, 7, 42)


def test_every_truncation_of_marks_is_refused() -> None:
    data = bytes.fromhex(GOLDEN)
    for size in range(len(data)):
        with pytest.raises(BadRequest):
            decode_marks(data[:size], MAP_ID, 7, 42)
    with pytest.raises(BadRequest):
        decode_marks(data + b"\0", MAP_ID, 7, 42)


def test_words_begin_again_with_each_list() -> None:
    """Rising within hits and within misses; nothing is said of one against the other."""
    marks = replace(MARKS, words=np.array([0, 0, 0, 1], np.uint16))
    assert decode_marks(encode_marks(marks, MAP_ID, 7, 42), MAP_ID, 7, 42).words.tolist() == [0, 0, 0, 1]
