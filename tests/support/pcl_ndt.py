# SPDX-License-Identifier: Apache-2.0
"""PCL's own NDT, where g++ and libpcl-dev are: a small program, compiled on the spot, asked by lines."""

from __future__ import annotations

import json
import subprocess
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.support.pcl_program import built_pcl_program

__all__ = ["PclAlignment", "PclEvaluation", "PclNdt", "build_pcl_ndt"]

_OLDEST = (1, 13)
_LIBRARIES = ("registration", "filters", "search", "kdtree", "common")


@dataclass(frozen=True, eq=False)
class PclEvaluation:
    """Score and derivatives at a pose; ``ms`` is the least CPU time."""

    ms: float
    score: float
    gradient: NDArray[np.float64]
    hessian: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PclAlignment:
    """An alignment of PCL's."""

    iterations: int
    score_per_point: float
    T: NDArray[np.float64]


def build_pcl_ndt(folder: Path, *, optimize: str = "-O3") -> Path | None:
    """Compile the program; None where it cannot be, or where PCL is older than the convention ``pcl``."""
    source = Path(__file__).with_name("pcl_ndt.cpp")
    return built_pcl_program(source, folder, _LIBRARIES, optimize=optimize, oldest=_OLDEST)


class PclNdt:
    """A target, a source, a leaf size.

    Parameters
    ----------
    program
        As `build_pcl_ndt` gave it; its folder receives the clouds.
    target, source : (N, 3)
        Taken as float32.
    leaf
        Metres.
    """

    def __init__(
        self, program: Path, target: NDArray[np.floating], source: NDArray[np.floating], leaf: float
    ) -> None:
        for name, cloud in (("target", target), ("source", source)):
            np.ascontiguousarray(cloud, np.float32).tofile(program.parent / name)
        words = [program, program.parent / "target", program.parent / "source", leaf]
        self._process = subprocess.Popen(
            list(map(str, words)), stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def __enter__(self) -> PclNdt:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.communicate()

    def evaluate(self, pose: NDArray[np.float64], repeats: int = 1) -> PclEvaluation:
        """Return score, gradient and Hessian at a pose vector, (6,)."""
        found = self._ask("evaluate", pose, repeats)
        hessian = np.array(found["hessian"]).reshape(6, 6)
        return PclEvaluation(found["ms"], found["score"], np.array(found["gradient"]), hessian)

    def align(self, pose: NDArray[np.float64], epsilon: float, max_iterations: int) -> PclAlignment:
        """Align from a pose vector, (6,)."""
        found = self._ask("align", pose, epsilon, max_iterations)
        T = np.array(found["T"]).reshape(4, 4)
        return PclAlignment(found["iterations"], found["score_per_point"], T)

    def _ask(self, what: str, pose: NDArray[np.float64], *words: float) -> dict[str, Any]:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        print(what, *map(repr, pose.tolist()), *words, file=self._process.stdin, flush=True)
        answer: dict[str, Any] = json.loads(self._process.stdout.readline())
        return answer
