# SPDX-License-Identifier: Apache-2.0
"""Check the guarantees of every layer kind, on clouds of many sorts.

::

    @pytest.mark.parametrize("cloud", CORNERS)
    def test_my_kind(cloud: str) -> None:
        check_layer("roughness(leaf=1.0)", cloud)

The contents of a layer are not checked: test them against an independent, slow computation.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap.errors import InternalError, MapDataError
from shmmap.layers.build import build_layer
from shmmap.layers.contract import LayerTable
from shmmap.layers.spec import LayerSpec, parse_layer
from shmmap.segment.header import unpack_header
from shmmap.segment.layout import NO_SOURCE
from shmmap.segment.writer import SegmentOrigin, write_table

__all__ = ["CORNERS", "check_layer", "corner", "surface"]

CORNERS: Final = (
    "origin",
    "negative",
    "large_f4",
    "large_f8",
    "borders",
    "empty",
    "one_point",
    "duplicates",
    "not_finite",
    "flat",
    "far_apart",
)

MOVED: Final[NDArray[Any]] = np.array([89570.0, 42300.0, 3.0])


_BOX = (0.0, 0.0, 20.0, 20.0)
MAY_BE_REFUSED = frozenset({"far_apart"})


def check_layer(layer: str, cloud: str) -> LayerTable | None:
    """Build a layer of one of `CORNERS` and check all properties that every kind must have.

    Return the table, or None if the builder refused the cloud, which is allowed for ``far_apart`` only.

    Raises
    ------
    InternalError
        The kind breaks a rule; the message names it.
    """
    spec = parse_layer(layer)
    _must(parse_layer(str(spec)) == spec, f"{layer} is not the same spec as its canonical form {spec}")
    columns = _cloud(cloud)
    halo = _read_only(corner(cloud, 200)) if spec.halo_m else None
    before = {name: column.tobytes() for name, column in columns.items()}
    try:
        table = build_layer(spec, columns, box=_BOX, halo=halo)
    except MapDataError as error:
        _must(cloud in MAY_BE_REFUSED, f"refuses {cloud}: {error}")
        return None
    _must(
        before == {name: column.tobytes() for name, column in columns.items()},
        "the builder changed its input",
    )
    _check_columns(spec, table, columns)
    _must_equal(table, build_layer(spec, columns, box=_BOX, halo=halo), "another run gives other bytes")
    writable = {name: column.copy() for name, column in columns.items()}
    _must_equal(table, build_layer(spec, writable, box=_BOX, halo=halo), "writable arrays give other bytes")
    finite = np.isfinite(columns["xyz"]).all(axis=1)
    kept = {name: np.ascontiguousarray(column[finite]) for name, column in columns.items()}
    _must_equal(
        table, build_layer(spec, kept, box=_BOX, halo=halo), "points that are not finite leave a trace"
    )
    if spec.kind.gives_points:
        xyz = table["xyz"]
        _must(xyz.shape == (table.rows, 3) and bool(np.isfinite(xyz).all()), "xyz is not the layer's points")
        build_layer(f"voxel(leaf=1.0,of={spec})", columns, box=_BOX, halo=halo)
    _check_segment(spec, table)
    return table


def _read_only(array: NDArray[Any]) -> NDArray[Any]:
    array.flags.writeable = False
    return array


def _cloud(name: str) -> dict[str, NDArray[Any]]:
    rng = np.random.default_rng(7)
    xyz = corner(name)
    columns = {
        "xyz": xyz,
        "intensity": rng.uniform(0, 255, len(xyz)).astype(np.float32),
        "ring": rng.integers(0, 64, len(xyz), np.uint8),
    }
    return {key: _read_only(column) for key, column in columns.items()}


def _must(kept: bool, otherwise: str) -> None:
    if not kept:
        raise InternalError(otherwise)


def _must_equal(one: LayerTable, other: LayerTable, otherwise: str) -> None:
    same = (
        one.rows == other.rows and one.lattice == other.lattice and list(one.columns) == list(other.columns)
    )
    same = same and all(
        column.dtype == other[name].dtype
        and column.shape == other[name].shape
        and column.tobytes() == other[name].tobytes()
        for name, column in one.columns.items()
    )
    _must(same, otherwise)


def _check_columns(spec: LayerSpec, table: LayerTable, source: Mapping[str, NDArray[Any]]) -> None:
    promised = {column.name: column for column in spec.kind.columns}
    others = promised.pop("*", None)
    for name, column in promised.items():
        _must(name in table.columns, f"column {name} is promised and not there")
        dtype = column.dtype if column.dtype is not None else source[name].dtype
        _must(table[name].dtype == dtype, f"column {name} is {table[name].dtype}, not {dtype}")
        _must(table.units.get(name, "") == column.unit, f"column {name} has another unit than promised")
    for name, array in table.columns.items():
        _must(name in promised or others is not None, f"column {name} is not promised")
        _must(array.flags.c_contiguous, f"column {name} is not contiguous")
        _must(array.dtype.isnative and array.dtype.kind in "fiu", f"column {name} is {array.dtype}")
        _must(array.ndim <= 4, f"column {name} has {array.ndim} dimensions")
    if others is not None:
        left = set(source) - set(table.columns)
        _must(not left, f"columns of the source are missing: {sorted(left)}")
    _must(table.rows >= 0, "rows are negative")


def _check_segment(spec: LayerSpec, table: LayerTable) -> None:
    """Check that the table fits in a segment and is read back unchanged."""
    origin = SegmentOrigin("/cell.pcd", _BOX, "map", NO_SOURCE, bytes(16), 0, 0)
    fd = os.memfd_create("layer")
    try:
        header = write_table(
            fd,
            table.columns,
            layer=str(spec),
            rows=table.rows,
            origin=origin,
            builder_version=spec.builder_version,
            units=table.units,
            lattice=table.lattice,
            z_min=0.0,
            z_max=0.0,
        )
        data = os.pread(fd, os.fstat(fd).st_size, 0)
    finally:
        os.close(fd)
    back = unpack_header(memoryview(data), len(data))
    _must(back == header and back.lattice == table.lattice, "the segment's header says something else")
    for column in back.columns:
        same = data[column.offset : column.offset + column.nbytes] == table[column.name].tobytes()
        _must(same, f"column {column.name} is not the same in a segment")


def surface(rng: np.random.Generator, points: int, size_m: float = 20.0) -> NDArray[np.float64]:
    """Return points of gently hilly ground with a wall: (points, 3), metres, x and y in 0 .. size_m."""
    xy = rng.uniform(0, size_m, (points, 2))
    z = np.sin(xy[:, 0] / 4) + rng.normal(0, 0.02, points)
    wall = rng.random(points) < 0.3
    xy[wall, 0] = size_m / 3 + rng.normal(0, 0.02, wall.sum())
    z[wall] += rng.uniform(0, 4, wall.sum())
    return np.column_stack([xy, z])


def corner(name: str, points: int = 600) -> Any:
    """Return one cloud of `CORNERS`, (N, 3) float32 or float64."""
    rng = np.random.default_rng(CORNERS.index(name))
    base: NDArray[Any] = surface(rng, points)
    if name == "origin":
        return (base - [10, 10, 0]).astype(np.float32)
    if name == "negative":
        return (base - [1000, 2000, 50]).astype(np.float32)
    if name == "large_f4":
        base = base + MOVED
        return base.astype(np.float32)
    if name == "large_f8":
        return base + MOVED
    if name == "borders":  # exactly on faces of voxels, and just beside them
        steps = rng.integers(-4, 5, (points, 3)).astype(np.float32) * np.float32(0.5)
        hairs: NDArray[Any] = np.nextafter(steps, steps + rng.integers(-1, 2, steps.shape).astype(np.float32))
        return hairs
    if name == "empty":
        return np.empty((0, 3), np.float32)
    if name == "one_point":
        return np.array([[-3.25, 4.5, 0.125]], np.float32)
    if name == "duplicates":
        return np.repeat(base[:40], 15, axis=0).astype(np.float32)
    if name == "not_finite":
        cloud = base.astype(np.float32)
        cloud[::7, 0] = np.nan
        cloud[3::11, 2] = np.inf
        cloud[5::13, 1] = -np.inf
        return cloud
    if name == "flat":
        base[:, 2] = 1.0
        return base.astype(np.float32)
    if name != "far_apart":
        raise KeyError(name)
    # no table can cover the box
    cloud = base.astype(np.float64)
    cloud[0] = [3e6, -4e6, 2e6]
    return cloud
