# SPDX-License-Identifier: Apache-2.0
"""A map's catalogue knows where its frame lies, as the divided map beside it says."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from shmmap.dividing.divide import divide
from shmmap.dividing.settings import DivideSettings
from shmmap.formats.pcd.writer import write_pcd
from shmmap.origin.map_directory import open_map
from shmmap.origin.map_report import REPORT_HEAD, REPORT_NAME, UNKNOWN_FRAME, MapFrame, read_map_frame


@pytest.fixture
def moved_map(tmp_path: Path) -> Path:
    """A map of points in UTM, which `divide` moves."""
    xyz = np.array([[512000.25, 5403000.5, 300.0], [512030.0, 5403010.0, 301.0]])
    write_pcd(tmp_path / "town.pcd", {"x": xyz[:, 0], "y": xyz[:, 1], "z": xyz[:, 2]})
    divide([tmp_path / "town.pcd"], tmp_path / "map", DivideSettings(durable=False))
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
    from dataclasses import replace

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


def test_another_tool_s_map_has_none(moved_map: Path, tmp_path: Path) -> None:
    (moved_map / REPORT_NAME).unlink()
    assert open_map(moved_map, cache_dir=tmp_path / "cache").load().frame == UNKNOWN_FRAME
