# SPDX-License-Identifier: Apache-2.0
"""Where scenes play (maps made when needed, and daemons that serve them), and what they found."""

from __future__ import annotations

import atexit
import contextlib
import os
import tempfile
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from tests.benchmarks.make_many_cells import make_many_cells
from tests.support.daemon_process import DaemonProcess
from tests.support.divided_map import DividedMap, make_map

MAX_BYTES: Final = 6 << 30
"""Private memory of a daemon, and of each of its loaders: a defect must not take the machine with it."""


class LeftOut(Exception):
    """A scene cannot be played on this machine; the message says why."""


@dataclass
class Report:
    """What one scene found, printed as it grows: limits that did not hold, and figures for the last table."""

    row: str
    sentence: str
    over: list[str] = field(default_factory=list)
    figures: dict[str, str] = field(default_factory=dict)
    left_out: str = ""

    def begin(self) -> None:
        """Print the heading."""
        print(f"\n{self.row}  {self.sentence}", flush=True)

    def note(self, text: str) -> None:
        """Print a line of figures."""
        print(f"    {text}", flush=True)

    def limit(self, what: str, value: float, most: float, unit: str = "") -> None:
        """Check a figure."""
        unit = unit and f" {unit}"
        held = value <= most
        self.note(f"{what}: {value:.6g}{unit}, at most {most:.6g}{unit}" + ("" if held else "  <-- OVER"))
        if not held:
            self.over.append(f"{what} {value:.6g}{unit} (limit {most:.6g})")

    def must(self, what: str, held: bool, instead: str = "") -> None:
        """Check something that is so or not; ``instead`` says what was seen."""
        seen = f": {instead}" if instead else ""
        self.note(f"{what}{' yes' if held else ' NO'}{seen}" + ("" if held else "  <-- OVER"))
        if not held:
            self.over.append(f"{what}: no{f' ({instead})' if instead else ''}")

    def verdict(self) -> str:
        """OK, or what is over the limit."""
        if self.left_out:
            return f"left out: {self.left_out}"
        return "OVER: " + "; ".join(self.over) if self.over else "OK"

    def end(self) -> None:
        """Print the verdict."""
        self.note(f"=> {self.verdict()}")


@dataclass
class Stage:
    """What scenes need.

    Parameters
    ----------
    scratch
        A directory for what is there for one run.
    maps
        A directory for very large maps: what is there from an earlier run is used again.
    minutes
        How long the long runs take.
    lifted
        Whether the daemons, as this process, go before unrelated work of the machine.
    """

    scratch: Path
    maps: Path
    minutes: float = 10.0
    lifted: bool = False

    def __post_init__(self) -> None:
        if self.lifted:
            lift(os.getpid())
            # the session is the shell's, too: whatever is started from it later would go before its daemons
            atexit.register(lift, os.getpid(), 0)

    def many_cells(self, side: int, points: int = 1) -> Path:
        """Return a map of ``side`` x ``side`` cells, their corner at the origin."""
        path = self.maps / f"many-{side}-{points}"
        if not path.exists():
            partial = path.with_name(f"{path.name}.partial")
            make_many_cells(partial, side, points)
            partial.rename(path)
        return path

    def new_map(self, **size: int) -> DividedMap:
        """Return a new map around the origin, for a scene that changes it; parameters as of `make_map`."""
        return make_map(Path(tempfile.mkdtemp(dir=self.scratch)) / "map", **size)

    @contextlib.contextmanager
    def served(
        self, path: Path, *flags: str, descriptors: int = 0, **options: Any
    ) -> Iterator[DaemonProcess]:
        """Serve a map while the block runs, with at most ``descriptors`` of them."""
        limits = ["prlimit", f"--data={MAX_BYTES}"]
        limits += [f"--nofile={descriptors}:{descriptors}"] if descriptors else []
        one = DaemonProcess(path, *flags, command=limits, **options)
        try:
            one.start()
            if self.lifted:
                lift(one.pid)
            yield one
            if one.process is not None and one.process.poll() is None:
                one.stop()
        finally:
            one.dispose()


def lift(pid: int, niceness: int = -19) -> None:
    """Let the session of a process have its processor time before others; with 0, as others."""
    Path(f"/proc/{pid}/autogroup").write_text(str(niceness))


Play = Callable[[Report, Stage], None]


@dataclass(frozen=True)
class Scene:
    """A row of the findings, and the function that plays it."""

    row: str
    sentence: str
    play: Play


SCENES: Final[dict[str, Scene]] = {}


def scene(row: str, sentence: str) -> Callable[[Play], Play]:
    """Make a function a scene; ``sentence`` says what must not happen."""

    def add(play: Play) -> Play:
        assert row not in SCENES, row
        SCENES[row] = Scene(row, sentence, play)
        return play

    return add


def every_scene() -> dict[str, Scene]:
    """Return all scenes by name: rows of the findings in their order, then the long runs."""
    # they import this module, and importing them adds their scenes
    from tests.benchmarks.hostile import files, long_runs, requests, segments, sessions  # noqa: F401

    def place(name: str) -> tuple[bool, str, int]:
        is_row = name[1:].isdigit()
        return not is_row, name[0], int(name[1:]) if is_row else 0

    return {name: SCENES[name] for name in sorted(SCENES, key=place)}


def play(scenes: Sequence[Scene], stage: Stage) -> int:
    """Play; returns 1 if a limit did not hold."""
    reports = []
    for one in scenes:
        report = Report(one.row, one.sentence)
        report.begin()
        try:
            one.play(report, stage)
        except LeftOut as reason:
            report.left_out = str(reason)
        except Exception as error:
            traceback.print_exc()
            report.over.append(f"the scene itself: {type(error).__name__}: {error}".split("\n")[0])
        report.end()
        reports.append(report)
    print_table(reports)
    return int(any(report.over for report in reports))


def print_table(reports: Sequence[Report]) -> None:
    """Print one line a scene; times in ms, memory in MiB over idle."""
    print(f"\n{'scene':10} {'p99':>9} {'longest':>9} {'echo':>7} {'memory':>7} {'newcomers':>9}  verdict")
    for one in reports:
        cells = [one.figures.get(name, "-") for name in ("p99", "probe", "echo", "memory", "newcomers")]
        widths = (9, 9, 7, 7, 9)
        shown = " ".join(f"{cell:>{width}}" for cell, width in zip(cells, widths, strict=True))
        print(f"{one.row:10} {shown}  {one.verdict()}")
    print(f"load {os.getloadavg()[0]:.1f}")
