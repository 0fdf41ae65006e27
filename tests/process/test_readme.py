# SPDX-License-Identifier: Apache-2.0
"""The README is true: its commands and programs run as they stand, and it is short.

The program of LAYERS.md runs beside the same daemon.  The lines that make a virtual environment are run,
exactly as they stand, by ``test_first_steps.py`` from a clone, and by ``.ci/run``.
"""

from __future__ import annotations

import re
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.daemon_process import ROOT
from tests.support.pages import Reader, Terminal, read_page

README = read_page("README.md")


def test_it_is_short() -> None:
    assert len(README.text.encode()) < 6000


def test_two_lines_do_everything() -> None:
    demo, tests = (line for line in README.text.splitlines() if line.startswith("python3 -m venv "))
    assert demo.endswith(" && shmmap demo")
    assert tests.endswith(" && pytest -q")
    (everything,) = read_page("shmmap/INSTALL.md").commands("everything")
    assert demo == f"{everything} && shmmap demo"


def test_every_block_is_tested() -> None:
    assert set(README.blocks) == {"clone", "server", "points", "window", "cpp", "cpp-run"}
    assert README.fences == len(README.blocks) + 2  # the two lines have no name


def test_the_mental_model_has_ten_lines() -> None:
    assert re.findall(r"^(\d+)\. ", README.text, re.MULTILINE) == [str(n) for n in range(1, 11)]


def test_measured_rows_name_their_benchmarks() -> None:
    table = README.text.partition("## Measured")[2].partition("\n## ")[0]
    names = re.findall(r"\| `tests\.benchmarks\.(\w+)` \|$", table, re.MULTILINE)
    assert len(names) == 5
    for name in names:
        assert (ROOT / "tests" / "benchmarks" / f"{name}.py").is_file(), name


@pytest.fixture(scope="module")
def user(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Terminal]:
    """Follow the server's part of the README; the daemon runs in another terminal until the end."""
    home = tmp_path_factory.mktemp("readme")
    programs = home / "bin"
    programs.mkdir()
    for name, words in (("shmmap", "-m shmmap.cli"), ("python", "")):
        script = programs / name
        script.write_text(f'#!/bin/sh\nexec "{sys.executable}" {words} "$@"\n')
        script.chmod(0o755)
    reader = Reader(home, [programs], {"PYTHONPATH": str(ROOT)})
    try:
        first = reader.terminal()
        demo, serve = README.commands("server")
        assert demo.startswith("shmmap demo ")
        first.run(f"{demo} --density 20")  # in a fifth of the time; as it stands: test_first_steps.py
        with first.serving(serve):
            yield reader.terminal()
    finally:
        reader.leave()


def test_commands_of_a_user(user: Terminal) -> None:
    status, query = re.findall(r"`(shmmap (?:status|query)[^`]*)`", README.text)
    assert "healthy" in user.run(status)
    assert "town_160_160.pcd" in user.run(query)


def test_three_lines_of_python(user: Terminal) -> None:
    program = README.blocks["points"]
    assert len([line for line in program if line]) == 3
    number = re.fullmatch(r"(\d+) points\n", user.python(program))
    assert number is not None
    assert int(number[1]) > 10_000


def test_following_a_vehicle(user: Terminal) -> None:
    numbers = re.fullmatch(r"(\d+) cells, (\d+) points near\n", user.python(README.blocks["window"]))
    assert numbers is not None
    assert int(numbers[1]) > 50
    assert int(numbers[2]) > 10_000


def test_from_cpp(user: Terminal, tmp_path: Path) -> None:
    """The program counts what the three lines of Python count; what is shown compiles as it stands."""
    if shutil.which("g++") is None:
        pytest.skip("g++ is missing")
    build, run = README.commands("cpp-run")
    user.run(f"ln -s '{ROOT}/clients'")  # the reader is in the clone
    user.run(build)
    python = user.python(README.blocks["points"])
    assert user.run(run).startswith(python.replace("\n", " in "))
    shown = tmp_path / "drive.cpp"
    shown.write_text("\n".join(README.blocks["cpp"]) + "\n", encoding="utf-8")
    user.run(
        f"g++ -std=c++17 -c -Wall -Wextra -Werror $(shmmap cpp --includes) '{shown}' -o '{tmp_path}/drive.o'"
    )


def test_a_layer(user: Terminal) -> None:
    told = user.python(read_page("shmmap/layers/LAYERS.md").blocks["layers"]).splitlines()
    assert len(told) >= 4
    for line in told:
        found = re.fullmatch(r"\((\d+), 3\) \((\d+), 6\) Lattice\(leaf=\(2.0, 2.0, 2.0\), .*\)", line)
        assert found is not None, line
        assert found[1] == found[2]
