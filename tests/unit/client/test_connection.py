# SPDX-License-Identifier: Apache-2.0
"""A client that has no name of its own goes by its program's, however that was started."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = "from shmmap.client.connection import program_name\nprint(program_name())\n"


def printed(*arguments: str, cwd: Path, program: str = "") -> str:
    done = subprocess.run(
        [sys.executable, *arguments], cwd=cwd, input=program, capture_output=True, text=True, check=True
    )
    return done.stdout.removesuffix("\n")


@pytest.fixture
def programs(tmp_path: Path) -> Path:
    package = tmp_path / "vehicle"
    package.mkdir()
    (package / "__init__.py").touch()
    for path in (tmp_path / "localize.py", package / "perceive.py", package / "__main__.py"):
        path.write_text(PROGRAM)
    return tmp_path


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        (["localize.py"], "localize.py"),
        (["vehicle/perceive.py"], "perceive.py"),
        (["-m", "localize"], "localize"),
        (["-m", "vehicle.perceive"], "vehicle.perceive"),
        (["-m", "vehicle"], "vehicle"),
        (["vehicle"], "vehicle"),  # a directory with a __main__
        (["-c", PROGRAM], ""),
        (["-"], ""),
    ],
)
def test_names(programs: Path, arguments: list[str], name: str) -> None:
    assert printed(*arguments, cwd=programs, program=PROGRAM) == name


def test_a_long_name_is_cut(programs: Path) -> None:
    long = "a" * 100 + ".py"
    (programs / long).write_text(PROGRAM)
    assert printed(long, cwd=programs) == "a" * 64
