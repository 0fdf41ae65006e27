# SPDX-License-Identifier: Apache-2.0
"""Mutants: the same seed draws the same ones, of every kind; each is a valid program that differs."""

from __future__ import annotations

import ast
from collections import Counter
from pathlib import Path

import pytest

from tests.benchmarks.mutants import Mutant, carry, caught_together, draw, mutants_of, own_files
from tests.support.daemon_process import ROOT

CODE = """
import os

def write(fd: int = 1, version: int = 2, *, room=3) -> None:
    "Text."
    with self._lock, self._blocked:
        os.fsync(fd)
        self.after_s = now_ns / 1e9
    if version != 7 or "\u00e4" and fd is None:
        raise ValueError(f"{fd == 1}")
    return min(fd, limit)
"""
WANTED = {
    ("fsync left out", "os.fsync(fd)", "pass"),
    ("lock not taken", "self._lock", "__import__('contextlib').nullcontext()"),
    ("nanoseconds for seconds", "1e9", "1"),
    ("version not compared", "version != 7", "False"),
    ("comparison turned", "fd is None", "fd is not None"),
    ("error not raised", 'raise ValueError(f"{fd == 1}")', "pass"),
    ("bound dropped", "min(fd, limit)", "(fd)"),
    ("bound dropped", "min(fd, limit)", "(limit)"),
    ("number one off", "3", "4"),
}


@pytest.fixture
def made(tmp_path: Path) -> list[Mutant]:
    (tmp_path / "package").mkdir()
    (tmp_path / "package/module.py").write_text(CODE, encoding="utf-8")
    return mutants_of(tmp_path, "package")


def test_each_kind_is_found(made: list[Mutant]) -> None:
    assert {(one.kind, one.old, one.new) for one in made} >= WANTED
    kinds = Counter(one.kind for one in made)
    assert (kinds["lock not taken"], kinds["error not raised"], kinds["call left out"]) == (1, 1, 0)
    assert kinds["condition dropped"] == 4
    assert kinds["number one off"] == 4, "three defaults, one number; none in texts"


def test_a_mutant_is_a_program_that_differs_in_one_place(made: list[Mutant], tmp_path: Path) -> None:
    file = tmp_path / "package/module.py"
    for one in made:
        one.apply(tmp_path)
        text = file.read_text(encoding="utf-8")
        assert ast.dump(ast.parse(text)) != ast.dump(ast.parse(CODE)), one
        assert text.splitlines()[one.line - 1] != CODE.splitlines()[one.line - 1]
        file.write_text(CODE, encoding="utf-8")


def test_the_same_seed_draws_the_same_ones_spread_over_packages() -> None:
    first = draw(ROOT, "a seed", 28)
    assert first == draw(ROOT, "a seed", 28)
    assert first != draw(ROOT, "another", 28)
    assert Counter("/".join(one.path.split("/")[: 3 if "daemon" in one.path else 2]) for one in first) == {
        "shmmap/daemon/cache": 4,
        "shmmap/daemon/loading": 4,
        "shmmap/daemon/requests": 4,
        "shmmap/live_worker": 4,
        "shmmap/client": 4,
        "shmmap/segment": 4,
        "shmmap/origin": 4,
    }


@pytest.mark.slow
def test_mutants_broken_together_are_caught_one_by_one(tmp_path: Path) -> None:
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    for tree in (whole, broken):
        (tree / "package").mkdir(parents=True)
        (tree / "package/__init__.py").write_text("")
        (tree / "package/sums.py").write_text(
            "def more(x):\n    return x + 1\n\ndef less(x):\n    return x - 1\n"
        )
        (tree / "package/unseen.py").write_text("def unseen(x):\n    return x + 1\n")
        (tree / "test_sums.py").write_text(
            "from package.sums import less, more\n"
            "def test_both():\n    assert (more(1), less(1)) == (2, 0)\n"
            "def test_random():\n    raise OSError\n"
        )
    mutants = [one for one in mutants_of(whole, "package") if one.kind == "number one off"]
    assert [one.path for one in mutants] == ["package/sums.py", "package/sums.py", "package/unseen.py"]

    caught = caught_together([0, 1, 2], mutants, whole, broken, "test_sums.py", 60.0)

    assert caught == {0: "test_sums.py::test_both", 1: "test_sums.py::test_both"}
    assert (broken / "package/sums.py").read_text() == (whole / "package/sums.py").read_text()


def test_mutants_are_found_in_another_checkout(tmp_path: Path) -> None:
    """In another module, indented otherwise, also where several places of a line could be meant."""
    old, new = tmp_path / "old", tmp_path / "new"
    for tree in (old, new):
        (tree / "shmmap/package").mkdir(parents=True)
    (old / "shmmap/package/small.py").write_text(
        "left = 1\nif left == (1 and\n    2):\n    gone = 3\nboth = [7, 7]\n"
    )
    (old / "shmmap/package/twice.py").write_text("one = 5\n")
    (new / "shmmap/large.py").write_text(
        "def all():\n    left = 1\n    if left == (1 and\n            2):\n        pass\n"
        "    both = [7, 7]\n    one = 5\n"
    )
    (new / "shmmap/package/twice.py").write_text("one = 5\n")

    found = {}
    for one in mutants_of(old, "shmmap"):
        carried = carry(one, old, new)
        found[one.line, one.old, one.at] = carried and (carried.path, carried.line)
        if carried is not None:
            assert carried.new == one.new
            whole = (new / carried.path).read_text()
            carried.apply(new)  # its place has what it changes
            (new / carried.path).write_text(whole)

    places = {(line, text): where for (line, text, _), where in found.items()}
    assert places[1, "1"] == ("shmmap/large.py", 2)
    assert places[4, "3"] is None
    assert places[5, "7"] == ("shmmap/large.py", 6)
    assert places[1, "5"] == ("shmmap/package/twice.py", 1)


def test_files_about_a_mutants_module_and_function_come_first(tmp_path: Path) -> None:
    """A name that few files mention counts more; a module without tests in its folder has those above it."""
    (tmp_path / "shmmap/package/deep").mkdir(parents=True)
    (tmp_path / "shmmap/package/deep/boxes.py").write_text(
        "class Box:\n    def rarely(self):\n        return 1\n\ndef other():\n    return 2\n"
    )
    tests = tmp_path / "tests/unit/package"
    tests.mkdir(parents=True)
    (tests / "test_about_all.py").write_text("Box, other\n")
    (tests / "test_boxes.py").write_text("Box().open()\n")
    (tests / "test_nothing.py").write_text("boxed, inbox\n")
    (tests / "test_rare.py").write_text("Box().rarely()\n")
    one, two = mutants_of(tmp_path, "shmmap/package")

    first, second = ([file.name for file in own_files(tmp_path, mutant)] for mutant in (one, two))
    assert first == ["test_boxes.py", "test_rare.py", "test_about_all.py", "test_nothing.py"]
    assert second[:2] == ["test_about_all.py", "test_boxes.py"]
