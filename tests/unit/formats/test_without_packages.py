# SPDX-License-Identifier: Apache-2.0
"""A slim install lacks Open3D or laspy: every other format is read, and LAS says what it needs."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np

from shmmap.formats.pcd.writer import write_pcd
from tests.support.cloud_bytes import write_las
from tests.support.daemon_process import ROOT

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
