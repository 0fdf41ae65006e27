# SPDX-License-Identifier: Apache-2.0
"""A module of the tests that runs as a process and is spoken to by lines."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from tests.support.daemon_process import ROOT

__all__ = ["LineProcess", "line_process"]


class LineProcess:
    """The process; it reads lines from stdin and prints lines."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process

    def read(self) -> str:
        """Wait for the next line."""
        assert self._process.stdout is not None
        return self._process.stdout.readline()

    def write(self, line: str) -> None:
        """Send a line."""
        assert self._process.stdin is not None
        self._process.stdin.write(line + "\n")
        self._process.stdin.flush()


@contextmanager
def line_process(module: str, *words: str) -> Iterator[LineProcess]:
    """Run ``python -m module words...`` until the end of the block."""
    process = subprocess.Popen(
        [sys.executable, "-m", module, *words],
        cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        yield LineProcess(process)
    finally:
        process.kill()
        process.communicate()
