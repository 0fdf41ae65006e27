# SPDX-License-Identifier: Apache-2.0
"""Leaves of the ``ndt`` layer beside those of PCL's voxel grid, where g++ and libpcl-dev are."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from types import TracebackType
from typing import Any

from tests.support.cpp_client import INCLUDE
from tests.support.pcl_program import built_pcl_program

__all__ = ["PclLeaves", "build_pcl_leaves"]

_LIBRARIES = ("io", "filters", "search", "kdtree", "common")


def build_pcl_leaves(folder: Path, *, optimize: str = "-O2") -> Path | None:
    """Compile the program; None where it cannot be, or where PCL is older than its right covariances."""
    source = Path(__file__).with_name("pcl_leaves.cpp")
    options = [f"-I{INCLUDE}", "-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-Werror"]
    return built_pcl_program(source, folder, _LIBRARIES, optimize=optimize, oldest=(1, 12), options=options)


class PclLeaves:
    """The program, with all cells of a daemon's map about the origin.

    Parameters
    ----------
    program
        As `build_pcl_leaves` gave it.
    endpoint
        The daemon's.
    leaf
        Edge of a voxel, metres.
    """

    def __init__(self, program: Path, endpoint: str, leaf: float) -> None:
        words = [program, endpoint, 0.0, 0.0, 1e6, leaf]
        self._process = subprocess.Popen(
            list(map(str, words)), stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def __enter__(self) -> PclLeaves:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.communicate()

    def compare(self) -> list[dict[str, Any]]:
        """Leaves of each cell, and how far they are apart."""
        return self._ask("compare")

    def clouds(self) -> list[dict[str, Any]]:
        """Whether each cell's message is what PCL reads from its file."""
        return self._ask("clouds")

    def time(self) -> dict[str, Any]:
        """One round of measurements."""
        (found,) = self._ask("time")
        return found

    def _ask(self, what: str) -> list[dict[str, Any]]:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        print(what, file=self._process.stdin, flush=True)
        found: list[dict[str, Any]] = []
        for line in self._process.stdout:
            if line == "\n":
                return found
            found.append(json.loads(line))
        raise AssertionError(f"it ended with {self._process.wait()}")
