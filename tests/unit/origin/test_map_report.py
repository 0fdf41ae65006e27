# SPDX-License-Identifier: Apache-2.0
"""What a divided map's report says: where its frame lies, and which cells lie far from all others."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from shmmap.errors import MapDataError
from shmmap.origin.map_directory import open_map
from shmmap.origin.map_report import (
    REPORT_HEAD,
    REPORT_NAME,
    UNKNOWN_FRAME,
    MapFrame,
    far_cells_notes,
    read_map_frame,
    read_report,
)
from tests.support.clouds import cloud_file, divide_quickly


@pytest.fixture
def moved_map(tmp_path: Path) -> Path:
    """A map of points in UTM, which `divide` moves."""
    xyz = np.array([[512000.25, 5403000.5, 300.0], [512030.0, 5403010.0, 301.0]])
    divide_quickly([cloud_file(tmp_path / "town.pcd", {"xyz": xyz})], tmp_path / "map")
    return tmp_path / "map"


def test_a_catalogue_knows_what_was_subtracted(moved_map: Path, tmp_path: Path) -> None:
    report = json.loads((moved_map / REPORT_NAME).read_bytes())
    assert report["origin"][0] > 500_000
    for path in (moved_map, moved_map / "pointcloud_map.pcd", moved_map / "pointcloud_map_metadata.yaml"):
        catalogue = open_map(path, cache_dir=tmp_path / "cache").load()
        assert catalogue.frame == MapFrame(origin=tuple(report["origin"])), path


@pytest.mark.parametrize("cached_from", [1, 2000])
def test_also_where_the_catalogue_comes_from_the_cache(
    moved_map: Path, tmp_path: Path, cached_from: int
) -> None:
    opened = replace(open_map(moved_map, cache_dir=tmp_path / "cache"), cached_from_cells=cached_from)
    assert [opened.load().frame.origin[0] > 500_000 for _ in range(2)] == [True, True]


@pytest.mark.parametrize(
    ("text", "frame"),
    [
        (None, UNKNOWN_FRAME),
        ("", UNKNOWN_FRAME),
        ("[" * 100_000, UNKNOWN_FRAME),
        ("[]", UNKNOWN_FRAME),
        (json.dumps({**REPORT_HEAD, "version": 99, "origin": [1, 2, 3]}), UNKNOWN_FRAME),
        (json.dumps({**REPORT_HEAD, "origin": [1, 2]}), UNKNOWN_FRAME),
        (json.dumps({**REPORT_HEAD, "origin": [1, 2, float("nan")]}), UNKNOWN_FRAME),
        (json.dumps({**REPORT_HEAD, "origin": [1e308, 0, 0]}), UNKNOWN_FRAME),
        (json.dumps({**REPORT_HEAD, "unit_m": [1, float("nan")]}), UNKNOWN_FRAME),
        (json.dumps({**REPORT_HEAD, "origin": [1, 2, 3], "unit_m": [0, 1]}), UNKNOWN_FRAME),
        (json.dumps({**REPORT_HEAD, "origin": [1, 2, 3]}), MapFrame((1.0, 2.0, 3.0))),
        # as earlier versions wrote it
        (json.dumps({**REPORT_HEAD, "origin": [1, 2, 3], "order": "morton"}), MapFrame((1.0, 2.0, 3.0))),
        (
            json.dumps({**REPORT_HEAD, "origin": [1, 2, 3], "crs": "UTM", "unit_m": [0.3048, 1]}),
            MapFrame((1.0, 2.0, 3.0), "UTM", (0.3048, 1.0)),
        ),
    ],
)
def test_a_report_of_any_kind_leaves_a_map(tmp_path: Path, text: str | None, frame: MapFrame) -> None:
    if text is not None:
        (tmp_path / REPORT_NAME).write_text(text)
    assert read_map_frame(tmp_path) == frame


def notes(corners: list[tuple[float, float]], size: float = 20.0, points: int = 100) -> list[str]:
    names = [f"{x:g}_{y:g}.pcd" for x, y in corners]
    return far_cells_notes(np.array(corners, np.float64).reshape(-1, 2), size, names, [points] * len(names))


TOWN = [(20.0 * i, 20.0 * j) for i in range(20) for j in range(20)]


@pytest.mark.parametrize(
    ("far", "said"),
    [
        ([(9000.0, 0.0)], ["1 cell lies 8.6 km from all others, with 100 points (stray ones?): 9000_0.pcd"]),
        ([(9000.0, 0.0), (9020.0, 0.0)], ["2 cells lie 8.6 km"]),
        ([(9000.0, 0.0), (0.0, -5000.0)], ["1 cell lies", "1 cell lies"]),
        ([(-640.0, 0.0)], ["1 cell lies 0.62 km"]),
        ([(580.0, 0.0)], []),
        ([(9000.0 + 20 * i, 0.0) for i in range(5)], []),
        ([], []),
    ],
)
def test_what_is_far(far: list[tuple[float, float]], said: list[str]) -> None:
    found = notes(TOWN + far)
    assert len(found) == len(said)
    assert all(any(words in note for note in found) for words in said)


def test_small_maps() -> None:
    assert notes([]) == notes([(0.0, 0.0)]) == notes([(0.0, 0.0), (20.0, 0.0)]) == []
    assert len(notes([(0.0, 0.0), (20.0, 0.0), (9000.0, 0.0)])) == 1
    assert notes([(500.0 * i, 0.0) for i in range(20)], size=500.0) == []


def test_divide_says_so(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    xyz = (rng.random((5000, 3)) * [60, 60, 8]).astype(np.float32)
    xyz[0] = [9000, 0, 0]
    made = divide_quickly([cloud_file(tmp_path / "a.pcd", {"xyz": xyz})], tmp_path / "map")
    (note,) = made.notes
    assert "km from all others, with 1 point (stray ones?): _9000_0.pcd" in note


def test_a_report_that_is_no_file_cannot_be_read(tmp_path: Path) -> None:
    (tmp_path / REPORT_NAME).mkdir()
    with pytest.raises(MapDataError, match="cannot be read: Is a directory"):
        read_report(tmp_path)
