# SPDX-License-Identifier: Apache-2.0
"""Versions of layers: other bytes have another one, and nothing else has."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from shmmap.errors import BadRequest
from shmmap.layers import spec
from shmmap.layers import versions as layer_versions
from shmmap.layers.spec import layer_spec
from shmmap.layers.versions import LayerVersions
from shmmap.origin.catalogue import Catalogue
from shmmap.origin.map_directory import open_map
from shmmap.segment.layout import SourceStamp
from shmmap.segment.version import layer_version
from tests.support.divided_map import DividedMap, make_map, random_points

NDT = "ndt(leaf=5.0,min_points=3)"
PLAIN = ["points", NDT, "crop(z_max=1.0)", "voxel(leaf=1.0)"]
FAR = ["normals(radius=2.0)", "denoise", "ndt(leaf=2.0,of=denoise)"]


class Map:
    """A map of sixteen cells as a daemon knows it."""

    def __init__(self, directory: Path) -> None:
        self._cache = str(directory / "cache")
        self.made: DividedMap = make_map(directory / "map", columns=4, rows=4, points=5)
        self.read()

    def read(self) -> LayerVersions:
        """Read the map again."""
        self.catalogue: Catalogue = open_map(str(self.made.root), cache_dir=self._cache).load(fresh=True)
        self.versions = LayerVersions(lambda: self.catalogue)
        return self.versions

    def index(self, name: str) -> int:
        index = self.catalogue.find(self.made.id(name))
        assert index is not None
        return index

    def all(self, layers: list[str]) -> dict[tuple[str, str], int]:
        """Version of every layer of every cell, by name."""
        cells = {name: self.index(name) for name in self.made.corners}
        return {(n, layer): self.versions.version(i, layer) for n, i in cells.items() for layer in layers}


@pytest.fixture
def one(tmp_path: Path) -> Map:
    return Map(tmp_path)


@pytest.fixture
def kinds_as_before() -> Iterator[None]:
    before = dict(spec._own)
    yield
    spec._own.update(before)
    forget_kinds()


def forget_kinds() -> None:
    layer_spec.cache_clear()
    layer_versions._kind.cache_clear()


def others(before: dict[tuple[str, str], int], after: dict[tuple[str, str], int]) -> set[tuple[str, str]]:
    return {key for key in before if before[key] != after[key]}


AROUND_0_0 = {f"{x}_{y}.pcd" for x in (-20, 0, 20) for y in (-20, 0, 20)}


def test_every_layer_has_its_own(one: Map) -> None:
    versions = one.all([*PLAIN, *FAR])
    assert len(set(versions.values())) == len(versions)
    index, cell = one.index("0_0.pcd"), one.catalogue.version
    assert versions["0_0.pcd", "points"] == cell(index)
    assert versions["0_0.pcd", NDT] == layer_version(cell(index), NDT, 1)
    for layer in PLAIN:
        assert one.versions.neighbours(index, layer) == []
    for layer in FAR:
        around = one.versions.neighbours(index, layer)
        assert {one.catalogue.id(i).rsplit("/", 1)[1] for i in around} == AROUND_0_0 - {"0_0.pcd"}
        near = [cell(i) for i in sorted(around)]
        built = layer_spec(layer).builder_version
        assert versions["0_0.pcd", layer] == layer_version(cell(index), layer, built, near)


def test_a_box_that_is_edited_changes_every_layer(one: Map) -> None:
    before = one.all([*PLAIN, *FAR])
    one.made.corners["0_0.pcd"] = (0, 1)
    one.made.write_metadata()
    one.read()
    changed = others(before, one.all([*PLAIN, *FAR]))
    assert {layer for name, layer in changed if name == "0_0.pcd"} == {*PLAIN, *FAR}
    assert {name for name, layer in changed if layer in PLAIN} == {"0_0.pcd"}


def test_a_file_that_changes_changes_its_layers_and_those_that_look_into_it(one: Map) -> None:
    before = one.all([*PLAIN, *FAR])
    one.made.write_cell("20_20.pcd", (20, 20), random_points(np.random.default_rng(3), (20, 20), 6))
    one.read()
    changed = others(before, one.all([*PLAIN, *FAR]))
    near = {"0_0.pcd", "0_20.pcd", "20_0.pcd", "20_20.pcd"}
    assert changed == {(n, far) for n in near for far in FAR} | {("20_20.pcd", plain) for plain in PLAIN}


@pytest.mark.usefixtures("kinds_as_before")
def test_another_builder_changes_its_own_layer_alone(one: Map) -> None:
    layers = ["points", NDT, "voxel(leaf=1.0)", "ndt(leaf=2.0,of=voxel(leaf=1.0))", "denoise"]
    before = one.all(layers)
    voxel = spec._own["voxel"]
    spec._own["voxel"] = replace(voxel, builder_version=voxel.builder_version + 1)
    forget_kinds()
    changed = others(before, one.all(layers))
    assert {layer for _, layer in changed} == {"voxel(leaf=1.0)", "ndt(leaf=2.0,of=voxel(leaf=1.0))"}
    assert len(changed) == 2 * 16


def test_a_state_learnt_in_place_forgets_what_looks_into_it_alone(one: Map) -> None:
    before = one.all([*PLAIN, *FAR])
    index = one.index("20_20.pcd")
    one.catalogue.set_stamp(index, bytes(24))
    one.versions.cell_changed(index)
    known = [np.count_nonzero(one.versions._tables[layer]) for layer in FAR]
    assert known == [12] * len(FAR)
    after = one.all([*PLAIN, *FAR])
    fresh = LayerVersions(lambda: one.catalogue)
    assert after == {key: fresh.version(one.index(key[0]), key[1]) for key in after}
    assert {name for name, _ in others(before, after)} == {"0_0.pcd", "0_20.pcd", "20_0.pcd", "20_20.pcd"}


def test_dependents_are_the_cells_that_look(one: Map) -> None:
    """Neighbours seen from the other side, whatever the reach."""
    layers = [*PLAIN, *FAR, *(f"normals(radius={r})" for r in (20.0, 19.999999, 20.000001, 40.0, 50.0))]
    for index in range(16):
        for layer, cells in one.versions.dependents(index, layers):
            looking = {i for i in range(16) if index in one.versions.neighbours(i, layer)}
            assert set(cells) == {index} | looking, layer


def test_versions_of_many_cells(one: Map, monkeypatch: pytest.MonkeyPatch) -> None:
    """Some are computed at a time, in order; those that are known are not computed again."""
    layers = [*PLAIN, *FAR]
    expected = np.array([[one.versions.version(i, layer) for layer in layers] for i in range(16)], np.uint64)
    cells = np.array([*range(15, -1, -1)])
    cost = sum(layer_versions.HALO_COST if layer in FAR else 1 for layer in layers)
    for at_once in (1, 5, 16, 100):
        versions = LayerVersions(lambda: one.catalogue)
        monkeypatch.setattr(layer_versions, "COMPUTED_PER_BATCH", at_once * cost)
        for known in range(at_once, 16 + at_once, at_once):
            found, count, complete = versions.of_cells(cells, layers)
            assert (count, complete) == (min(known, 16), known >= 16)
            assert found[:count].tolist() == expected[::-1][:count].tolist()
            assert np.all((found == expected[::-1]) | (found == 0))
        monkeypatch.setattr(versions, "version", None)
        assert versions.of_cells(cells, layers)[0].tolist() == expected[::-1].tolist()
    assert versions.of_cells(cells[:0], layers)[1:] == (0, True)


def test_always_new_layers_fill_no_memory(one: Map, monkeypatch: pytest.MonkeyPatch) -> None:
    before = one.all(FAR)
    monkeypatch.setattr(layer_versions, "TABLES_BYTES", 8 * 16 * 5)
    for number in range(100):
        one.versions.version(number % 16, f"normals(radius={number % 50 + 1}.0)")
    assert len(one.versions._tables) == 5
    assert one.all(FAR) == before
    one.versions.forget()
    assert one.all(FAR) == before


def test_a_layer_that_looks_into_too_many_cells(tmp_path: Path) -> None:
    cells = {(x, y): (x / 2, y / 2, x / 2 + 0.5, y / 2 + 0.5) for x in range(40) for y in range(40)}
    state = SourceStamp(1, 2, 3)
    many = Catalogue.from_cells([(f"/m/{x}_{y}.pcd", box, state) for (x, y), box in cells.items()])
    versions = LayerVersions(lambda: many)
    for near in ("points", NDT, "normals(radius=1.0)"):
        versions.check_reach(near)
    with pytest.raises(BadRequest, match="would look into about 484 cells"):
        versions.check_reach("normals(radius=5.0)")
    assert len(versions.neighbours(820, "normals(radius=50.0)")) == layer_versions.MAX_NEIGHBOURS + 1


def test_a_layer_that_an_origin_has_ready_made(one: Map) -> None:
    """Its version is the origin's, it is not computed, and it looks into no other cells."""

    class Published(NamedTuple):
        nbytes: int
        version: int

    index, other = one.index("0_0.pcd"), one.index("-20_0.pcd")
    ready = {(index, "denoise"): Published(4096, 77), (index, "points"): Published(8192, 1)}

    class Store(Catalogue):
        def ready(self, index: int, layer: str) -> Published | None:  # type: ignore[override]
            return ready.get((index, layer))

    of = one.catalogue
    store = Store(id_prefix=of.id_prefix, names=of.names, boxes=of.boxes, stamps=of.stamps)
    versions = LayerVersions(lambda: store)
    assert versions.version(index, "denoise") == 77
    assert versions.neighbours(index, "denoise") == []
    assert (versions.is_computed(index, "denoise"), versions.looks_into(index, "denoise")) == (False, None)
    assert versions.version(index, "points") == of.version(index)
    assert not versions.is_computed(index, "points")
    assert versions.version(other, "denoise") == one.versions.version(other, "denoise")
    assert versions.is_computed(other, "denoise")
    assert versions.neighbours(other, "denoise") == one.versions.neighbours(other, "denoise") != []
