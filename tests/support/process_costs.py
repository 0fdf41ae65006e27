# SPDX-License-Identifier: Apache-2.0
"""What processes cost, by the kernel's books."""

from __future__ import annotations

import os
import select
import subprocess
import sys
from pathlib import Path
from types import TracebackType


def proportional_bytes(pid: int) -> int:
    """Proportional set size of a process: its own pages, and its share of those it shares."""
    for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines():
        if line.startswith("Pss:"):
            return int(line.split()[1]) * 1024
    raise AssertionError("no Pss")


def proportional_bytes_under(pid: int, directory: str) -> int:
    """The part of it that belongs to mappings of files in a directory."""
    total, inside = 0, False
    for line in Path(f"/proc/{pid}/smaps").read_text().splitlines():
        first = line.split(maxsplit=1)[0]
        if not first.endswith(":"):
            inside = f" {directory}/" in line
        elif inside and first == "Pss:":
            total += int(line.split()[1]) * 1024
    return total


def resident_bytes(pid: int) -> int:
    """Memory that a process has now."""
    return _status_bytes(pid, "VmRSS")


def anonymous_bytes(pid: int) -> int:
    """Memory of its own that it has now; libraries, which other processes may share or not, are left out."""
    return _status_bytes(pid, "RssAnon")


def peak_bytes(pid: int) -> int:
    """Most memory that a process ever had."""
    return _status_bytes(pid, "VmHWM")


def _status_bytes(pid: int, name: str) -> int:
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith(f"{name}:"):
            return int(line.split()[1]) * 1024
    raise AssertionError(f"no {name}")


def processor_s(pid: int) -> float:
    """Processor time of a process and all its threads so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def descriptors(pid: int) -> int:
    """How many files a process has open."""
    return len(os.listdir(f"/proc/{pid}/fd"))


def mappings_under(path: str) -> int:
    """How many mappings of files below ``path`` this process has."""
    return sum(path in line for line in Path("/proc/self/maps").read_text().splitlines())


# Another process that samples how full a tmpfs is, and how many files a daemon has open


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
