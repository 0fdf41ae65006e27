# SPDX-License-Identifier: Apache-2.0
"""Small C++ programs over PCL, compiled on the spot where g++ and libpcl-dev are."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path


def built_pcl_program(
    source: Path,
    folder: Path,
    libraries: Sequence[str],
    *,
    optimize: str = "-O3",
    oldest: tuple[int, int] = (1, 0),
    options: Sequence[str] = (),
) -> Path | None:
    """Compile a program, linked with these of PCL's libraries; None where it cannot be, or PCL is too old."""
    found = {tuple(map(int, path.name[4:].split("."))): path for path in Path("/usr/include").glob("pcl-*")}
    newest = max(found, default=(0, 0))
    if shutil.which("g++") is None or newest < oldest:
        return None
    program = folder / source.stem
    # not -march=native: Eigen would align otherwise than in Debian's libraries, and crash
    command = ["g++", optimize, "-msse4.2", "-std=c++17", f"-isystem{found[newest]}"]
    command += ["-isystem/usr/include/eigen3", *options]
    linked = [f"-lpcl_{name}" for name in libraries]
    subprocess.run([*command, source, "-o", program, *linked, "-lboost_system"], check=True)
    return program
