# SPDX-License-Identifier: Apache-2.0
"""The height of the ground at a place: where points lie below the street, and on a recorded street."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import shmmap
from shmmap.layers.build import build_layer
from shmmap.layers.ground import GroundRule, ground_height
from tests.support.layer_oracles import fitted_height

Points = NDArray[np.float64]
SENSOR_HEIGHT_M = 1.73  # of KITTI's scanner


def street(slope: float = 0.0, density: float = 20.0) -> Points:
    """Return ground of 40 m x 40 m about the origin, 1 cm of noise, (N, 3)."""
    rng = np.random.default_rng(5)
    xy = rng.uniform(-20, 20, (int(1600 * density), 2))
    return np.column_stack([xy, slope * xy[:, 0] + rng.normal(0.0, 0.01, len(xy))])


def patch(size: float, z: float, at: tuple[float, float] = (0.0, 0.0), density: float = 20.0) -> Points:
    """Return a square of points at one height."""
    rng = np.random.default_rng(6)
    xy = rng.uniform(-size / 2, size / 2, (int(size * size * density), 2)) + at
    return np.column_stack([xy, np.full(len(xy), z)])


def height_at(
    xyz: NDArray[Any], x: float = 0.0, y: float = 0.0, rule: GroundRule = "median", resolution: float = 0.5
) -> float:
    """Return the height from the ground layers of two cells that meet at x = 0."""
    grids = []
    for part in (xyz[xyz[:, 0] < 0], xyz[xyz[:, 0] >= 0]):
        layer = build_layer(f"ground(resolution={resolution})", part)
        assert layer.lattice is not None
        grids.append((layer["min"], layer.lattice))
    found = ground_height(grids, x, y, rule=rule)
    assert found is not None
    return found


def pit(xyz: Points) -> Points:
    """Lower a square of 2 m, 3 m deep, as an excavation has it."""
    inside = (np.abs(xyz[:, :2]) < 1.0).all(axis=1)
    return np.concatenate([xyz[~inside], patch(2.0, -3.0)])


SCENES: dict[str, Callable[[], Points]] = {
    "nothing": street,
    "a stray low point": lambda: np.concatenate([street(), [[0.1, 0.1, -5.6]]]),
    "a pit": lambda: pit(street()),
    "reflections": lambda: np.concatenate([street(), patch(4.0, -3.0, (0.7, -0.4))]),
    "stray points everywhere": lambda: np.concatenate([street(), patch(40.0, -4.0, density=0.3)]),
    "a ditch along the street": lambda: np.concatenate([street(), patch(2.0, -1.5, (1.5, 0.0))]),
    "a facade and a canopy": lambda: np.concatenate(
        [
            street(),
            patch(12.0, 5.0),
            [[2.0, y, z] for y in np.arange(-9, 9, 0.2) for z in np.arange(0, 6, 0.2)],
        ]
    ),
    "few points": lambda: np.concatenate([street(density=0.3), [[0.0, 0.0, -3.0]]]),
}


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("resolution", [0.25, 0.5, 1.0])
def test_what_lies_below_the_street_is_not_the_ground(scene: str, resolution: float) -> None:
    assert height_at(SCENES[scene](), resolution=resolution) == pytest.approx(0.0, abs=0.05)


def test_autowares_rule_is_there_by_name() -> None:
    for scene, lowest in (("a stray low point", -5.6), ("a pit", -3.0), ("reflections", -3.0)):
        xyz = SCENES[scene]()
        assert height_at(xyz, rule="min") == pytest.approx(lowest, abs=0.01)
        assert fitted_height(xyz, 0.0, 0.0) == pytest.approx(lowest, abs=0.01)
    with pytest.raises(shmmap.BadRequest, match="unknown rule of the ground 'lowest'"):
        height_at(street(), rule="lowest")  # type: ignore[arg-type]


def test_a_slope_is_met_in_the_middle() -> None:
    sloping = street(slope=0.1)
    for x in (-8.0, 0.3, 7.1):
        assert height_at(sloping, x) == pytest.approx(0.1 * x, abs=0.06)
        assert height_at(sloping, x, rule="min") < 0.1 * x - 0.07


def test_of_two_columns_the_upper_counts() -> None:
    assert height_at(np.array([[0.2, 0.2, 1.0], [0.8, 0.2, -4.0]])) == 1.0


def test_a_recorded_street(data_dir: Path) -> None:
    layer = build_layer("ground", shmmap.read_cloud(data_dir / "kitti0005_map" / "map_static_v010.pcd").xyz)
    assert layer.lattice is not None
    grids = [(layer["min"], layer.lattice)]
    poses = np.loadtxt(data_dir / "kitti0005_scans" / "poses_all_tum.txt")
    rules: tuple[GroundRule, ...] = ("median", "min")
    found = [[ground_height(grids, x, y, rule=rule) for rule in rules] for x, y in poses[:, 1:3]]
    off = np.array(found, np.float64) - (poses[:, 3:4] - SENSOR_HEIGHT_M)
    assert np.abs(off[:, 0]).max() < 0.1
    assert off[:, 1].min() < -3.5, "reflections, as the fitter finds them"
