# SPDX-License-Identifier: Apache-2.0
"""The places where tests can kill a process: each is somewhere in the code, once, and harmless by default."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

import shmmap
from shmmap.failpoints import CLIENT_STEPS, DAEMON_STEPS, LIVE_STEPS, ORIGIN_STEPS, WORKER_STEPS

EVERY = (*WORKER_STEPS, *DAEMON_STEPS, *LIVE_STEPS, *ORIGIN_STEPS, *CLIENT_STEPS)
PROGRAM = f"""
from shmmap.failpoints import step
for label in {5 * EVERY}:
    step(label)
    print(label, flush=True)
"""


def taken(wanted: str | None) -> tuple[int, int]:
    """Return the exit code of a program that takes every step five times, and how many it took."""
    environment = {name: value for name, value in os.environ.items() if name != "SHMMAP_TEST_CRASH"}
    if wanted is not None:
        environment["SHMMAP_TEST_CRASH"] = wanted
    done = subprocess.run([sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True)
    return done.returncode, len(done.stdout.split())


def test_each_step_is_in_the_code_once() -> None:
    found: Counter[str] = Counter()
    for path in Path(shmmap.__file__).parent.rglob("*.py"):
        found.update(re.findall(r'\bstep\("([a-z.]+)"\)', path.read_text(encoding="utf-8")))
    assert found == Counter(EVERY)


@pytest.mark.parametrize("wanted", [None, "", "daemon.unlink:6"])
def test_nothing_happens_without_the_variable_or_before_its_time(wanted: str | None) -> None:
    assert taken(wanted) == (0, 5 * len(EVERY))


@pytest.mark.parametrize("steps", [WORKER_STEPS, DAEMON_STEPS, LIVE_STEPS, ORIGIN_STEPS, CLIENT_STEPS])
@pytest.mark.parametrize("time", [1, 3])
def test_that_step_and_no_other_is_the_last(steps: tuple[str, ...], time: int) -> None:
    label = steps[-1]
    before = EVERY.index(label) + (time - 1) * len(EVERY)
    assert taken(label if time == 1 else f"{label}:{time}") == (-signal.SIGKILL, before)


def test_only_one_process_dies_for_a_file(tmp_path: Path) -> None:
    wanted = f"daemon.link:2:{tmp_path}/reached"
    assert taken(wanted)[0] == -signal.SIGKILL
    assert (tmp_path / "reached").exists()
    assert taken(wanted) == (0, 5 * len(EVERY))


def test_a_name_that_does_not_exist_is_an_error() -> None:
    assert taken("daemon.nowhere")[0] == 1
