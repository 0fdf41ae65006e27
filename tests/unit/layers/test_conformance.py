# SPDX-License-Identifier: Apache-2.0
"""Every kind keeps the contract on every cloud, and the suite notices one that does not."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from shmmap.errors import ShmmapError
from shmmap.layers import spec
from shmmap.layers.contract import LayerColumn, LayerKind, LayerTable, Parameters, PointTable
from shmmap.testing.layer_conformance import CORNERS, check_layer
from tests.support.skips import open3d_or_skip

SPECS = {
    "points": ["points"],
    "voxel": ["voxel(leaf=0.5)", "voxel(leaf_x=1.0,leaf_y=0.5,leaf_z=0.25)"],
    "ndt": ["ndt(leaf=2.0)", "ndt(leaf=2.0,min_points=2,of=voxel(leaf=0.5))"],
    "search": ["search(leaf=1.0)"],
    "sample": ["sample(every=7)", "sample(count=100,seed=3)"],
    "crop": ["crop(z_min=-1.0,z_max=2.0)", "crop(z_max=0.0)"],
    "denoise": ["denoise", "denoise(neighbors=5,std_ratio=1.0,halo=3.0)"],
    "normals": ["normals(radius=1.0)", "normals(radius=2.0,neighbors=10)"],
    "elevation": ["elevation(resolution=0.5)", "elevation(resolution=1.0,of=crop(z_max=0.0))"],
    "ground": ["ground", "ground(resolution=1.0,of=sample(every=2))"],
}


def test_every_kind_is_tried() -> None:
    assert set(SPECS) >= {kind.name for kind in spec.kinds()}


@pytest.mark.parametrize("cloud", CORNERS)
@pytest.mark.parametrize("name", [name for names in SPECS.values() for name in names])
def test_contract(name: str, cloud: str) -> None:
    if name.startswith(("denoise", "normals")):
        open3d_or_skip()
    check_layer(name, cloud)


def build(points: PointTable, parameters: Parameters) -> LayerTable:
    """The lowest z; each kind below spoils it in its own way."""
    del parameters
    z = points.xyz[points.finite(), 2].astype(np.float64)
    return LayerTable({"low": z.min(initial=np.inf).reshape(1)}, 1, {"low": "m"})


GOOD = LayerKind(
    name="tried",
    builder_version=1,
    summary="lowest z",
    borders="none",
    parameters=(),
    columns=(LayerColumn("low", np.dtype("<f8"), "(1,)", "m", "lowest z"),),
    build=build,
)
_runs: list[int] = []


def other_each_time(points: PointTable, parameters: Parameters) -> LayerTable:
    _runs.append(1)
    return LayerTable({"low": np.array([float(len(_runs))])}, 1, {"low": "m"})


def counts_everything(points: PointTable, parameters: Parameters) -> LayerTable:
    return LayerTable({"low": np.array([float(len(points))])}, 1, {"low": "m"})


def changed(**changes: Any) -> Callable[[PointTable, Parameters], LayerTable]:
    def spoiled(points: PointTable, parameters: Parameters) -> LayerTable:
        table = build(points, parameters)
        for name, value in changes.items():
            setattr(table, name, value)
        return table

    return spoiled


@pytest.fixture
def tried(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[LayerKind], None]]:
    def offer(kind: LayerKind) -> None:
        monkeypatch.setitem(spec._registered, kind.name, kind)

    return offer  # type: ignore[return-value]


def test_a_good_kind_of_one_s_own(tried: Callable[[LayerKind], None]) -> None:
    tried(GOOD)
    for cloud in CORNERS:
        check_layer("tried", cloud)


@pytest.mark.parametrize(
    ("kind", "says"),
    [
        (replace(GOOD, build=other_each_time), "another run"),
        (replace(GOOD, build=counts_everything), "not finite"),
        (replace(GOOD, build=changed(units={})), "unit"),
        (replace(GOOD, build=changed(rows=-1)), "rows"),
        (replace(GOOD, build=changed(columns={})), "promised"),
        (replace(GOOD, build=changed(columns={"low": np.zeros(1, np.float32)})), "float32"),
        (replace(GOOD, build=changed(columns={"low": np.zeros(1), "more": np.zeros(1)})), "more"),
        (replace(GOOD, build=changed(columns={"low": np.zeros(4)[::2]})), "contiguous"),
        (replace(GOOD, build=changed(columns={"low": np.zeros(1, complex)})), "numeric"),
        (replace(GOOD, gives_points=True), "xyz"),
    ],
)
def test_what_breaks_the_contract_is_noticed(
    tried: Callable[[LayerKind], None], kind: LayerKind, says: str
) -> None:
    tried(kind)
    with pytest.raises((ShmmapError, KeyError)) as caught:
        check_layer("tried", "not_finite")
    assert says in str(caught.value)


def test_a_kind_needs_a_name_and_a_version() -> None:
    with pytest.raises(ValueError, match="called"):
        spec.register(replace(GOOD, name="ndt"))
    with pytest.raises(ValueError, match="called"):
        spec.register(replace(GOOD, name="two words"))
    with pytest.raises(ValueError, match="builder_version"):
        spec.register(replace(GOOD, builder_version=256))
