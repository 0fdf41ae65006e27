# SPDX-License-Identifier: Apache-2.0
"""Whole clouds and descriptions, of every format."""

from __future__ import annotations

import builtins
import os
import platform
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from shmmap.errors import MapDataError, ShmmapError
from shmmap.formats.cloud import describe, read_cloud, read_pcd
from shmmap.formats.pcd.writer import write_pcd
from shmmap.formats.source_file import CAUSES
from shmmap.layers.selections import SYSTEM_PACKAGES, load_open3d
from tests.support.cloud_bytes import Field, column, pcd, write_las
from tests.support.daemon_process import ROOT

PLY = (
    "ply\nformat {form} 1.0\ncomment made by hand\nelement vertex {count}\n"
    "property double x\nproperty double y\nproperty double z\nproperty float intensity\nend_header\n"
)
POINTS = [(589500.123456789, 2.0, 3.0, 0.5), (1.0, -2.0, 3.5, 0.25), (4.0, 5.0, 6.0, 0.125)]
TEXT = "".join(f"{x!r} {y!r} {z!r} {i!r}\n" for x, y, z, i in POINTS)


def ply(form: str, count: int = 3) -> bytes:
    head = PLY.format(form=form, count=count).encode()
    order = ">" if "big" in form else "<"
    return head + (
        TEXT.encode() if form == "ascii" else b"".join(struct.pack(order + "3df", *point) for point in POINTS)
    )


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
    ("name", "data", "columns"),
    [
        ("a.ply", ply("ascii"), ["xyz", "intensity"]),
        ("a.ply", ply("binary_little_endian"), ["xyz", "intensity"]),
        ("a.ply", ply("binary_big_endian"), ["xyz", "intensity"]),
        ("a.xyz", "".join(f"{x!r} {y!r} {z!r}\n" for x, y, z, _ in POINTS).encode(), ["xyz"]),
        (
            "a.xyzn",
            "".join(f"{x!r} {y!r} {z!r} 0 0 1\n" for x, y, z, _ in POINTS).encode(),
            ["xyz", "nx", "ny", "nz"],
        ),
        (
            "a.xyzrgb",
            "".join(f"{x!r} {y!r} {z!r} 1 0 1\n" for x, y, z, _ in POINTS).encode(),
            ["xyz", "red", "green", "blue"],
        ),
        ("a.pts", b"3\n" + TEXT.encode(), ["xyz", "intensity"]),
        ("\udcff.pts", b"3\n" + TEXT.encode(), ["xyz", "intensity"]),  # a name that is not UTF-8
    ],
)
def test_other_formats(tmp_path: Path, name: str, data: bytes, columns: list[str]) -> None:
    path = tmp_path / name
    path.write_bytes(data)
    cloud = read_cloud(path)
    assert list(cloud.columns) == columns
    assert cloud.xyz.tolist() == [list(point[:3]) for point in POINTS]
    if "intensity" in columns:
        assert cloud.columns["intensity"].tolist() == [0.5, 0.25, 0.125]
    described = describe(path)
    assert (described.points, described.dropped, described.format) == (3, 0, name[2:])
    assert [spec.name for spec in described.columns] == columns


@pytest.mark.parametrize(
    ("name", "data", "cause"),
    [
        ("a.ply", ply("ascii", 100), "truncated"),
        ("a.ply", ply("binary_little_endian", 100), "truncated"),
        ("a.ply", ply("binary_little_endian", 10**11), "truncated"),
        ("a.ply", ply("binary_little_endian", 3)[:-1], "truncated"),
        ("a.ply", ply("ascii").replace(b"0.25", b"zero"), "bad_row"),
        ("a.ply", b"ply\nformat\n", "bad_header"),
        ("a.ply", b"", "empty_file"),
        ("a.ply", ply("ascii").replace(b"property double x", b"property list uchar int x"), "no_xyz"),
        ("a.ply", ply("ascii").replace(b"element vertex 3", b"element face 3"), "bad_header"),
        ("a.xyz", b"hello\n", "bad_row"),
        ("a.pts", b"10\n1 2 3 4\n", "truncated"),
        ("a.pts", b"many\n1 2 3 4\n", "bad_header"),
        ("a.pts", b"-1\n1 2 3 4\n", "bad_header"),
        ("a.las", b"LASF", "truncated"),
        ("b.laz", b"PK", "bad_las"),
        ("c.las", b"", "empty_file"),
        ("a.e57", b"ASTM", "unsupported_format"),
        ("a", b"", "unsupported_format"),
    ],
)
def test_bad_files_of_other_formats(tmp_path: Path, name: str, data: bytes, cause: str) -> None:
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


def test_missing_system_libraries_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    original = builtins.__import__

    def without(name: str, *args: Any, **kwargs: Any) -> Any:
        if name == "open3d":
            raise ImportError("libEGL.so.1: cannot open shared object file")
        return original(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(ShmmapError) as caught:
        load_open3d("the layer normals")
    assert not isinstance(caught.value, MapDataError)
    for package in SYSTEM_PACKAGES:
        assert package in str(caught.value)
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


def test_las_without_laspy(tmp_path: Path) -> None:
    columns = {axis: np.arange(5, dtype=np.float32) for axis in "xyz"}
    write_las(tmp_path / "a.las", {**columns, "intensity": np.zeros(5)})
    done = without("laspy", "inspect", tmp_path / "a.las")
    assert done.returncode == 69
    assert "LAS and LAZ need the Python package laspy" in done.stderr
    assert "hint: pip install 'laspy[lazrs]', or convert the file to PCD\n" in done.stderr
