# SPDX-License-Identifier: Apache-2.0
"""Whole clouds and descriptions, of every format."""

from __future__ import annotations

import builtins
import os
import platform
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from shmmap.client.cell import Cell
from shmmap.errors import MapDataError, ShmmapError
from shmmap.formats.cloud import describe, read_cloud, read_pcd
from shmmap.formats.pcd.writer import write_pcd
from shmmap.formats.source_file import CAUSES
from shmmap.open3d_loading import SYSTEM_PACKAGES, load_open3d
from tests.support.cloud_bytes import Field, column, las_file, pcd
from tests.support.daemon_process import ROOT


def test_a_pcd_in_memory(tmp_path: Path) -> None:
    path = tmp_path / "cloud.PCD"
    fields = [column(name, "F4", [1.0, float("nan"), 3.0]) for name in "xyz"]
    fields.append(Field("h", "I", 2, ((1, 2), (3, 4), (5, 6)), 2))
    path.write_bytes(pcd(fields, "binary", change={"VIEWPOINT": "1 0 0 1 0 0 0"}))
    cloud = read_pcd(path)
    assert (cloud.points, cloud.dropped) == (3, 1)
    assert cloud.xyz.tolist() == [[1, 1, 1], [3, 3, 3]]
    assert cloud.columns["h"].tolist() == [[1, 2], [5, 6]]
    assert [bound.tolist() for bound in cloud.bounds] == [[1, 1, 1], [3, 3, 3]]
    assert cloud.viewpoint[0] == 1
    assert len(cloud.warnings) == 1
    assert read_cloud(path, keep_non_finite=True).dropped == 0
    described = describe(path)
    assert (described.format, described.encoding, described.version, described.points, described.dropped) == (
        "pcd",
        "binary",
        "0.7",
        3,
        1,
    )
    assert [(c.name, c.dtype.str, c.components) for c in described.columns] == [
        ("xyz", "<f4", 3),
        ("h", "<i2", 2),
    ]
    assert (described.width, described.height, described.file_bytes) == (3, 1, path.stat().st_size)
    assert [bound.tolist() for bound in described.bounds] == [[1, 1, 1], [3, 3, 3]]
    assert described.warnings == cloud.warnings


def test_an_empty_pcd_has_its_columns(tmp_path: Path) -> None:
    path = tmp_path / "empty.pcd"
    fields = [*(column(name, "F8", []) for name in "xyz"), Field("h", "U", 1, (), 3)]
    for encoding in ("ascii", "binary", "binary_compressed"):
        path.write_bytes(pcd(fields, encoding))
        cloud = read_pcd(path)
        assert cloud.xyz.shape == (0, 3)
        assert cloud.xyz.dtype == np.float64
        assert cloud.columns["h"].shape == (0, 3)


def test_reading_a_pcd_loads_no_open3d() -> None:
    program = "import sys; import shmmap.formats.cloud; print('open3d' in sys.modules, 'lzf' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "False"]


@pytest.mark.parametrize(
    ("name", "data", "cause"),
    [
        ("b.laz", b"PK", "bad_las"),
        ("c.las", b"", "empty_file"),
        ("a.e57", b"ASTM", "unsupported_format"),
        ("a", b"", "unsupported_format"),
    ],
)
def test_files_of_no_format(tmp_path: Path, name: str, data: bytes, cause: str) -> None:
    path = tmp_path / name
    path.write_bytes(data)
    with pytest.raises(MapDataError) as caught:
        read_cloud(path)
    assert caught.value.cause == cause
    assert cause in CAUSES


@pytest.mark.parametrize("name", ["a.ply", "a.pts", "a.pcd", "a.las", "a.txt", "a"])
def test_what_is_no_file_is_refused_for_that(tmp_path: Path, name: str) -> None:
    with pytest.raises(MapDataError) as caught:
        describe(tmp_path / name)
    assert caught.value.cause == "missing"
    (tmp_path / name).mkdir()
    with pytest.raises(MapDataError, match="a directory") as caught:
        describe(tmp_path / name)
    assert caught.value.cause == "not_regular"
    (tmp_path / name).rmdir()
    os.mkfifo(tmp_path / name)
    with pytest.raises(MapDataError) as caught:
        describe(tmp_path / name)
    assert caught.value.cause == "not_regular"
    with pytest.raises(MapDataError) as caught:
        describe(f"nul\0byte{name}")
    assert caught.value.cause == "unreadable"


@pytest.mark.parametrize("kind", [ImportError, OSError])  # of a module, and of a library that it opens
def test_missing_system_libraries_are_named(
    monkeypatch: pytest.MonkeyPatch, kind: type[ImportError | OSError]
) -> None:
    original = builtins.__import__

    def without(name: str, *args: Any, **kwargs: Any) -> Any:
        if name == "open3d":
            raise kind("libusb-1.0.so.0: cannot open shared object file")
        return original(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    unused: Any = None
    for load in (lambda: load_open3d("the layer normals"), lambda: Cell.to_open3d(unused)):
        with pytest.raises(ShmmapError) as caught:
            load()
        assert not isinstance(caught.value, MapDataError)
        assert {"libegl1", "libgl1", "libx11-6", "libusb-1.0-0", "libgomp1"} <= set(SYSTEM_PACKAGES)
        for package in SYSTEM_PACKAGES:
            assert package in caught.value.hint
        assert "libusb-1.0.so.0" in caught.value.message
    assert ("libgfortran5" in SYSTEM_PACKAGES) == (platform.machine() != "x86_64")


# --- a slim install lacks Open3D or laspy: every other format is read -------------------------------------


_WITHOUT = (
    "import sys\n"
    "sys.modules[sys.argv.pop(1)] = None\n"
    "from shmmap.cli import main\n"
    "sys.exit(main(sys.argv[1:]))"
)


def without(package: str, *words: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", _WITHOUT, package, *map(str, words)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )


_PLY = """\
ply
format ascii 1.0
element vertex 1
property float x
property float y
property float z
end_header
1 2 3
"""


def test_no_format_needs_open3d(tmp_path: Path) -> None:
    write_pcd(tmp_path / "a.pcd", {axis: np.arange(5, dtype=np.float32) for axis in "xyz"})
    (tmp_path / "a.xyz").write_text("1 2 3\n4 5 6\n")
    (tmp_path / "a.pts").write_text("1\n1 2 3 0\n")
    (tmp_path / "a.ply").write_text(_PLY)
    for words in (
        *(("inspect", tmp_path / name) for name in ("a.pcd", "a.xyz", "a.pts", "a.ply")),
        ("divide", tmp_path, tmp_path / "../map", "--quiet", "--common-fields"),
        ("merge", tmp_path / "../map", tmp_path / "b.pcd", "--quiet"),
    ):
        done = without("open3d", *words)
        assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(("package", "suffix"), [("laspy", "las"), ("laspy", "laz"), ("lazrs", "laz")])
def test_las_without_its_packages(tmp_path: Path, package: str, suffix: str) -> None:
    """The hint is one, that of the page."""
    path = las_file(tmp_path / f"a.{suffix}")
    done = without(package, "inspect", path)
    assert done.returncode == 69
    assert f"LAS and LAZ need the Python package {package}" in done.stderr
    command = re.search(r"hint: (pip install .*), or convert the file to PCD\n", done.stderr)
    assert command is not None, done.stderr
    assert f"`{command[1]}`" in (ROOT / "shmmap/INSTALL.md").read_text(encoding="utf-8")
