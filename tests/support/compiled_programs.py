# SPDX-License-Identifier: Apache-2.0
"""Small programs compiled on the spot: over PCL, control loops, libraries to load before others."""

from __future__ import annotations

import fcntl
import json
import os
import shutil
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.support.cpp_client import INCLUDE
from tests.support.daemon_process import ROOT, LineProcess


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


# Leaves of the ``ndt`` layer beside those of PCL's voxel grid, where g++ and libpcl-dev are


_LEAVES_LIBRARIES = ("io", "filters", "search", "kdtree", "common")


def build_pcl_leaves(folder: Path, *, optimize: str = "-O2") -> Path | None:
    """Compile the program; None where it cannot be, or where PCL is older than its right covariances."""
    source = Path(__file__).with_name("pcl_leaves.cpp")
    options = [f"-I{INCLUDE}", "-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-Werror"]
    return built_pcl_program(
        source, folder, _LEAVES_LIBRARIES, optimize=optimize, oldest=(1, 12), options=options
    )


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
        self._program = LineProcess(*map(str, words))

    def __enter__(self) -> PclLeaves:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._program.end()

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
        self._program.write(what)
        return [json.loads(line) for line in iter(self._program.read, "")]


# PCL's own NDT, where g++ and libpcl-dev are: a small program, compiled on the spot, asked by lines


_OLDEST = (1, 13)
_NDT_LIBRARIES = ("registration", "filters", "search", "kdtree", "common")


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
    return built_pcl_program(source, folder, _NDT_LIBRARIES, optimize=optimize, oldest=_OLDEST)


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
        self._program = LineProcess(*map(str, words))

    def __enter__(self) -> PclNdt:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._program.end()

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
        self._program.write(" ".join(map(str, (what, *pose.tolist(), *words))))
        answer: dict[str, Any] = json.loads(self._program.read())
        return answer


# What takes long to compile, or to make, is made once for all of pytest's processes


def built_once(
    factory: pytest.TempPathFactory, name: str, build: Callable[[Path], Path | None]
) -> Path | None:
    """Return what ``build`` returned in the process that came first; it gets a directory of that name."""
    base = factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        base = base.parent
    folder = base / name
    folder.mkdir(exist_ok=True)
    done = folder / "built"
    with open(folder / "lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not done.exists():
            done.write_text(str(build(folder) or ""))
        found = done.read_text()
    return Path(found) if found else None


def made_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], object]) -> Path:
    """Return a directory, only for reading, that ``make`` has filled in the process that came first."""

    def build(folder: Path) -> Path:
        made = folder / "made"
        shutil.rmtree(made, ignore_errors=True)  # another process has failed
        made.mkdir()
        make(made)
        return made

    found = built_once(factory, name, build)
    assert found is not None
    return found


# Libraries in C that tests load into a program before all others (LD_PRELOAD)


def built_preload(name: str, folder: Path) -> Path:
    """Compile ``tests/support/NAME.c`` into a folder; skip the test where there is no compiler."""
    if shutil.which("gcc") is None:
        pytest.skip("gcc is not installed")
    built = folder / f"{name}.so"
    source = ROOT / f"tests/support/{name}.c"
    subprocess.run(["gcc", "-shared", "-fPIC", "-o", str(built), str(source), "-ldl"], check=True)
    return built


# The control loop of ``tests/benchmarks/control_loop.cpp`` as a process


def compiled_loop(folder: Path) -> Path:
    """Compile it as a user would."""
    program = folder / "control_loop"
    source = ROOT / "tests" / "benchmarks" / "control_loop.cpp"
    subprocess.run(["g++", "-std=c++17", "-O2", f"-I{INCLUDE}", source, "-o", program], check=True)
    return program


@dataclass
class Rounds:
    """What a number of rounds gave: seconds of each call and of each sleep beside it, errors by code."""

    calls_s: list[float]
    sleeps_s: list[float]
    codes: dict[str, int]
    current: int


class ControlLoop:
    """One such process; its window connects by itself."""

    def __init__(
        self,
        program: Path,
        endpoint: str,
        radius: float,
        *,
        wait: float = 5.0,
        wrapper: Sequence[str] = (),
    ) -> None:
        self._program = LineProcess(*wrapper, program, endpoint, str(radius), str(wait))

    def begin(self, steps: int, *, wait: float = 0.02, period: float = 0.01) -> None:
        """Have it begin ``rounds`` rounds."""
        self._program.write(f"go {steps} {wait} {period}")

    def rounds(self) -> Rounds:
        """Return what came of them."""
        calls, sleeps, codes, current = (self._program.read().split() for _ in range(4))
        return Rounds(
            [int(one) * 1e-9 for one in calls],
            [int(one) * 1e-9 for one in sleeps],
            dict(zip(codes[::2], map(int, codes[1::2]), strict=True)),
            int(current[0]),
        )

    def go(self, steps: int, *, wait: float = 0.02, period: float = 0.01) -> Rounds:
        """Do ``rounds`` rounds."""
        self.begin(steps, wait=wait, period=period)
        return self.rounds()

    def complete(self, seconds: float) -> tuple[bool, float, dict[str, int]]:
        """Wait until nothing is missing; returns whether it is so, where the vehicle is, and its cells."""
        self._program.write(f"complete {seconds}")
        state, cells = self._program.read().split(), self._program.read().split()
        return state[0] == "1", float(state[2]), dict(zip(cells[::2], map(int, cells[1::2]), strict=True))

    def close(self) -> int:
        """End it; returns its exit code."""
        self._program.end()
        return int(self._program.process.returncode)
