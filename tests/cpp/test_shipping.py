# SPDX-License-Identifier: Apache-2.0
"""The C++ header as users get it, by the page's own text: from a wheel, with each build system."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import shmmap
from shmmap.testing.daemon_process import without_settings
from tests.cpp.conftest import DaemonFactory
from tests.support.compiled_programs import made_once
from tests.support.daemon_process import ROOT
from tests.support.divided_map import DividedMap, make_map
from tests.support.pages import Reader, Terminal, read_page
from tests.support.skips import programs_or_skip

PAGE = read_page("clients/cpp/README.md")
CPP = ROOT / "clients" / "cpp"
EXAMPLE = CPP / "examples" / "first_cells.cpp"
COMPILE, RUN = PAGE.commands("gcc")
AUTO = """\
cmake_minimum_required(VERSION 3.16)
project(by_depend LANGUAGES CXX)
find_package(ament_cmake_auto REQUIRED)
ament_auto_find_build_dependencies()
ament_auto_add_executable(first_cells ../first_cells/first_cells.cpp)
ament_auto_package()
"""


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a virtual environment with the wheel of this tree and no package it depends on."""
    return made_once(tmp_path_factory, "installed_wheel", _install) / ".venv"


def _install(folder: Path) -> None:
    where = folder / ".venv"
    environment = without_settings()
    subprocess.run([sys.executable, "-m", "venv", where], check=True, env=environment)
    done = subprocess.run(
        [where / "bin" / "pip", "install", "-q", "--no-deps", ROOT],
        check=False,
        capture_output=True,
        text=True,
        env=environment,
    )
    if "satisfies the requirement hatchling" in done.stderr:
        pytest.skip("pip cannot reach hatchling, which builds the wheel")
    assert done.returncode == 0, done.stderr


@pytest.fixture
def home(tmp_path: Path) -> Path:
    """Return the directory in which the page's commands are typed, with the page's program in it."""
    path = tmp_path / "home"
    path.mkdir()
    (path / EXAMPLE.name).write_text(EXAMPLE.read_text(encoding="utf-8"), encoding="utf-8")
    return path


@pytest.fixture
def made(tmp_path: Path) -> DividedMap:
    """Make the map."""
    return make_map(tmp_path / "map", size=100)


@pytest.fixture
def expected(made: DividedMap) -> str:
    """Return what the first program has to say of the map."""
    names = made.in_circle(160.0, 160.0, 50.0)
    heights = np.concatenate([made.points(name)["z"] for name in names])
    return (
        f"{len(heights)} points in {len(names)} cells; 0 failed, 0 are still being loaded\n"
        f"z from {heights.min():.2f} to {heights.max():.2f} m\n"
    )


@pytest.fixture
def terminal(
    installed: Path, daemon: DaemonFactory, home: Path, expected: str, tmp_path: Path
) -> Iterator[Terminal]:
    """Open a terminal beside a daemon, in an environment that has the wheel."""
    one = daemon(tmp_path / "map")
    found_by = {"SHMMAP_ENDPOINT": one.endpoint, "SHMMAP_SHM_DIR": one.shm_dir}
    reader = Reader(home, [installed / "bin"], found_by)
    try:
        yield reader.terminal()
    finally:
        reader.leave()


@pytest.mark.parametrize("compiler", ["g++", "clang++"])
def test_one_line_of_a_compiler(terminal: Terminal, installed: Path, expected: str, compiler: str) -> None:
    programs_or_skip(compiler)
    assert terminal.run("shmmap cpp --includes").startswith(f"-I{installed}/")
    terminal.run(COMPILE.replace("g++", compiler, 1))
    assert terminal.run(RUN) == expected


def test_the_line_that_the_command_line_prints(terminal: Terminal, expected: str) -> None:
    programs_or_skip("g++")
    (line,) = (one for one in terminal.run("shmmap cpp").splitlines() if "g++" in one)
    terminal.run(line.replace("PROGRAM.cpp", EXAMPLE.name))
    assert terminal.run(RUN.replace("first_cells", "a.out")) == expected


def test_pkg_config(terminal: Terminal, expected: str) -> None:
    programs_or_skip("g++", "pkg-config")
    for command in PAGE.commands("pkg-config"):
        terminal.run(command)
    assert terminal.run("pkg-config --modversion shmmap") == f"{shmmap.__version__}\n"
    assert terminal.run(RUN) == expected


@pytest.mark.parametrize("compiler", ["g++", "clang++"])
def test_cmake(terminal: Terminal, home: Path, expected: str, compiler: str) -> None:
    """The target brings the standard, too: Clang 14 would take C++14."""
    programs_or_skip(compiler, "cmake")
    terminal.run(f"export CXX={compiler}")
    (home / "CMakeLists.txt").write_text("\n".join(PAGE.blocks["cmake-lists"]), encoding="utf-8")
    for command in PAGE.commands("cmake"):
        terminal.run(command)
    assert terminal.run(f"build/{RUN}") == expected


def test_a_prefix_may_be_moved(terminal: Terminal, home: Path, made: DividedMap, expected: str) -> None:
    """CMake compiles examples; what it installs names no path."""
    programs_or_skip("g++", "cmake", "pkg-config")
    terminal.run(
        f"cmake -S '{CPP}' -B all -DSHMMAP_EXAMPLES=ON && cmake --build all --target first_cells window"
        " && cmake --install all --prefix was"
    )
    assert terminal.run(f"all/{RUN}") == expected
    check_drive(made, terminal.run("all/window"))
    terminal.run("mv was is")
    (home / "CMakeLists.txt").write_text("\n".join(PAGE.blocks["cmake-lists"]), encoding="utf-8")
    terminal.run('cmake -S . -B build -DCMAKE_PREFIX_PATH="$PWD/is" && cmake --build build')
    assert terminal.run(f"build/{RUN}") == expected
    terminal.run(
        "g++ -std=c++17 $(PKG_CONFIG_PATH=is/share/pkgconfig pkg-config --cflags shmmap) first_cells.cpp"
    )
    assert terminal.run(RUN.replace("first_cells", "a.out")) == expected


def check_drive(made: DividedMap, printed: str) -> None:
    """What the example of a window says of the map."""
    *steps, last = printed.splitlines()
    found = [re.fullmatch(r"x ([0-9.]+) m: (\d+) cells new, (\d+) gone", step) for step in steps]
    changes = [(float(one[1]), int(one[2]), int(one[3])) for one in found if one is not None]
    assert len(changes) == len(steps) > 1, printed
    assert changes[0] == (100.0, len(made.in_circle(100, 160, 50)), 0)
    inside = set().union(*(made.in_circle(x, 160, 50) for x in range(100, 221)))
    assert sum(new for _, new, _ in changes) <= len(inside)
    points = [made.points(name) for name in made.in_circle(220, 160, 20)]
    near = sum(
        int(np.sum(np.hypot(p["x"].astype(float) - 220, p["y"].astype(float) - 160) <= 20)) for p in points
    )
    assert last == f"{near} points within 20 m"


def test_the_page_shows_the_window_as_it_is() -> None:
    shown = PAGE.blocks["window"]
    example = (CPP / "examples" / "window.cpp").read_text(encoding="utf-8")
    assert "\n".join(f"    {line}" for line in shown) in example


def test_part_of_a_larger_project(terminal: Terminal, home: Path, expected: str) -> None:
    programs_or_skip("g++", "cmake")
    text = "\n".join(PAGE.blocks["cmake-lists"])
    (home / "CMakeLists.txt").write_text(
        text.replace("find_package(shmmap REQUIRED)", f'add_subdirectory("{CPP}" shmmap)')
    )
    terminal.run("cmake -S . -B build && cmake --build build")
    assert terminal.run(f"build/{RUN}") == expected


def test_colcon(terminal: Terminal, home: Path, expected: str) -> None:
    """Beside the example there is a package that has the header by its `<depend>` alone."""
    programs_or_skip("g++", "cmake", "colcon")
    if not Path("/usr/share/ament_cmake_auto").is_dir():
        pytest.skip("ament_cmake is missing")
    package = CPP / "examples" / "ros_package"
    manifest = (package / "package.xml").read_text(encoding="utf-8")
    by_depend = manifest.replace("first_cells", "by_depend").replace("ament_cmake<", "ament_cmake_auto<", 1)
    lists = (package / "CMakeLists.txt").read_text(encoding="utf-8")
    for name, texts in {"first_cells": (manifest, lists), "by_depend": (by_depend, AUTO)}.items():
        (home / "src" / name).mkdir(parents=True)
        (home / "src" / name / "package.xml").write_text(texts[0], encoding="utf-8")
        (home / "src" / name / "CMakeLists.txt").write_text(texts[1], encoding="utf-8")
    (home / EXAMPLE.name).rename(home / "src" / "first_cells" / EXAMPLE.name)
    terminal.run("export PATH=/usr/bin:/bin")  # colcon and ament are modules of the system's Python
    for command in PAGE.commands("colcon"):
        terminal.run(command.replace("CLONE", str(ROOT)))
    for name in ("first_cells", "by_depend"):
        assert terminal.run(f"install/{name}/lib/{name}/{RUN}") == expected


@pytest.mark.parametrize(
    ("wanted", "found"),
    [
        ("", True),
        (shmmap.__version__, True),
        (f"{shmmap.__version__} EXACT", True),
        (".".join(shmmap.__version__.split(".")[:2]), True),
        ("0.1", False),
        ("99", False),
    ],
)
def test_versions_that_cmake_takes_it_for(tmp_path: Path, wanted: str, *, found: bool) -> None:
    programs_or_skip("cmake")
    (tmp_path / "CMakeLists.txt").write_text(
        "cmake_minimum_required(VERSION 3.16)\nproject(any LANGUAGES NONE)\n"
        f'find_package(shmmap {wanted} REQUIRED PATHS "{CPP}" NO_DEFAULT_PATH)\n'
    )
    done = subprocess.run(["cmake", "-S", tmp_path, "-B", tmp_path / "build"], capture_output=True, text=True)
    assert (done.returncode == 0) == found, done.stderr


def test_every_example_is_known_to_cmake() -> None:
    lists = (CPP / "CMakeLists.txt").read_text(encoding="utf-8")
    programs = {path.stem for path in (CPP / "examples").glob("*.cpp")}
    assert programs | {"ros_package"} == {path.stem for path in (CPP / "examples").iterdir()}
    for name in programs:
        assert f"  example({name}" in lists
