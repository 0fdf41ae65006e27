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
PROGRAM = """
import sys
from shmmap.failpoints import step
for _ in range(5):
    step("daemon.link")
    step("daemon.unlink")
    print("lives", flush=True)
"""


def run(wanted: str) -> tuple[int, int]:
    """Exit code and how far it came."""
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        env={**os.environ, "SHMMAP_TEST_CRASH": wanted},
        capture_output=True,
        text=True,
    )
    return done.returncode, done.stdout.count("lives")


def test_each_step_is_in_the_code_once() -> None:
    found: Counter[str] = Counter()
    for path in Path(shmmap.__file__).parent.rglob("*.py"):
        found.update(re.findall(r'\bstep\("([a-z.]+)"\)', path.read_text(encoding="utf-8")))
    assert found == Counter(EVERY)


def steps_taken(wanted: str | None) -> tuple[int, list[str]]:
    """Exit code of a program that takes every step, and the last ones it took."""
    environment = {name: value for name, value in os.environ.items() if name != "SHMMAP_TEST_CRASH"}
    if wanted is not None:
        environment["SHMMAP_TEST_CRASH"] = wanted
    program = (
        f"from shmmap.failpoints import step\nfor label in {EVERY}: step(label); print(label, flush=True)"
    )
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True)
    return done.returncode, done.stdout.split()


@pytest.mark.parametrize("wanted", [None, ""])
def test_nothing_happens_without_the_variable(wanted: str | None) -> None:
    assert steps_taken(wanted) == (0, list(EVERY))


@pytest.mark.parametrize("label", EVERY)
def test_with_it_that_step_and_no_other_is_the_last(label: str) -> None:
    assert steps_taken(label) == (-signal.SIGKILL, list(EVERY[: EVERY.index(label)]))


def test_the_nth_time_is_the_last() -> None:
    assert run("daemon.link") == (-signal.SIGKILL, 0)
    assert run("daemon.unlink:3") == (-signal.SIGKILL, 2)
    assert run("daemon.unlink:9") == (0, 5)


def test_only_one_process_dies_for_a_file(tmp_path: Path) -> None:
    wanted = f"daemon.link:2:{tmp_path}/reached"
    assert run(wanted) == (-signal.SIGKILL, 1)
    assert (tmp_path / "reached").exists()
    assert run(wanted) == (0, 5)


def test_a_name_that_does_not_exist_is_an_error() -> None:
    assert run("daemon.nowhere")[0] == 1
