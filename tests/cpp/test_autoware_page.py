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
from xml.etree import ElementTree

import numpy as np
import pytest

import shmmap
from tests.cpp.conftest import DaemonFactory
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
#define RCLCPP_ERROR(logger, ...) std::printf(__VA_ARGS__), (void)(logger)

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

_RELEASED = """
{include}
#include <cstdio>
#include "autoware_messages.hpp"

namespace autoware_map_msgs::srv {{
using GetDifferentialPointCloudMap = plain::Service;
}}
namespace diagnostic_msgs::msg {{
struct DiagnosticStatus {{
  static constexpr unsigned char WARN = 1;
}};
}}
struct DiagnosticsInterface {{
  void add_key_value(const std::string &, bool) {{}}
  void update_level_and_message(const std::int8_t level, const std::string & message)
  {{
    std::printf("%d %s\\n", level, message.c_str());
  }}
}};

struct MapUpdateModule {{
  bool update_ndt(
    const plain::Request & wanted, std::set<std::string> & ids,
    std::unique_ptr<DiagnosticsInterface> & diagnostics_ptr)
  {{
    auto request = std::make_shared<autoware_map_msgs::srv::GetDifferentialPointCloudMap::Request>(wanted);
    request->cached_ids = {{ids.begin(), ids.end()}};
{update}
    std::printf("%zu %zu\\n", maps_to_add.size(), map_ids_to_remove.size());
    for (auto & map : maps_to_add) ids.insert(map.cell_id);
    for (const std::string & map_id_to_remove : map_ids_to_remove) ids.erase(map_id_to_remove);
    return true;
  }}
{member}
}};

int main()
{{
  MapUpdateModule module;
  std::set<std::string> ids;
  auto diagnostics_ptr = std::make_unique<DiagnosticsInterface>();
  plain::Request request;
  for (const float radius : {{500.0F, 0.0F, -1.0F}}) {{
    request.area.radius = radius;
    std::printf("%d\\n", module.update_ndt(request, ids, diagnostics_ptr));
  }}
}}
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


def test_the_launch_files_name_the_node() -> None:
    """autoware_core's line loses its package; universe's component becomes ours, or a node as core's."""
    environment = PAGE.commands("venv")[0].split()[-1]
    was, now = (ElementTree.fromstring(f"{line[1:]}</node>").attrib for line in PAGE.blocks["launch-core"])
    assert [line[:5] for line in PAGE.blocks["launch-core"]] == ["-    ", "+    "]
    script = f"{environment}/bin/shmmap-ros-node"
    assert {**was, "exec": script} == {**now, "pkg": "autoware_map_loader"}
    was, here = (
        ElementTree.fromstring(f"{line[1:]}</composable_node>").attrib
        for line in PAGE.blocks["launch-component"]
    )
    ours = {"pkg": "shmmap_ros", "plugin": "shmmap_ros::MapLoader"}
    assert here == {**was, **ours} == {**ours, "name": "pointcloud_map_loader"}
    (shown,) = read_page("clients/ros/README.md").blocks["component"]
    assert here == ElementTree.fromstring(f"{shown}</composable_node>").attrib
    source = (ROOT / "clients" / "ros" / "src" / "map_loader.cpp").read_text()
    assert f"RCLCPP_COMPONENTS_REGISTER_NODE({here['plugin']})" in source


def test_the_environment_of_the_node(tmp_path: Path) -> None:
    """With the older numpy the client imports; ROS itself is not here."""
    environment = PAGE.commands("venv")[0].split()[-1]
    made = tmp_path / "environment"
    reader = Reader(tmp_path, [Path(sys.executable).parent])
    try:
        user = reader.terminal(ROOT)
        try:
            for command in PAGE.commands("venv"):
                user.run(command.replace(environment, str(made)).replace("install", "install -q"))
        except AssertionError as error:
            if re.search("No matching distribution|Could not find a version", str(error)):
                pytest.skip("pip reaches no packages")
            raise
        user = reader.terminal()
        printed = user.run(
            f"{made}/bin/python -c 'import numpy, shmmap; print(numpy.__version__, shmmap.__file__)'"
        )
        version, file = printed.split()
        assert version.startswith("1.")
        assert file.startswith(str(made))
        assert user.run(f"{made}/bin/shmmap version")
    finally:
        reader.leave()


def test_the_lines_for_releases_run(daemon: DaemonFactory, divided_map: DividedMap, tmp_path: Path) -> None:
    programs_or_skip("g++")
    include, _, member = PAGE.blocks["member"]
    source = tmp_path / "released.cpp"
    source.write_text(_RELEASED.format(include=include, member=member, update=block("update")))
    program = tmp_path / "released"
    options = ["-std=c++17", "-O0", *FLAGS, f"-I{ROOT / 'tests' / 'support'}"]
    subprocess.run(["g++", *options, str(source), "-o", str(program)], check=True)
    one = daemon(divided_map.root)
    assert run(program, one.endpoint) == ["36 0", "1", "0 32", "1", "1 shmmap has not got the map.", "0"]


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
