# SPDX-License-Identifier: Apache-2.0
"""Short turns are the kernel's to grant, niceness and policy stay; a loader's session is made nice."""

from __future__ import annotations

import errno
import os
import platform
import re
import subprocess
import sys
from pathlib import Path

import pytest

from shmmap.daemon.host.scheduling import LOADER_GROUP_NICENESS, weigh_less

PROGRAM = """
import ctypes, os, platform, threading
from shmmap.daemon.host.scheduling import ATTRIBUTES, SCHED_SETATTR, SERVING_SLICE_NS, take_slices

def slice_ns():
    found = ctypes.create_string_buffer(ATTRIBUTES.size)
    number = SCHED_SETATTR.get(platform.machine(), -2) + 1
    ctypes.CDLL(None).syscall(number, 0, found, ATTRIBUTES.size, 0)
    return ATTRIBUTES.unpack(found.raw)[5]

os.nice(3)
usual = slice_ns()
take_slices(SERVING_SLICE_NS)
inherited = []
thread = threading.Thread(target=lambda: inherited.append(slice_ns()))
thread.start(); thread.join()
short = slice_ns()
take_slices(0)
print(usual, short, inherited[0], slice_ns())
print(os.getpriority(os.PRIO_PROCESS, 0), os.sched_getscheduler(0))
"""


def run(*command: str) -> list[int]:
    done = subprocess.run(
        [*command, sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True
    )
    return [int(word) for word in done.stdout.split()]


def test_the_kernel_grants_short_turns_where_it_knows_them() -> None:
    usual, short, inherited, after, niceness, policy = run()
    assert niceness == min(19, os.getpriority(os.PRIO_PROCESS, 0) + 3)
    assert policy == os.SCHED_OTHER
    assert after == usual
    major, minor = map(int, re.findall(r"\d+", platform.release())[:2])
    if (major, minor) < (6, 12) or platform.machine() not in ("x86_64", "aarch64"):
        pytest.skip(f"Linux {major}.{minor} on {platform.machine()} does not let threads choose their turns")
    assert (short, inherited) == (100_000, 100_000)


def test_another_policy_is_left_alone() -> None:
    usual, short, _, _, _, policy = run("chrt", "--batch", "0")
    assert (short, policy) == (usual, os.SCHED_BATCH)


WEIGH = """
import os, sys, time
from shmmap.daemon.host.scheduling import weigh_less
if sys.argv[1] == "session":
    os.setsid()
end_s = time.monotonic() + 60
while not weigh_less() and time.monotonic() < end_s:
    os.sched_yield()
print(*open("/proc/self/autogroup").read().split()[-1:], os.getpriority(os.PRIO_PROCESS, 0))
"""


def weight(session: str, *command: str) -> tuple[int, ...]:
    """Nice value of a new process's group, unless it has none, and its own."""
    done = subprocess.run(
        [*command, sys.executable, "-c", WEIGH, session], capture_output=True, text=True, check=True
    )
    return tuple(map(int, done.stdout.split()))


def group_niceness() -> tuple[int, ...]:
    """Nice value of this process's group; nothing when it is in the first one, which has none."""
    return tuple(map(int, Path("/proc/self/autogroup").read_text().split()[-1:]))


@pytest.mark.skipif(not os.path.exists("/proc/self/autogroup"), reason="this kernel has no autogroups")
def test_a_session_weighs_less_and_one_that_is_another_s_stays() -> None:
    own = os.getpriority(os.PRIO_PROCESS, 0)
    before = group_niceness()
    assert weight("session") == (LOADER_GROUP_NICENESS, own)
    assert weight("none") == (*before, own)
    assert group_niceness() == before


@pytest.mark.root
@pytest.mark.skipif(not os.path.exists("/proc/self/autogroup"), reason="this kernel has no autogroups")
def test_an_ordinary_user_s_too_though_the_kernel_takes_few_changes_a_second(tmp_path: Path) -> None:
    user = ["setpriv", "--reuid=61005", "--clear-groups"]
    for _ in range(3):  # at once: the later ones have to ask again
        assert weight("session", *user)[0] == LOADER_GROUP_NICENESS


def test_what_is_written_and_what_the_kernel_may_say(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "getsid", lambda _: os.getpid())
    assert weigh_less(proc=str(tmp_path)), "there are no such groups: nothing to ask again for"
    file = tmp_path / "autogroup"
    file.touch()
    assert weigh_less(7, str(tmp_path))
    assert file.read_text() == "7"
    before = os.listdir("/proc/self/fd")
    for number, done in ((errno.EAGAIN, False), (errno.EPERM, True), (errno.EINVAL, True)):

        def refuse(fd: int, data: bytes, number: int = number) -> int:
            raise OSError(number, os.strerror(number))

        monkeypatch.setattr(os, "write", refuse)
        assert weigh_less(proc=str(tmp_path)) == done
    assert os.listdir("/proc/self/fd") == before
