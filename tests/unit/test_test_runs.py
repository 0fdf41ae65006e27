# SPDX-License-Identifier: Apache-2.0
"""Runs of the tests: only listed tests may be skipped, and no process outlives a run."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.daemon_process import ROOT, wait_ended
from tests.support.skips import NEEDS_ROOT, allowed_patterns

TESTS = """
import pytest
def test_good(): pass
@pytest.mark.skip(reason="no reason")
def test_skipped(): pass
@pytest.mark.xfail
def test_expected(): assert False
"""


def run(where: Path, listed: str | None, tests: str = TESTS) -> subprocess.CompletedProcess[str]:
    (where / "test_it.py").write_text(tests)
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("SHMMAP_", "PYTEST_"))} | {
        "PYTHONPATH": str(ROOT)
    }
    if listed is not None:
        (where / "allowed.txt").write_text(listed)
        environment["SHMMAP_TEST_ALLOWED_SKIPS"] = str(where / "allowed.txt")
    return subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:dash", "-p", "tests.support.skips", "--rootdir=."],
        cwd=where,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("listed", "code"),
    [(None, 0), ("", 1), ("# *\n", 1), ("*::test_skipped  because\n", 0), ("*::test_other\n", 1)],
)
def test_only_listed_tests_may_be_skipped(tmp_path: Path, listed: str | None, code: int) -> None:
    done = run(tmp_path, listed)
    assert done.returncode == code, done.stdout + done.stderr
    assert ("test_it.py::test_skipped: Skipped: no reason" in done.stdout) == bool(code)
    assert "1 skipped. 1: no reason\n" in done.stdout


def test_what_needs_root_is_left_to_root(tmp_path: Path) -> None:
    tests = f"import pytest\n@pytest.mark.skip(reason={NEEDS_ROOT!r})\ndef test_it(): pass\n"
    assert run(tmp_path, "", tests).returncode == 0


def test_a_skipped_module_counts(tmp_path: Path) -> None:
    tests = "import pytest\npytest.importorskip('no_such_module_at_all')\ndef test_good(): pass\n"
    assert run(tmp_path, "", tests + "\n").returncode in (1, 5)
    (tmp_path / "test_more.py").write_text("def test_good(): pass\n")
    assert run(tmp_path, "", tests).returncode == 1
    assert run(tmp_path, "test_it.py why\n", tests).returncode == 0


def test_the_list_names_reasons() -> None:
    text = (ROOT / "tests" / "allowed_skips.txt").read_text(encoding="utf-8")
    entries = [line for line in text.splitlines() if line and not line.startswith("#")]
    assert len(allowed_patterns(text)) == len(entries)
    assert all(len(entry.split(maxsplit=1)) == 2 for entry in entries)


# --- which tests a run has --------------------------------------------------------------------------------

MARKED = """
import pytest
def test_quick(): pass
@pytest.mark.slow
def test_slow(): pass
@pytest.mark.parametrize("one", ["quick", pytest.param("slow", marks=pytest.mark.slow)])
def test_each(one): pass
"""
QUICK = {"marked::test_quick", "marked::test_each[quick]", "slowly::test_it"}
REST = {"marked::test_slow", "marked::test_each[slow]", "slow::test_it", "systemd::test_it"}
SELECTIONS = {
    "": QUICK,
    "unit": QUICK,
    "--slow": REST,
    "--all": QUICK | REST,
    "unit/slow": {"slow::test_it"},
    "unit/slow/test_slow.py": {"slow::test_it"},
    "unit/test_marked.py": {"marked::test_quick", "marked::test_each[quick]"},
    "unit/test_marked.py::test_slow": {"marked::test_slow"},
    "unit --slow": REST - {"systemd::test_it"},
}
ASKING = """
import contextlib, io, json, sys
import pytest
found = []
for words in json.load(sys.stdin):
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        pytest.main(["-q", "--collect-only", "-p", "no:dash", "-p", "no:xdist", "--rootdir=.", *words])
    found.append([line for line in printed.getvalue().splitlines() if "::" in line])
json.dump(found, sys.stdout)
"""


def test_slow_tests_are_left_out_unless_asked_for(tmp_path: Path) -> None:
    for name, text in {
        "unit/test_marked.py": MARKED,
        "unit/test_slowly.py": "def test_it(): pass\n",
        "unit/slow/test_slow.py": "def test_it(): pass\n",
        "systemd/test_systemd.py": "def test_it(): pass\n",
        "pytest.ini": "[pytest]\naddopts = -p tests.support.selection --import-mode=importlib\n",
    }.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    done = subprocess.run(
        [sys.executable, "-c", ASKING],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT), "PYTEST_ADDOPTS": ""},
        input=json.dumps([words.split() for words in SELECTIONS]),
        capture_output=True,
        text=True,
        check=True,
    )
    for words, found in zip(SELECTIONS, json.loads(done.stdout), strict=True):
        assert {one.rsplit("/", 1)[1][5:].replace(".py", "") for one in found} == SELECTIONS[words], words


# --- what a run started does not outlive it ---------------------------------------------------------------


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
