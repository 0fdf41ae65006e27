# SPDX-License-Identifier: Apache-2.0
"""Where scenes play: maps that are made when one needs them, and daemons that serve them."""

from __future__ import annotations

import atexit
import contextlib
import os
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from tests.benchmarks.hostile.report import LeftOut, Report
from tests.benchmarks.make_many_cells import make_many_cells
from tests.support.daemon_process import DaemonProcess
from tests.support.divided_map import DividedMap, make_map

__all__ = ["SCENES", "Scene", "Stage", "scene"]

MOST_BYTES: Final = 6 << 30
"""Private memory of a daemon, and of each of its loaders: a defect must not take the machine with it."""


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
        """Serve a map while the block runs, with at most so many descriptors."""
        limits = ["prlimit", f"--data={MOST_BYTES}"]
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

    @contextlib.contextmanager
    def tmpfs(self, size: str) -> Iterator[str]:
        """Mount a tmpfs of its own while the block runs."""
        with tempfile.TemporaryDirectory(dir=self.scratch) as path:
            command = ["mount", "-t", "tmpfs", "-o", f"size={size},mode=755", "tmpfs", path]
            done = subprocess.run(command, capture_output=True, text=True)
            if done.returncode:
                raise LeftOut(f"cannot mount a tmpfs: {done.stderr.strip()}")
            try:
                yield path
            finally:
                subprocess.run(["umount", path], check=True)


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
