# SPDX-License-Identifier: Apache-2.0
"""Versions of computed layers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from xxhash import xxh3_64_intdigest

from shmmap.layers import versions as layer_versions
from shmmap.layers.versions import LayerVersions
from shmmap.origin.map_directory import open_map
from tests.support.divided_map import make_map, random_points

NDT = "ndt(leaf=5.0,min_points=3)"


def test_a_layer_has_its_cell_s_version_unless_it_looks_farther(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = make_map(tmp_path / "map", columns=4, rows=4, points=5)
    catalogue = open_map(str(made.root), cache_dir=str(tmp_path / "cache")).load()
    versions = LayerVersions(lambda: catalogue)
    index = catalogue.find(made.id("0_0.pcd"))
    assert index is not None
    for layer in ("points", NDT, "crop(z_max=1.0)"):
        assert versions.version(index, layer) == catalogue.version(index)
        assert versions.neighbours(index, layer) == []
    for layer in ("normals(radius=2.0)", "denoise", "ndt(leaf=2.0,of=denoise)"):
        around = versions.neighbours(index, layer)
        names = {catalogue.id(i).rsplit("/", 1)[1] for i in around}
        assert names == {f"{x}_{y}.pcd" for x in (-20, 0, 20) for y in (-20, 0, 20)} - {"0_0.pcd"}
        packed = np.array([catalogue.version(i) for i in (index, *sorted(around))], "<u8").tobytes()
        assert versions.version(index, layer) == xxh3_64_intdigest(packed)
    before = {i: versions.version(i, "denoise") for i in range(len(catalogue))}
    monkeypatch.setattr(layer_versions, "MOST_REMEMBERED", 4)
    assert {i: versions.version(i, "denoise") for i in before} == before
    for number in range(10):  # whoever asks for ever new layers fills no memory
        versions.version(0, f"normals(radius={number + 1}.0)")
    assert len(versions._versions) <= 4
    made.write_cell("20_20.pcd", (20, 20), random_points(np.random.default_rng(3), (20, 20), 6))
    catalogue = open_map(str(made.root), cache_dir=str(tmp_path / "cache")).load(fresh=True)
    versions.forget()
    changed = {
        catalogue.id(i).rsplit("/", 1)[1] for i in before if versions.version(i, "denoise") != before[i]
    }
    assert changed == {"0_0.pcd", "0_20.pcd", "20_0.pcd", "20_20.pcd"}
