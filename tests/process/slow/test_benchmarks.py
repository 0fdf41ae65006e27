# SPDX-License-Identifier: Apache-2.0
"""Every benchmark is on the page, every one on the page starts, and anyone can run those that need data."""

from __future__ import annotations

import json
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


STARTS = """
import contextlib, io, json, runpy, sys
results = {}
for line in sys.argv[1:]:
    module, *sys.argv[1:] = line.split()
    out, err, code = io.StringIO(), io.StringIO(), None
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            runpy.run_module("tests.benchmarks." + module, run_name="__main__", alter_sys=True)
    except SystemExit as end:
        code = end.code
    results[module] = code, out.getvalue(), err.getvalue()
print(json.dumps(results))
"""


def started(*lines: str, data: Path | None = None) -> dict[str, tuple[object, str, str]]:
    """Return how each of these ended and what it printed; one process for all, they import the same."""
    environment = {key: value for key, value in os.environ.items() if key != "SHMMAP_TEST_DATA"}
    environment |= {"SHMMAP_TEST_DATA": str(data)} if data else {}
    done = subprocess.run(
        [sys.executable, "-c", STARTS, *lines],
        cwd=ROOT,
        env=environment,
        check=True,
        capture_output=True,
        text=True,
    )
    ended: dict[str, tuple[object, str, str]] = json.loads(done.stdout)
    return ended


def test_every_one_starts() -> None:
    ended = started(*(f"{name} --help" for name in MODULES))
    assert {name: one for name, one in ended.items() if not one[1].startswith("usage: ") or one[0]} == {}
    assert sorted(ended) == MODULES


@pytest.mark.parametrize("name", MODULES)
def test_its_docstring_says_how_to_run_it(name: str) -> None:
    assert f"    python -m tests.benchmarks.{name}" in docstring(name) or name in NEED_DATA


def test_without_data_they_say_how_to_make_some() -> None:
    ended = started(*NEED_DATA)
    hint = "hint: python -m tests.benchmarks.make_data"  # a message instead of a code is exit 1
    assert {name: one for name, one in ended.items() if hint not in str(one[0])} == {}
    assert sorted(ended) == NEED_DATA


def test_one_is_run_by_its_name() -> None:
    """The page's own command; its limits are those of memory, which other work does not change."""
    (command,) = PAGE.commands("one")
    *python, name = command.split()
    assert python == ["python", "-m"]
    code, printed, errors = started(name.rpartition(".")[2])["memory"]
    assert not code, printed + errors


def test_every_row_of_what_once_held_others_up_has_a_scene() -> None:
    _, listed, _ = started("hostile_p99 --list")["hostile_p99"]
    rows = [f"A{number}" for number in (*range(1, 10), 11, 12, 13, 16, 17, *range(21, 25))] + ["B3"]
    assert [line.split()[0] for line in listed.splitlines()] == [*rows, "churn", "worst-five"]


def test_a_scene_that_is_over_no_limit_ends_well() -> None:
    """One of the quick ones, which time cannot fail: it shows that scenes can be played."""
    code, printed, errors = started("hostile_p99 --scene A16")["hostile_p99"]
    assert code == 0, printed + errors
    assert printed.splitlines()[-2].split() == ["A16", "-", "-", "-", "-", "-", "OK"]


def test_the_page_marks_those_that_need_data() -> None:
    assert sorted(re.findall(r"^\| `(\w+)` \(street\) \|", PAGE.text, re.MULTILINE)) == NEED_DATA


def test_localization_is_measured_on_data_that_anyone_can_make(tmp_path: Path) -> None:
    make, export = PAGE.commands("data")
    assert make.startswith("python -m tests.benchmarks.make_data ")
    assert export.startswith("export SHMMAP_TEST_DATA=")
    data = tmp_path / "data"
    lines = f"make_data {data} --density 8", "ndt_accuracy --seeds 1 --disturbance planar"
    ended = started(*lines, data=data)
    assert [code for code, _, _ in ended.values()] == [None, None], ended
    shares = dict(re.findall(r"^(.+?) +(\d+\.\d+)% within", ended["ndt_accuracy"][1], re.MULTILINE))
    assert len(shares) == 9
    assert shares["simulated scans, 0.5 m, 6000 points, planar, fine"] == "100.00"
    assert shares["generated city, 1500 points, planar, fine"] == "100.00"
