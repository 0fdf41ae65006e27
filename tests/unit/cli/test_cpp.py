# SPDX-License-Identifier: Apache-2.0
"""``shmmap cpp``, and what is written in several places about the C++ header: versions, the first program."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest

import shmmap
from shmmap.cli.verbs.run.about import prefix
from tests.support.daemon_process import ROOT
from tests.support.pages import read_page
from tests.unit.conftest import Verb

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

CPP = ROOT / "clients" / "cpp"


@pytest.mark.parametrize(
    ("option", "says", "file"),
    [
        ("--includes", f"-I{CPP}/include\n", "include/shmmap/shmmap.hpp"),
        ("--cmakedir", f"{CPP}/share/cmake/shmmap\n", "share/cmake/shmmap/shmmapConfig.cmake"),
        ("--pkgconfigdir", f"{CPP}/share/pkgconfig\n", "share/pkgconfig/shmmap.pc"),
    ],
)
def test_a_checkout_is_used_where_it_lies(option: str, says: str, file: str, verb: Verb) -> None:
    assert verb(["cpp", option]).out == says
    assert (CPP / file).is_file()
    assert str((CPP / file).parent).startswith(says.removeprefix("-I").rstrip())


def test_without_an_option_it_says_how_to_compile(verb: Verb) -> None:
    assert f"\n  g++ -std=c++17 -I{CPP}/include PROGRAM.cpp\n" in verb(["cpp"]).out


def test_a_shell_reads_one_option(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, verb: Verb) -> None:
    package = tmp_path / "two words" / "shmmap"
    header = package / "_cpp" / "include" / "shmmap" / "shmmap.hpp"
    header.parent.mkdir(parents=True)
    header.touch()
    monkeypatch.setattr(shmmap, "__file__", str(package / "__init__.py"))
    assert verb(["cpp", "--includes"]).out == f"'-I{package}/_cpp/include'\n"
    assert verb(["cpp", "--cmakedir"]).out == f"{package}/_cpp/share/cmake/shmmap\n"


def test_an_installation_that_came_without_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, verb: Verb
) -> None:
    monkeypatch.setattr(shmmap, "__file__", str(tmp_path / "shmmap" / "__init__.py"))
    assert "came without its C++ header" in verb(["cpp"], 70).err


def test_a_wheel_has_it_where_it_is_looked_for_first() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    included = project["tool"]["hatch"]["build"]["targets"]["wheel"]["force-include"]
    assert prefix() == CPP
    for folder in ("include", "share"):
        assert included[f"clients/cpp/{folder}"] == f"shmmap/_cpp/{folder}"


@pytest.mark.parametrize(
    ("file", "pattern"),
    [
        ("package.xml", r"<version>(.+)</version>"),
        ("share/cmake/shmmap/shmmapConfigVersion.cmake", r"set\(PACKAGE_VERSION (.+)\)"),
        ("share/pkgconfig/shmmap.pc", r"\nVersion: (.+)\n"),
    ],
)
def test_versions_are_the_package_s(file: str, pattern: str) -> None:
    text = (CPP / file).read_text(encoding="utf-8")
    assert re.findall(pattern, text) == [shmmap.__version__]


def test_pages_show_the_first_program_as_it_is() -> None:
    program = (CPP / "examples" / "first_cells.cpp").read_text(encoding="utf-8")
    shown = read_page("clients/cpp/README.md").blocks["first-cells"]
    assert len(shown) == 5
    assert "\n".join(f"  {line}" for line in shown) in program
