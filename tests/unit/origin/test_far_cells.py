# SPDX-License-Identifier: Apache-2.0
"""A stray point makes a cell far from all others, which is named; two towns are a map."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from shmmap.dividing.divide import divide
from shmmap.dividing.settings import DivideSettings
from shmmap.formats.pcd.writer import write_pcd
from shmmap.origin.map_report import far_cells_notes


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
    write_pcd(tmp_path / "a.pcd", {axis: xyz[:, i] for i, axis in enumerate("xyz")})
    made = divide([tmp_path / "a.pcd"], tmp_path / "map", DivideSettings(durable=False))
    (note,) = made.notes
    assert "km from all others, with 1 point (stray ones?): _9000_0.pcd" in note
