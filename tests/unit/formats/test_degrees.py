# SPDX-License-Identifier: Apache-2.0
"""Clouds in degrees are warned about; clouds in metres are not, however small they are."""

from __future__ import annotations

import struct
from pathlib import Path

import laspy
import numpy as np
import pytest

from shmmap.dividing.divide import divide
from shmmap.dividing.settings import DivideSettings
from shmmap.formats.cloud import describe
from shmmap.formats.coordinate_system import GEOGRAPHIC_SYSTEM, degrees_warning
from shmmap.formats.pcd.writer import write_pcd
from shmmap.origin.map_directory import load_single_pcd


@pytest.mark.parametrize(
    ("low", "high", "warned"),
    [
        ((8.40, 49.00, 110.0), (8.43, 49.02, 160.0), True),  # a town in Germany
        ((-122.5, 37.7, 0.0), (-122.3, 37.9, 280.0), True),
        ((139.6, 35.6, -5.0), (139.8, 35.7, 40.0), True),
        ((-80.0, -60.0, -2.0), (90.0, 70.0, 12.0), False),  # a LiDAR scan
        ((0.0, 0.0, 0.0), (20.0, 20.0, 8.0), False),  # one cell
        ((-0.1, -0.1, 0.0), (0.1, 0.1, 0.2), False),  # a bunny
        ((5.0, 6.0, 0.0), (5.3, 6.3, 4.0), False),  # a lamp post
        ((512000.0, 5403000.0, 300.0), (512000.1, 5403000.1, 350.0), False),
        ((np.nan,) * 3, (np.nan,) * 3, False),
    ],
)
def test_what_looks_like_degrees(low: tuple[float, ...], high: tuple[float, ...], warned: bool) -> None:
    warning = degrees_warning(np.array(low), np.array(high))
    assert bool(warning) == warned
    assert ("look like degrees" in warning) == warned


def town() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(1)
    return {"x": 8.4 + rng.random(500) * 0.02, "y": 49.0 + rng.random(500) * 0.02, "z": rng.random(500) * 40}


def test_inspect_divide_and_serve_say_so(tmp_path: Path) -> None:
    write_pcd(tmp_path / "town.pcd", town())
    (warning,) = describe(tmp_path / "town.pcd").warnings
    assert "look like degrees" in warning
    made = divide([tmp_path / "town.pcd"], tmp_path / "map", DivideSettings(durable=False))
    assert [note for note in made.notes if "look like degrees" in note]
    (problem,) = load_single_pcd(str(tmp_path / "town.pcd")).problems
    assert "look like degrees" in problem


@pytest.mark.parametrize(("model", "named"), [(2, True), (1, False), (None, False)])
@pytest.mark.parametrize("where", ["keys", "plain", "compound", "extended"])
def test_a_geographic_system_in_a_las_file(
    tmp_path: Path, model: int | None, named: bool, where: str
) -> None:
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales = np.full(3, 1e-7)
    record = None
    if model is not None and where != "keys":
        plane = 'GEOGCS["WGS 84",DATUM["D"]]' if named else 'PROJCS["UTM 32N",GEOGCS["WGS 84"],UNIT["m",1]]'
        wkt = {"plain": plane}.get(where, f'COMPD_CS["both",{plane},VERT_CS["h",UNIT["metre",1]]]')
        record = laspy.vlrs.known.WktCoordinateSystemVlr(wkt)
        if where != "extended":
            header.vlrs.append(record)
    elif model is not None:
        keys = struct.pack("<4H4H", 1, 1, 0, 1, 1024, 0, 1, model)
        header.vlrs.append(laspy.VLR("LASF_Projection", 34735, "GeoKeyDirectoryTag", keys))
    las = laspy.LasData(header)
    if record is not None and where == "extended":
        las.evlrs = laspy.vlrs.vlrlist.VLRList([record])
    las.x, las.y, las.z = np.arange(3.0), np.arange(3.0), np.arange(3.0)
    las.write(str(tmp_path / "in.las"))
    assert (GEOGRAPHIC_SYSTEM in describe(tmp_path / "in.las").warnings) == named
    made = divide([tmp_path / "in.las"], tmp_path / "map", DivideSettings(durable=False))
    assert any(GEOGRAPHIC_SYSTEM in note for note in made.notes) == named
