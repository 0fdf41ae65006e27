# SPDX-License-Identifier: Apache-2.0
"""Another process that samples how full a tmpfs is, and how many files a daemon has open.

As a program: ``python memory_watch.py DIRECTORY PID`` prints ``watching``, samples as fast as it can
until its input ends, then prints the highest number of bytes it ever saw in use, and the highest
number of descriptors of any process of the family of PID (itself and its children).
"""

from __future__ import annotations

import os
import select
import subprocess
import sys
from types import TracebackType


class MemoryWatch:
    """Runs this module as a program; what it saw is known after the ``with`` block."""

    def __init__(self, directory: str, pid: int) -> None:
        self.peak_bytes = -1
        self.peak_descriptors = -1
        self._process = subprocess.Popen(
            [sys.executable, "-I", __file__, directory, str(pid)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def __enter__(self) -> MemoryWatch:
        assert self._process.stdout is not None
        assert self._process.stdout.readline().strip() == "watching"
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        out, _ = self._process.communicate()
        self.peak_bytes, self.peak_descriptors = map(int, out.split())


def _count(pid: int) -> int:
    """Descriptors of a process; 0 if it has ended."""
    try:
        return len(os.listdir(f"/proc/{pid}/fd"))
    except OSError:
        return 0


def _descriptors(pid: int) -> int:
    """Most descriptors that a process or one of its children has open now."""
    try:
        with open(f"/proc/{pid}/task/{pid}/children") as file:
            children = [int(child) for child in file.read().split()]
    except OSError:
        children = []
    return max(map(_count, [pid, *children]))


def main() -> None:
    """Sample until the input ends."""
    directory, pid = sys.argv[1], int(sys.argv[2])
    peak = descriptors = samples = 0
    print("watching", flush=True)
    while True:
        state = os.statvfs(directory)
        peak = max(peak, (state.f_blocks - state.f_bfree) * state.f_frsize)
        samples += 1
        # a hundred looks to one that asks whether to end: bursts of a fraction of a millisecond show
        if samples % 100 == 0:
            descriptors = max(descriptors, _descriptors(pid))
            if select.select([0], [], [], 0.0005)[0]:
                break
    print(peak, descriptors)


if __name__ == "__main__":
    main()
