# SPDX-License-Identifier: Apache-2.0
"""Layers without a daemon: the program, and the document that lists the kinds."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import IO

import numpy as np
import pytest

import shmmap.layers
from shmmap.layers.__main__ import main
from shmmap.layers.build import build_layer
from shmmap.layers.reference import column_rows, column_table
from shmmap.layers.spec import kinds, parse_layer
from shmmap.testing.layer_conformance import surface
from tests.support.divided_map import random_points, write_pcd
from tests.support.skips import open3d_or_skip

DOCUMENT = (Path(shmmap.layers.__file__).parent / "LAYERS.md").read_text(encoding="utf-8")


def test_a_layer_of_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    points = random_points(np.random.default_rng(1), (0, 0), 500)
    write_pcd(tmp_path / "cloud.pcd", points)
    out = tmp_path / "ndt.npz"
    assert main(["ndt(4,3)", str(tmp_path / "cloud.pcd"), str(out)]) == 0
    table = build_layer("ndt(4,3)", np.column_stack([points["x"], points["y"], points["z"]]))
    assert repr(table).startswith(f"<LayerTable of {table.rows} rows: mean, inverse_covariance, ")
    with np.load(out) as found:
        for name, column in table.columns.items():
            assert np.array_equal(found[name], column)
        assert table.lattice is not None
        assert tuple(found["lattice_first"]) == table.lattice.first
    assert main(["nonsense", str(tmp_path / "cloud.pcd"), str(out)]) == 2
    assert main(["points", str(tmp_path / "missing.pcd"), str(out)]) == 65
    assert main(["points", str(tmp_path / "cloud.pcd"), str(tmp_path / "no" / "out.npz")]) == 73
    assert "unknown layer" in capsys.readouterr().err


def test_a_full_disk_leaves_what_was_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_pcd(tmp_path / "cloud.pcd", random_points(np.random.default_rng(1), (0, 0), 50))
    (tmp_path / "out.npz").write_bytes(b"an older one")

    def full(file: IO[bytes], **columns: object) -> None:
        file.write(b"half")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(np, "savez", full)
    assert main(["points", str(tmp_path / "cloud.pcd"), str(tmp_path / "out.npz")]) == 73
    assert "No space left" in capsys.readouterr().err
    assert (tmp_path / "out.npz").read_bytes() == b"an older one"
    assert sorted(os.listdir(tmp_path)) == ["cloud.pcd", "out.npz"]


def test_the_document_names_every_kind() -> None:
    table = DOCUMENT.partition("| kind |")[2].partition("\n\n")[0]
    rows = {line.split("`")[1]: line for line in table.splitlines() if line.startswith("| `")}
    assert set(rows) == {kind.name for kind in kinds()}
    for kind in kinds():
        for parameter in kind.parameters:
            assert f"`{parameter.name}`" in rows[kind.name], (kind.name, parameter.name)
            if parameter.default is not None:
                assert f"`{parameter.name}` = {parameter.default:g}" in rows[kind.name]


def test_the_document_s_columns_are_those_that_are_declared() -> None:
    table = DOCUMENT.partition("<!-- columns -->\n")[2].partition("\n\n")[0]
    assert table.splitlines() == column_table(), "the table of LAYERS.md has to be:\n" + "\n".join(
        column_table()
    )


def test_rows_say_dtype_shape_unit_frame_and_what_stands_for_no_value() -> None:
    rows = {(row.layer, row.column): row for row in column_rows()}
    assert {layer for layer, _ in rows} == {kind.name for kind in kinds()}
    assert rows["ground", "min"][2:7] == ("float32", "(ny, nx)", "m", "map", "NaN")
    assert rows["ndt", "scatter"][2:7] == ("float64", "(rows, 6)", "m^2", "map", "")
    assert rows["search", "tile"].missing == "-1"
    assert all(row.dtype and row.shape and row.meaning for row in rows.values())


@pytest.mark.parametrize(
    "spec",
    [
        "points", "voxel(1)", "ndt(4,3)", "search(1)", "sample(3)", "crop(z_max=1)", "denoise", "normals(1)",
        "elevation(1)", "ground",
    ],
)  # fmt: skip
def test_declared_shapes_and_marks_of_no_value_are_those_of_a_layer(spec: str) -> None:
    if spec in ("denoise", "normals(1)"):
        open3d_or_skip()
    xyz = surface(np.random.default_rng(3), 400).astype(np.float32)
    xyz[:, :2] *= 3  # columns without a point between others
    xyz[0, 0] -= 30.0
    table = build_layer(spec, {"xyz": xyz, "intensity": np.arange(400) % 200})
    for column in parse_layer(spec).kind.columns:
        if column.name == "*":
            continue
        values = table[column.name]
        words = [word.strip() for word in column.shape.strip("()").split(",") if word.strip()]
        assert len(words) == values.ndim, column.name
        for word, size in zip(words, values.shape, strict=True):
            assert size == (table.rows if word == "rows" else int(word) if word.isdigit() else size)
        if column.missing:
            empty = np.isnan(values) if column.missing == "NaN" else values == int(column.missing)
            assert 0 < np.count_nonzero(empty) < values.size, column.name
            if column.shape == "(ny, nx)":
                assert np.count_nonzero(~empty) == table.rows
        else:
            assert np.isfinite(values).all(), column.name
