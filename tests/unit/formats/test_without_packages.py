# SPDX-License-Identifier: Apache-2.0
"""A slim install lacks Open3D: PLY, PTS and XYZ say so in one line, and everything else works."""

from __future__ import annotations

import platform
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from shmmap.formats.pcd.writer import write_pcd
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


@pytest.mark.parametrize("verb", ["inspect", "divide"])
@pytest.mark.parametrize(
    ("name", "data"),
    [
        ("a.xyz", "1 2 3\n4 5 6\n"),
        ("a.pts", "1\n1 2 3 0\n"),
        ("a.ply", _PLY),
    ],
)
def test_what_needs_open3d_says_so(tmp_path: Path, verb: str, name: str, data: str) -> None:
    (tmp_path / name).write_text(data)
    done = without("open3d", verb, tmp_path / name, *([tmp_path / "map"] if verb == "divide" else []))
    kind = name[2:].upper()
    package = "open3d-cpu" if platform.machine() == "x86_64" else "open3d"
    assert done.returncode == 69
    assert done.stderr == (
        f"shmmap: {tmp_path / name}: {kind} needs the Python package Open3D, which is not installed\n"
        f"hint: pip install {package}, or convert the file to PCD or LAS\n"
    )


def test_the_rest_does_without(tmp_path: Path) -> None:
    write_pcd(tmp_path / "a.pcd", {axis: np.arange(5, dtype=np.float32) for axis in "xyz"})
    for words in (
        ("inspect", tmp_path / "a.pcd"),
        ("divide", tmp_path / "a.pcd", tmp_path / "map", "--quiet"),
        ("merge", tmp_path / "map", tmp_path / "b.pcd", "--quiet"),
    ):
        done = without("open3d", *words)
        assert done.returncode == 0, done.stderr


def test_las_without_laspy(tmp_path: Path) -> None:
    (tmp_path / "a.las").write_bytes(b"LASF" + bytes(400))
    done = without("laspy", "inspect", tmp_path / "a.las")
    assert done.returncode == 69
    assert "LAS and LAZ need the Python package laspy" in done.stderr
    assert "hint: pip install 'laspy[lazrs]', or convert the file to PCD\n" in done.stderr
