# SPDX-License-Identifier: Apache-2.0
"""A stray point kilometres off a map: what it costs, and what is left out."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from shmmap_clients.elevation_map.far_cells import far_cells
from shmmap_clients.elevation_map.grid import ElevationGrid
from shmmap_clients.elevation_map.output import write_elevation


def squares(*corners: tuple[float, float], edge: float = 20.0) -> NDArray[np.float64]:
    low = np.array(corners, np.float64)
    return np.hstack([low, low + edge])


TOWN = [(x, y) for x in (0, 20, 40) for y in (0, 20, 40)]


@pytest.mark.parametrize(
    ("stray", "metres"),
    [
        ([(9000, 0)], [8940.0]),
        ([(-6420, -6420)], [9050.97]),
        ([(0, 90_000), (90_000, 0), (90_020, 0)], [89_940.0, 89_940.0, 89_960.0]),
        ([(5e6, 5e6)], [7.0709831e6]),
    ],
)
def test_a_stray_cell_is_far(stray: list[tuple[float, float]], metres: list[float]) -> None:
    boxes = squares(*TOWN, *stray)
    sizes = np.array([100_000] * 9 + [250] * len(stray))
    order = np.random.default_rng(0).permutation(len(boxes))
    far = far_cells(boxes[order], sizes[order])[np.argsort(order)]
    assert far[:9].tolist() == [0.0] * 9
    assert far[9:] == pytest.approx(metres, rel=1e-6)


@pytest.mark.parametrize(
    ("others", "size"),
    [
        ([(9000, 0)], 100_000),  # a part of a map, not a point
        ([(300, 0)], 250),  # near
        ([(900 * n, 0) for n in range(1, 12)], 250),  # a road leads there
        ([], 250),
    ],
)
def test_what_belongs_to_the_map_stays(others: list[tuple[float, float]], size: int) -> None:
    boxes = squares(*TOWN, *others)
    sizes = np.array([100_000] * 9 + [size] * len(others))
    assert not far_cells(boxes, sizes).any()
    # one cell and one stray point beside it; equal ones are both kept
    two = squares((0, 0), (9000, 9000))
    assert (far_cells(two, np.array([50_000, 300])) > 0).tolist() == [False, True]
    assert not far_cells(two, np.array([300, 300])).any()
    assert not far_cells(two, np.array([0, 0])).any()


def test_what_no_cell_covers_is_not_looked_at(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two small parts of a map at two corners: heights as without boxes, and few columns are read."""
    rng = np.random.default_rng(0)
    side = 900
    boxes = np.array([(100, 200, 160, 250), (900, 1000, 990, 1060), (130, 240, 200, 300)], np.int64)
    grids = [
        ElevationGrid(tmp_path / "grid", 0.3, (100, 200), (side, side), which) for which in (None, boxes)
    ]
    ElevationGrid.create(tmp_path / "grid", 0.3, (100, 200), (side, side))
    for i0, j0, i1, j1 in boxes.tolist():
        i, j = np.meshgrid(np.arange(i0, i1), np.arange(j0, j1))
        some = rng.random(i.shape) < 0.6
        grids[0].put(i[some], j[some], rng.uniform(0, 3, int(some.sum())))
    read = 0
    rows = ElevationGrid.rows

    def counted(self: ElevationGrid, *where: int) -> NDArray[np.float32]:
        nonlocal read
        found = rows(self, *where)
        read += found.size
        return found

    monkeypatch.setattr(ElevationGrid, "rows", counted)
    for margin in (0, 1):
        every, few = (
            [(begin, heights.copy(), kind.copy()) for begin, heights, kind in grid.blocks(1.0, margin=margin)]
            for grid in grids
        )
        for (a, heights, kind), (b, others, kinds) in zip(every, few, strict=True):
            assert a == b
            assert np.array_equal(heights, others, equal_nan=True)
            assert np.array_equal(kind, kinds)
    read = 0
    for _ in grids[1].blocks(1.0):
        pass
    assert 0 < read < side * side // 10
    write_elevation(tmp_path / "few.tif", grids[1], 1.0, {})
    write_elevation(tmp_path / "every.tif", grids[0], 1.0, {})
    assert (tmp_path / "few.tif").read_bytes() == (tmp_path / "every.tif").read_bytes()
