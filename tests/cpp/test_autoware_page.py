# SPDX-License-Identifier: Apache-2.0
"""AUTOWARE.md is true: its commands run, and its lines for Autoware's sources compile where they belong.

Where they belong is written out here as far as they need it: classes of Autoware's names, with their members.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.cpp_client import FLAGS
from tests.support.daemon_process import ROOT
from tests.support.divided_map import DividedMap
from tests.support.pages import Reader, read_page

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
    if shutil.which("g++") is None:
        pytest.skip("g++ is missing")
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
    for tool in ("g++", "pkg-config"):
        if shutil.which(tool) is None:
            pytest.skip(f"{tool} is missing")
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
