# SPDX-License-Identifier: Apache-2.0
"""Small C++ programs over PCL, compiled on the spot where g++ and libpcl-dev are."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path


def built_pcl_program(
    source: Path, folder: Path, libraries: Sequence[str], *, optimize: str = "-O3"
) -> Path | None:
    """Compile a program, linked with these of PCL's libraries; None where it cannot be."""
    headers = sorted(Path("/usr/include").glob("pcl-*"))
    if shutil.which("g++") is None or not headers:
        return None
    program = folder / source.stem
    # not -march=native: Eigen would align otherwise than in Debian's libraries, and crash
    command = ["g++", optimize, "-msse4.2", "-std=c++17", f"-I{headers[-1]}", "-I/usr/include/eigen3"]
    linked = [f"-lpcl_{name}" for name in libraries]
    subprocess.run([*command, source, "-o", program, *linked, "-lboost_system"], check=True)
    return program
