# SPDX-License-Identifier: Apache-2.0
"""Maps published in millimetres: points, layers and halos of the rounded points, and back to exact ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.support.command_line import Verbs
from tests.support.divided_map import DividedMap, make_map
from tests.support.published_maps import PublishedMapReader
from tests.support.skips import open3d_or_skip

pytest.importorskip("zstandard", reason="zstandard is not installed")

LAYERS = ("ndt(leaf=2.0,min_points=3)", "voxel(leaf=0.5)", "elevation(resolution=1.0)")


@pytest.fixture
def town(tmp_path: Path) -> DividedMap:
    return make_map(tmp_path / "town", columns=2, rows=1, points=2000)


def options(layers: tuple[str, ...]) -> list[str]:
    return ["--id-prefix", "/m/", *(word for layer in layers for word in ("--layer", layer))]


def test_points_are_rounded_and_layers_are_of_the_rounded_points(
    shmmap: Verbs, town: DividedMap, tmp_path: Path
) -> None:
    open3d_or_skip()
    layers = (*LAYERS, "normals(radius=2.0)")  # which looks into the neighbour
    shmmap("prepare", town.root, "--layer", LAYERS[0])  # of exact points: not what is published
    done = shmmap.json("publish", town.root, tmp_path / "mm", "--encoding", "mm", *options(layers))
    assert done["encoding"] == "mm"
    rounded = PublishedMapReader(tmp_path / "mm")
    assert rounded.root["encoding"] == "mm"
    for name in town.corners:
        source, cell = town.points(name), rounded.cells["/m/" + name]
        found = cell.columns["points"]
        order = [np.flatnonzero(source["intensity"] == value) for value in found["intensity"]]
        assert cell.points == len(found["xyz"]) == len(source["x"])
        xyz = np.column_stack([source["x"], source["y"], source["z"]])
        moved = [
            np.abs(xyz[rows] - point).max(axis=1).min()
            for rows, point in zip(order, found["xyz"], strict=True)
        ]
        assert 1e-5 < max(moved) < 0.00051
        assert cell.z == (found["xyz"][:, 2].min(), found["xyz"][:, 2].max())
    # fetched, these points are a map of their own: published exactly, it has the same layers
    shmmap("fetch", tmp_path / "mm", tmp_path / "back")
    shmmap("publish", tmp_path / "back", tmp_path / "exact", *options(layers))
    exact = PublishedMapReader(tmp_path / "exact")
    for cell_id, cell in rounded.cells.items():
        assert len(cell.columns) == 5
        for layer, columns in cell.columns.items():
            other = exact.cells[cell_id].columns[layer]
            assert columns.keys() == other.keys()
            for name in columns:
                assert columns[name].tobytes() == other[name].tobytes(), (layer, name)


def test_the_encoding_stays_until_another_is_named(shmmap: Verbs, town: DividedMap, tmp_path: Path) -> None:
    store = tmp_path / "store"

    def publish(*words: str) -> tuple[int, bool, str, int]:
        done = shmmap.json("publish", town.root, store, *words)
        return done["version"], done["changed"], done["encoding"], done["sent_objects"]

    assert publish()[:3] == (1, True, "exact")
    assert publish("--encoding", "mm") == (2, True, "mm", 5)  # two cells, two shards, root
    assert publish() == (2, False, "mm", 0)
    town.change("0_0.pcd", 5)
    assert publish() == (3, True, "mm", 3)
    assert publish("--encoding", "exact")[:3] == (4, True, "exact")
    sizes = [row["bytes"] for row in shmmap.json("versions", store)["versions"]]
    assert len(sizes) == 4
    assert "invalid choice" in shmmap("publish", town.root, store, "--encoding", "cm", code=2)


def test_cells_that_have_to_stay_exact_do(shmmap: Verbs, tmp_path: Path) -> None:
    """A cell of 100 m beside one of 20 m, say: one map, both kinds."""
    town = make_map(tmp_path / "town", columns=2, rows=1, points=500)
    wide = town.points("0_0.pcd")
    wide["z"][0] = 80.0
    town.write_cell("0_0.pcd", town.corners["0_0.pcd"], wide)
    shmmap("publish", town.root, tmp_path / "mm", "--encoding", "mm", "--id-prefix", "/m/")
    read = PublishedMapReader(tmp_path / "mm")
    found = read.cells["/m/0_0.pcd"].columns["points"]["xyz"]
    assert found.tobytes() == np.column_stack([wide["x"], wide["y"], wide["z"]]).tobytes()
    source = town.points("-20_0.pcd")
    other = read.cells["/m/-20_0.pcd"].columns["points"]["xyz"]
    assert other.tobytes() != np.column_stack([source["x"], source["y"], source["z"]]).tobytes()
