# SPDX-License-Identifier: Apache-2.0
"""Surfaces, seams, holes and the grid file, each against something slower and simpler."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from shmmap_clients.elevation_map import holes, surface
from shmmap_clients.elevation_map.grid import FILLED, MEASURED, NOTHING, ElevationGrid
from shmmap_clients.elevation_map.heights import ElevationRule
from shmmap_clients.elevation_map.seams import Columns, Seams, column_boxes

from shmmap import BadRequest


def slow_surface(xyz: NDArray[np.float64], rule: ElevationRule) -> float:
    """The rule by its words: grow clusters from seeds, keep the large ones, choose."""
    left = set(range(len(xyz)))
    clusters = []
    while left:
        cluster, edge = [], [left.pop()]
        while edge:
            member = edge.pop()
            cluster.append(member)
            near = [k for k in left if ((xyz[k] - xyz[member]) ** 2).sum() <= rule.tolerance**2]
            left -= set(near)
            edge += near
        if len(cluster) >= rule.min_points:
            clusters.append((float(xyz[cluster, 2].mean()), len(cluster)))
    if not clusters or len(xyz) < rule.min_points:
        return float("nan")
    lowest = min(mean for mean, _ in clusters)
    return max((c for c in clusters if c[0] - lowest <= rule.height_range), key=lambda c: (c[1], -c[0]))[0]


@pytest.mark.parametrize("rule", [ElevationRule(), ElevationRule("surface", 0.5, 0.1, 0.4, 2)])
@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), (89_560.0, -42_340.0, 700.0)])
def test_the_surface_is_the_chosen_clusters_mean(
    rule: ElevationRule, origin: tuple[float, float, float]
) -> None:
    rng = np.random.default_rng(3)
    xyz, column = [], []
    for n in range(150):
        size = int(rng.integers(1, 40))
        levels = rng.choice([0.0, 0.05, 0.6, 0.9, 1.4, 3.0], size=(size, 1))
        part = np.column_stack([rng.uniform(0, rule.resolution, (size, 2)), levels])
        part[:, 2] += rng.normal(0, 0.03, size)
        xyz.append(part + origin)
        column += [n * 3 + 7] * size
    every = np.concatenate(xyz)
    mixed = rng.permutation(len(every))
    columns, heights = surface.surface_heights(every[mixed], np.array(column)[mixed], rule)
    assert columns.tolist() == [n * 3 + 7 for n in range(150)]
    expected = np.array([slow_surface(part, rule) for part in xyz])
    assert np.array_equal(np.isnan(heights), np.isnan(expected))
    assert np.nanmax(np.abs(heights - expected)) < 1e-9
    assert 0 < np.isnan(expected).sum() < 75


def test_rules_are_checked() -> None:
    assert ElevationRule().layer == "points"
    assert ElevationRule("min", 0.5).layer == "elevation(resolution=0.5)"
    for rule, resolution, points in (
        ("low", 0.3, 3),
        ("min", 0.0, 3),
        ("min", float("nan"), 3),
        ("min", 1.0, 0),
    ):
        with pytest.raises(BadRequest):
            ElevationRule(rule, resolution, min_points=points)


def test_cells_of_any_size_find_those_that_share_their_columns() -> None:
    rng = np.random.default_rng(6)
    low = rng.integers(-60, 60, (80, 2))
    boxes = np.hstack([low, low + rng.integers(1, 30, (80, 2))])
    seams = Seams(boxes)
    for number, box in enumerate(boxes):
        j, i = np.mgrid[box[1] : box[3], box[0] : box[2]]
        seams.add(number, Columns(i.ravel(), j.ravel(), np.full(i.size, number)))
        left = {(i, j) for rows in seams.waiting.values() for i, j in zip(rows.i, rows.j, strict=True)}
        come, coming = (
            {(i, j) for b in part for i in range(b[0], b[2]) for j in range(b[1], b[3])}
            for part in (boxes[: number + 1], boxes[number + 1 :])
        )
        assert left == come & coming


@pytest.mark.parametrize("order", ["rows", "random", "reverse"])
@pytest.mark.parametrize("resolution", [0.3, 0.5, 0.7])
def test_every_column_is_released_once_and_whole(order: str, resolution: float) -> None:
    rng = np.random.default_rng(9)
    xy = rng.uniform(-20, 40, (20_000, 2))
    corners = [(x, y) for y, x in itertools.product((-20.0, 0.0, 20.0), repeat=2)]
    corners.pop(4)  # a cell that the map does not have
    if order == "reverse":
        corners.reverse()
    elif order == "random":
        corners = [corners[n] for n in rng.permutation(len(corners))]
    boxes = column_boxes(np.array([(x, y, x + 20, y + 20) for x, y in corners]), resolution)
    seams = Seams(boxes)
    seen: dict[tuple[int, int], list[int]] = {}
    peak = 0
    for number, (x, y) in enumerate(corners):
        mine = np.flatnonzero((np.floor(xy / 20.0) * 20.0 == (x, y)).all(axis=1))
        index = np.floor(xy[mine] / resolution).astype(np.int64)
        done = seams.add(number, Columns(index[:, 0], index[:, 1], mine))
        peak = max(peak, sum(len(rows) for rows in seams.waiting.values()))
        if done is None:
            continue
        released: dict[tuple[int, int], list[int]] = {}
        for i, j, value in zip(done.i.tolist(), done.j.tolist(), done.values.tolist(), strict=True):
            released.setdefault((i, j), []).append(value)
        assert not released.keys() & seen.keys()
        seen.update(released)
    assert not seams.waiting
    assert 0 < peak < 4000
    expected: dict[tuple[int, int], list[int]] = {}
    hole = (np.floor(xy / 20.0) * 20.0 == (0.0, 0.0)).all(axis=1)
    for n in np.flatnonzero(~hole).tolist():
        i, j = np.floor(xy[n] / resolution).astype(int).tolist()
        expected.setdefault((i, j), []).append(n)
    assert {key: sorted(values) for key, values in seen.items()} == expected


def test_a_cell_without_rows_still_ends_what_waits_for_it() -> None:
    seams = Seams(np.array([(0, 0, 5, 5), (4, 0, 9, 5)]))
    rows = Columns(np.array([4, 1]), np.array([2, 2]), np.array([7.0, 8.0]))
    first = seams.add(0, rows)
    assert first is not None
    assert first.values.tolist() == [8.0]
    second = seams.add(1, None)
    assert second is not None
    assert second.values.tolist() == [7.0]


@pytest.mark.parametrize("radius", [1.0, 2.5, 3.3])
def test_a_plane_goes_on_through_holes(radius: float) -> None:
    rng = np.random.default_rng(1)
    x, y = np.meshgrid(np.arange(60.0), np.arange(40.0))
    plane = (900.0 + 0.11 * x - 0.07 * y).astype(np.float32)
    heights = plane.copy()
    heights[rng.random(plane.shape) < 0.3] = np.nan
    heights[10:25, 20:40] = np.nan
    heights[:, 45:] = np.nan
    heights[20, 52] = plane[20, 52]  # a lonely one
    filled = holes.fill_holes(heights, radius)
    known = ~np.isnan(heights)
    assert np.array_equal(filled[known], heights[known])
    new = np.isnan(heights) & ~np.isnan(filled)
    near, count = np.zeros(plane.shape, np.bool_), np.zeros(plane.shape, int)
    reach = int(radius + 2)
    padded = np.pad(known, reach)
    for dy in range(-reach, reach + 1):
        for dx in range(-reach, reach + 1):
            there = padded[reach + dy : reach + dy + 40, reach + dx : reach + dx + 60]
            near |= there & (dx * dx + dy * dy <= radius * radius)
            count += there & (dx * dx + dy * dy <= (radius + 2) ** 2)
    near &= known | (count >= 3)
    assert np.array_equal(~np.isnan(filled), near)
    # where a plane is determined: three neighbours not on one line; elsewhere their mean, near by
    assert np.abs(filled - plane)[new].max() < 0.13 * radius + 0.01
    if radius > 2:
        assert np.percentile(np.abs(filled - plane)[new], 95) < 1e-3


@pytest.mark.parametrize(
    ("resolution", "radius"), [(0.2, 0.6), (0.1, 0.3), (0.3, 0.9), (0.5, 1.5), (0.7, 2.1)]
)
def test_a_radius_of_three_columns_reaches_three_columns(
    tmp_path: Path, resolution: float, radius: float
) -> None:
    grid = ElevationGrid.create(tmp_path / "heights", resolution, (0, 0), (1, 9))
    grid.put(np.arange(3), np.zeros(3, np.int64), np.ones(3))
    _, kind = grid.filled(0, 1, radius)
    assert kind[0].tolist() == [MEASURED] * 3 + [FILLED] * 3 + [NOTHING] * 3


def test_blocks_fill_as_the_whole_does(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    heights = rng.normal(700, 1, (50, 30)).astype(np.float32)
    heights[rng.random(heights.shape) < 0.6] = np.nan
    grid = ElevationGrid.create(tmp_path / "grid", 0.5, (-10, 20), heights.shape)
    j, i = np.nonzero(~np.isnan(heights))
    half = len(i) // 2
    grid.put(i[:half] - 10, j[:half] + 20, heights[j[:half], i[:half]].astype(np.float64))
    grid.put(i[half:] - 10, j[half:] + 20, heights[j[half:], i[half:]].astype(np.float64))
    assert grid.origin == (-5.0, 10.0)
    assert np.array_equal(grid.rows(0, 50), heights, equal_nan=True)
    outside = grid.rows(-3, 52)
    assert np.isnan(outside[:3]).all()
    assert np.isnan(outside[-2:]).all()
    whole = holes.fill_holes(heights, 2.0)
    for begin, end in ((0, 50), (0, 7), (7, 31), (49, 50)):
        values, kind = grid.filled(begin, end, 1.0)
        assert np.array_equal(values, whole[begin:end], equal_nan=True)
        assert np.array_equal(kind == MEASURED, ~np.isnan(heights[begin:end]))
        assert np.array_equal(kind == NOTHING, np.isnan(whole[begin:end]))
        assert ((kind == FILLED) == (~np.isnan(values) & np.isnan(heights[begin:end]))).all()
    for left, right in ((0, 7), (7, 30), (-4, 3), (25, 41)):
        values, kind = grid.filled(-5, 31, 1.0, left=left, right=right)
        expected = np.pad(whole, ((5, 0), (4, 11)), constant_values=np.nan)[:36, left + 4 : right + 4]
        assert np.array_equal(values, expected, equal_nan=True)
        assert np.array_equal(kind == NOTHING, np.isnan(expected))
    plain, kind = grid.filled(5, 9, 0.0)
    assert np.array_equal(plain, heights[5:9], equal_nan=True)
    assert FILLED not in kind
