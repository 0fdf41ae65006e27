# SPDX-License-Identifier: Apache-2.0
"""AUTOWARE.md is true: its commands and examples run, and its lines for Autoware's sources compile there.

Where they belong is written out here as far as they need it: classes of Autoware's names, with their members.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import shmmap
from tests.cpp.conftest import DaemonFactory
from tests.support.autoware_node import TYPES, compiled_with
from tests.support.cpp_client import FLAGS
from tests.support.daemon_process import ROOT
from tests.support.divided_map import DividedMap
from tests.support.pages import Reader, read_page
from tests.support.skips import programs_or_skip

PAGE = read_page("clients/cpp/AUTOWARE.md")

_NODE = """
{include}
#include <cstdio>
#include "autoware_messages.hpp"
#define RCLCPP_WARN(logger, ...) std::printf(__VA_ARGS__), (void)(logger)

namespace rclcpp {{
bool ok() {{ return true; }}
}}

struct MapUpdateModule {{
  using GetDifferentialPointCloudMap = plain::Service;
  using PcdLoaderFunction = std::function<std::shared_ptr<GetDifferentialPointCloudMap::Response>(
    const std::shared_ptr<GetDifferentialPointCloudMap::Request> &)>;
  explicit MapUpdateModule(PcdLoaderFunction) {{}}
}};

struct Node {{
  static int get_logger() {{ return 0; }}
  void start()
  {{
    map_update_module_ = std::make_unique<MapUpdateModule>(
{argument}
  }}
  void start_with_options()
  {{
{options}
    map_update_module_ = std::make_unique<MapUpdateModule>(loader);
  }}
  std::unique_ptr<MapUpdateModule> map_update_module_;
}};
"""

_GRID = """
#include <shmmap/autoware.hpp>
#include "autoware_messages.hpp"

struct Leaf {{
  struct Matrix {{
    double values[9] = {{}};
    double & operator()(int row, int column) {{ return values[3 * row + column]; }}
  }};
  int nr_points_ = 0;
  std::array<double, 3> mean_{{}};
  std::vector<float> centroid_;
  Matrix icov_;
}};

struct MultiVoxelGridCovariance {{
  using GridNodeType = std::vector<Leaf>;
  using GridNodePtr = std::shared_ptr<GridNodeType>;
{grid}
  std::map<std::string, int> sid_to_iid_;
  std::vector<GridNodePtr> grid_list_;
}};

template <typename TargetGrid>
struct MultiGridNormalDistributionsTransform {{
{ndt}
  void removeTarget(const std::string &) {{}}
  void createVoxelKdtree() {{}}
  TargetGrid target_cells_;
}};

struct MapUpdateModule {{
  bool update_ndt(MultiGridNormalDistributionsTransform<MultiVoxelGridCovariance> & ndt)
  {{
    auto request = std::make_shared<plain::Request>();
{update}
    return true;
  }}
  shmmap::NdtLeaves<Leaf> leaves_{{2.0}};
}};

int main()
{{
  MultiGridNormalDistributionsTransform<MultiVoxelGridCovariance> ndt;
  return MapUpdateModule().update_ndt(ndt) ? 0 : 1;
}}
"""


def block(name: str) -> str:
    """Return a block of the page."""
    return "\n".join(PAGE.blocks[name])


def check(source: str, folder: Path) -> None:
    """Have the compiler look at a source, with every warning an error."""
    programs_or_skip("g++")
    path = folder / "source.cpp"
    path.write_text(source)
    support = ROOT / "tests" / "support"
    options = ["-std=c++17", "-fsyntax-only", *FLAGS, f"-I{support}"]
    subprocess.run(["g++", *options, str(path)], check=True)


def test_every_block_is_tested() -> None:
    assert set(PAGE.blocks) == {
        "serve",
        "patch",
        "options",
        "proposal",
        "proposal-ndt",
        "proposal-update",
        "ndt-leaves",
        "pcl-cloud",
    }
    assert len(re.findall(r"^```\w+$", PAGE.text, re.MULTILINE)) == len(PAGE.blocks)


def test_the_lines_for_the_node_compile(tmp_path: Path) -> None:
    include, _, argument = PAGE.blocks["patch"]
    check(_NODE.format(include=include, argument=argument, options=block("options")), tmp_path)


def test_the_proposed_lines_compile(tmp_path: Path) -> None:
    parts = {"grid": "proposal", "ndt": "proposal-ndt", "update": "proposal-update"}
    check(_GRID.format(**{part: block(name) for part, name in parts.items()}), tmp_path)


def test_the_examples_run_beside_a_daemon(divided_map: DividedMap, tmp_path: Path) -> None:
    programs_or_skip("g++", "pkg-config")
    programs = tmp_path / "bin"
    programs.mkdir()
    script = programs / "shmmap"
    script.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m shmmap.cli "$@"\n')
    script.chmod(0o755)
    reader = Reader(tmp_path, [programs], {"PYTHONPATH": str(ROOT)})
    shutil.copytree(ROOT / "clients" / "cpp", tmp_path / "clients" / "cpp")
    try:
        (serve,) = PAGE.commands("serve")
        with reader.terminal().serving(serve.replace("MAP", str(divided_map.root))):
            user = reader.terminal()
            printed = {}
            for name, library in (("ndt-leaves", "eigen3"), ("pcl-cloud", "pcl_common")):
                if subprocess.run(["pkg-config", "--exists", library], check=False).returncode:
                    pytest.skip(f"{library} is missing (libeigen3-dev, libpcl-dev)")
                for command in PAGE.commands(name):
                    printed[name] = user.run(command)
    finally:
        reader.leave()
    assert printed["ndt-leaves"].count("cells") == 8
    assert "0 cells, 0 points" in printed["pcl-cloud"]  # it was asked for a place of the demonstration's town


# --- the examples that need PCL, Eigen or ROS, as far as these are there ----------------------------------


CPP = ROOT / "clients" / "cpp"
EXAMPLES = CPP / "examples"


def built_as_it_says(name: str, folder: Path) -> Path:
    """Compile an example by the line in its head."""
    programs_or_skip("g++", "pkg-config")
    (command,) = re.findall(r"^//   (g\+\+ .*)$", (EXAMPLES / f"{name}.cpp").read_text(), re.MULTILINE)
    library = re.findall(r"--cflags (\w+)", command)[0]
    if subprocess.run(["pkg-config", "--exists", library], check=False).returncode:
        pytest.skip(f"{library} is missing (libpcl-dev, libeigen3-dev)")
    command = command.replace(f"-o {name}", f"-o {folder / name} -O0 -Werror -Wall -Wextra -Wshadow")
    subprocess.run(["sh", "-euc", command], check=True, cwd=CPP)
    return folder / name


def run(program: Path, endpoint: str, *words: object) -> list[str]:
    """What an example prints."""
    done = subprocess.run(
        [program, *map(str, words)],
        env={**os.environ, "SHMMAP_ENDPOINT": endpoint},
        check=True,
        capture_output=True,
        text=True,
    )
    assert done.stderr == ""
    return done.stdout.splitlines()


def test_a_cloud_of_pcl_s(daemon: DaemonFactory, divided_map: DividedMap, tmp_path: Path) -> None:
    program = built_as_it_says("pcl_cloud", tmp_path)
    one = daemon(divided_map.root)
    with shmmap.connect(one.endpoint) as client:
        cells = client.around(5, 5, radius=20).raise_for_failures()
        xyz = np.concatenate([cell.xyz for cell in cells])
    first, second = run(program, one.endpoint, 5, 5, 20)
    assert first == f"{len(cells)} cells, {len(xyz)} points in frame map"
    bounds = [np.float32(word) for word in re.findall(r"-?[0-9][0-9.e+-]*", second)]
    assert bounds == [*xyz.min(axis=0), *xyz.max(axis=0)]


def test_leaves_along_a_drive(daemon: DaemonFactory, divided_map: DividedMap, tmp_path: Path) -> None:
    program = built_as_it_says("ndt_leaves", tmp_path)
    one = daemon(divided_map.root)
    lines = run(program, one.endpoint, -30, 30, 5, 15)
    held: set[str] = set()
    expected = []
    with shmmap.connect(one.endpoint) as client:
        for x in (-30, -10, 10, 30):
            wanted = set(divided_map.in_square(x, 5, 15))
            ids = sorted(map(divided_map.id, wanted))
            cells = client.selected(ids, layers=["ndt(leaf=2.0)"], wait=60).raise_for_failures()
            voxels, points = (
                sum(len(cell["count"]) for cell in cells),
                sum(cell["count"].sum() for cell in cells),
            )
            expected.append(
                f"x {x}: {len(wanted - held)} added, {len(held - wanted)} removed;"
                f" {len(wanted)} cells, {voxels} voxels of {points} points"
            )
            held = wanted
    assert lines == expected


@pytest.mark.parametrize("types", TYPES)
def test_requesters_of_the_service(
    daemon: DaemonFactory, divided_map: DividedMap, tmp_path: Path, types: str
) -> None:
    """Each gets everything once, also of requests at the same time; two of one name share what they hold."""
    programs_or_skip("g++")
    program = compiled_with(types, ROOT / "tests" / "support" / "requesters.cpp", tmp_path)
    if program is None:
        pytest.skip("ROS 2's generator of messages is missing (rosidl-generator-c-cpp, python3-rosidl)")
    one = daemon(divided_map.root)
    lines = run(program, one.endpoint, 0, 0, 100, 6)
    assert lines == ["36 map 0 map "] * 6 + ["3"]
    assert run(program, one.endpoint, 0, 0, -1, 1) == ["0 map 0 map ", "1"], "no area, nothing in it"
    one.stop()
    environment = {**os.environ, "SHMMAP_ENDPOINT": one.endpoint}
    ended = subprocess.run(
        [program, "0", "0", "100", "2", "6"], env=environment, check=True, capture_output=True, text=True
    )
    assert ended.stdout.splitlines() == ["none none "] * 2 + ["1"], "no daemon, no answer: never an empty one"
    with subprocess.Popen(
        [program, "0", "0", "100", "2"], env=environment, stdout=subprocess.PIPE, text=True
    ) as waiting:
        one.start()
        assert waiting.communicate()[0].splitlines() == ["36 map 0 map "] * 2 + ["1"]
        assert waiting.returncode == 0
