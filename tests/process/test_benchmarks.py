# SPDX-License-Identifier: Apache-2.0
"""Every benchmark is on the page, every one on the page starts, and anyone can run those that need data."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.daemon_process import ROOT
from tests.support.pages import read_page

PAGE = read_page("tests/benchmarks/BENCHMARKS.md")
MODULES = sorted(
    path.stem
    for path in (ROOT / "tests" / "benchmarks").glob("*.py")
    if 'if __name__ == "__main__":' in path.read_text(encoding="utf-8")
)


def docstring(name: str) -> str:
    """Return a benchmark's docstring."""
    return (ROOT / "tests" / "benchmarks" / f"{name}.py").read_text(encoding="utf-8").split('"""')[1]


NEED_DATA = [
    name for name in MODULES if f"SHMMAP_TEST_DATA=DIR python -m tests.benchmarks.{name}" in docstring(name)
]


def test_the_page_names_every_benchmark_and_no_other() -> None:
    assert sorted(set(re.findall(r"^\| `(\w+)`", PAGE.text, re.MULTILINE))) == MODULES


@pytest.mark.parametrize("name", MODULES)
def test_it_starts(name: str) -> None:
    done = subprocess.run(
        [sys.executable, "-m", f"tests.benchmarks.{name}", "--help"],
        cwd=ROOT,
        check=True,
        capture_output=True,
        text=True,
    )
    assert done.stdout.startswith("usage: ")


@pytest.mark.parametrize("name", MODULES)
def test_its_docstring_says_how_to_run_it(name: str) -> None:
    assert f"    python -m tests.benchmarks.{name}" in docstring(name) or name in NEED_DATA


@pytest.mark.parametrize("name", NEED_DATA)
def test_without_data_it_says_how_to_make_some(name: str) -> None:
    environment = {key: value for key, value in os.environ.items() if key != "SHMMAP_TEST_DATA"}
    done = subprocess.run(
        [sys.executable, "-m", f"tests.benchmarks.{name}"],
        cwd=ROOT, env=environment, check=False, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 1
    assert "hint: python -m tests.benchmarks.make_data" in done.stderr


def test_every_row_of_what_once_held_others_up_has_a_scene() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "tests.benchmarks.hostile_p99", "--list"],
        cwd=ROOT, check=True, capture_output=True, text=True,
    )  # fmt: skip
    rows = [f"A{number}" for number in range(1, 23)] + ["B1", "B2", "B3"]
    assert [line.split()[0] for line in done.stdout.splitlines()] == [*rows, "churn", "worst-five"]


def test_a_scene_that_is_over_no_limit_ends_well() -> None:
    """One of the quick ones, which time cannot fail: it shows that scenes can be played."""
    done = subprocess.run(
        [sys.executable, "-m", "tests.benchmarks.hostile_p99", "--scene", "A18"],
        cwd=ROOT, check=False, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.splitlines()[-2].split() == ["A18", "-", "-", "-", "-", "-", "OK"]


def test_the_page_marks_those_that_need_data() -> None:
    assert sorted(re.findall(r"^\| `(\w+)` \(street\) \|", PAGE.text, re.MULTILINE)) == NEED_DATA


def test_localization_is_measured_on_data_that_anyone_can_make(tmp_path: Path) -> None:
    make, export = PAGE.commands("data")
    assert make.startswith("python -m tests.benchmarks.make_data ")
    assert export.startswith("export SHMMAP_TEST_DATA=")
    environment = {**os.environ, "SHMMAP_TEST_DATA": str(tmp_path / "data")}

    def run(*words: str) -> str:
        done = subprocess.run(
            [sys.executable, "-m", *words],
            cwd=ROOT, env=environment, check=False, capture_output=True, text=True,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        return done.stdout

    run("tests.benchmarks.make_data", str(tmp_path / "data"), "--density", "20")
    told = run("tests.benchmarks.ndt_accuracy", "--seeds", "1", "--disturbance", "planar")
    shares = dict(re.findall(r"^(.+?) +(\d+\.\d+)% within", told, re.MULTILINE))
    assert len(shares) == 9
    assert shares["simulated scans, 0.5 m, 6000 points, planar, fine"] == "100.00"
    assert shares["generated city, 1500 points, planar, fine"] == "100.00"
