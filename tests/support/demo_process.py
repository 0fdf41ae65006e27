# SPDX-License-Identifier: Apache-2.0
"""``shmmap demo`` in its own process, and what it must not leave behind.

``python -m tests.support.demo_process`` is the verb in a small town with two processes: all that the
demonstration starts and does, in a few seconds.
"""

from __future__ import annotations

import functools
import os
import secrets
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from shmmap import cli
from shmmap.demo import demo_town
from tests.support.daemon_process import ROOT, processes_marked

SMALL: Final = demo_town.DemoSettings(
    blocks=(3, 2), density=4.0, radius=60.0, length=20.0, onward=12, localized=10.0, counts=(1, 2)
)


class Demo:
    """A demonstration with marked descendants and its own temporary directory.

    Parameters
    ----------
    *words
        Options of the demonstration.
    command
        The module, and its words.
    """

    def __init__(
        self, cwd: Path, *words: str, command: Sequence[str] = ("tests.support.demo_process",)
    ) -> None:
        self.mark = secrets.token_hex(8)
        self.cwd = cwd
        self.scratch = cwd / "tmp"
        self.scratch.mkdir()
        self.process = subprocess.Popen(
            [sys.executable, "-m", *command, *words],
            cwd=cwd,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={k: v for k, v in os.environ.items() if not k.startswith("SHMMAP_")}
            | {"PYTHONPATH": str(ROOT), "TMPDIR": str(self.scratch), "SHMMAP_TEST_RUN": self.mark}
            # settings of a real daemon must not matter
            | {"SHMMAP_SHM_DIR": "/nowhere", "SHMMAP_ENDPOINT": "/nowhere.sock", "SHMMAP_INSTANCE": "other"},
        )

    def leftovers(self) -> list[str]:
        """Processes, segments, sockets and files that should not be there any more."""
        found = [f"process {pid}" for pid in processes_marked(self.mark)]
        found += [f"segment {n}" for n in os.listdir("/dev/shm") if f"test-{self.process.pid}-" in n]
        found += [f"/tmp/{n}" for n in os.listdir("/tmp") if f"-test-{self.process.pid}-" in n]
        return found + [str(path) for path in self.scratch.iterdir()]


def until(demo: Demo, stage: str) -> None:
    """Read what the demonstration says until a stage or an event begins."""
    assert demo.process.stdout is not None
    for line in demo.process.stdout:
        if line.startswith(stage):
            return
    raise AssertionError(f"it never said {stage!r}")


if __name__ == "__main__":
    demo_town.DemoSettings = functools.partial(  # type: ignore[misc, assignment]
        demo_town.DemoSettings, **{name: getattr(SMALL, name) for name in SMALL.__slots__}
    )
    sys.exit(cli.main(["demo", *sys.argv[1:]]))
