# SPDX-License-Identifier: Apache-2.0
"""The control loop of ``tests/benchmarks/control_loop.cpp`` as a process."""

from __future__ import annotations

import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from tests.support.cpp_client import INCLUDE
from tests.support.daemon_process import ROOT

__all__ = ["ControlLoop", "Rounds", "compiled_loop"]


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
        patience: float = 5.0,
        wrapper: Sequence[str] = (),
    ) -> None:
        self._process = subprocess.Popen(
            [*wrapper, program, endpoint, str(radius), str(patience)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip

    def begin(self, steps: int, *, wait: float = 0.02, period: float = 0.01) -> None:
        """Have it do so many rounds."""
        self._say(f"go {steps} {wait} {period}")

    def rounds(self) -> Rounds:
        """Return what came of them."""
        calls, sleeps, codes, current = (self._line().split() for _ in range(4))
        return Rounds(
            [int(one) * 1e-9 for one in calls],
            [int(one) * 1e-9 for one in sleeps],
            dict(zip(codes[::2], map(int, codes[1::2]), strict=True)),
            int(current[0]),
        )

    def go(self, steps: int, *, wait: float = 0.02, period: float = 0.01) -> Rounds:
        """Do so many rounds."""
        self.begin(steps, wait=wait, period=period)
        return self.rounds()

    def complete(self, seconds: float) -> tuple[bool, float, dict[str, int]]:
        """Wait until nothing is missing; returns whether it is so, where the vehicle is, and its cells."""
        self._say(f"complete {seconds}")
        state, cells = self._line().split(), self._line().split()
        return state[0] == "1", float(state[2]), dict(zip(cells[::2], map(int, cells[1::2]), strict=True))

    def close(self) -> int:
        """End it; returns its exit code."""
        self._process.communicate()
        return self._process.returncode

    def _say(self, line: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(line + "\n")
        self._process.stdin.flush()

    def _line(self) -> str:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        assert line.endswith("\n"), f"it ended with {self._process.wait()}"
        return line
