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
from shmmap.layers.spec import kinds
from tests.support.divided_map import random_points, write_pcd

DOCUMENT = (Path(shmmap.layers.__file__).parent / "LAYERS.md").read_text(encoding="utf-8")


def test_a_layer_of_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    points = random_points(np.random.default_rng(1), (0, 0), 500)
    write_pcd(tmp_path / "cloud.pcd", points)
    out = tmp_path / "ndt.npz"
    assert main(["ndt(4,3)", str(tmp_path / "cloud.pcd"), str(out)]) == 0
    table = build_layer("ndt(4,3)", np.column_stack([points["x"], points["y"], points["z"]]))
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


def test_the_document_names_every_kind_and_column() -> None:
    rows = {line.split("`")[1]: line for line in DOCUMENT.splitlines() if line.startswith("| `")}
    assert set(rows) == {kind.name for kind in kinds()}
    for kind in kinds():
        for parameter in kind.parameters:
            assert f"`{parameter.name}`" in rows[kind.name], (kind.name, parameter.name)
            if parameter.default is not None:
                assert f"`{parameter.name}` = {parameter.default:g}" in rows[kind.name]
        for column in kind.columns:
            named = f"`{column.name}`" in rows[kind.name] or "as `points`" in rows[kind.name]
            assert named or column.name == "*", (kind.name, column.name)
