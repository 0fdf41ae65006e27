# SPDX-License-Identifier: Apache-2.0
"""What a run of the tests started does not outlive it, however it ends."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.daemon_process import ROOT, wait_ended

STUCK = """
import os, signal, subprocess, sys
def test_stuck():
    busy = subprocess.Popen([sys.executable, "-c", "while True: pass"])
    fork = os.fork()
    if fork == 0:
        while True:
            signal.pause()
    with open("pids", "w") as file:
        print(busy.pid, fork, file=file)
    {end}
"""


@pytest.mark.parametrize(
    ("end", "code"), [("os.kill(os.getpid(), 9)", -signal.SIGKILL), ("signal.pause()", 1)]
)
def test_a_run_that_is_ended_takes_its_processes_with_it(tmp_path: Path, end: str, code: int) -> None:
    (tmp_path / "test_it.py").write_text(STUCK.format(end=end))
    done = subprocess.run(
        [
            sys.executable, "-m", "pytest", "-q", "-p", "no:dash", "-p", "tests.support.survivors",
            "--rootdir=.", "-o", "faulthandler_timeout=1", "-o", "faulthandler_exit_on_timeout=true",
        ],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )  # fmt: skip
    assert done.returncode == code, done.stdout + done.stderr
    for pid in map(int, (tmp_path / "pids").read_text().split()):
        try:
            assert wait_ended(pid)
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
