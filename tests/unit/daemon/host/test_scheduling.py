# SPDX-License-Identifier: Apache-2.0
"""Short turns are the kernel's to grant; niceness and policy are not touched by asking."""

from __future__ import annotations

import os
import platform
import re
import subprocess
import sys

import pytest

PROGRAM = """
import os, threading
from shmmap.daemon.host.scheduling import SERVING_SLICE_NS, slice_ns, take_slices
os.nice(3)
usual = slice_ns()
agreed = take_slices(SERVING_SLICE_NS)
inherited = []
thread = threading.Thread(target=lambda: inherited.append(slice_ns()))
thread.start(); thread.join()
short = slice_ns()
take_slices(0)
print(usual, int(agreed), short, inherited[0], slice_ns())
print(os.getpriority(os.PRIO_PROCESS, 0), os.sched_getscheduler(0))
"""


def run(*command: str) -> list[int]:
    done = subprocess.run(
        [*command, sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True
    )
    return [int(word) for word in done.stdout.split()]


def test_the_kernel_grants_short_turns_where_it_knows_them() -> None:
    usual, agreed, short, inherited, after, niceness, policy = run()
    assert niceness == min(19, os.getpriority(os.PRIO_PROCESS, 0) + 3)
    assert policy == os.SCHED_OTHER
    assert after == usual
    major, minor = map(int, re.findall(r"\d+", platform.release())[:2])
    if (major, minor) < (6, 12) or platform.machine() not in ("x86_64", "aarch64"):
        pytest.skip(f"Linux {major}.{minor} on {platform.machine()} does not let threads choose their turns")
    assert (agreed, short, inherited) == (1, 100_000, 100_000)


def test_another_policy_is_left_alone() -> None:
    _, agreed, _, _, _, _, policy = run("chrt", "--batch", "0")
    assert (agreed, policy) == (0, os.SCHED_BATCH)
