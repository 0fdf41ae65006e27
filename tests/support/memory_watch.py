# SPDX-License-Identifier: Apache-2.0
"""Another process that samples how full a tmpfs is, as fast as it can.

As a program: ``python memory_watch.py DIRECTORY`` prints ``watching``, samples until its input
ends, then prints the highest number of bytes it ever saw in use.
"""

from __future__ import annotations

import os
import select
import subprocess
import sys
from types import TracebackType


class MemoryWatch:
    """Runs this module as a program; ``peak_bytes`` is known after the ``with`` block."""

    def __init__(self, directory: str) -> None:
        self.peak_bytes = -1
        self._process = subprocess.Popen(
            [sys.executable, "-I", __file__, directory],
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
        self.peak_bytes = int(out)


def main() -> None:
    """Sample until the input ends."""
    directory, peak, samples = sys.argv[1], 0, 0
    print("watching", flush=True)
    while True:
        state = os.statvfs(directory)
        peak = max(peak, (state.f_blocks - state.f_bfree) * state.f_frsize)
        samples += 1
        # a hundred looks to one that asks whether to end: bursts of a fraction of a millisecond show
        if samples % 100 == 0 and select.select([0], [], [], 0.0005)[0]:
            break
    print(peak)


if __name__ == "__main__":
    main()
