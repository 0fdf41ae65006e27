# SPDX-License-Identifier: Apache-2.0
"""What ``shmmap-ros-node`` takes and refuses without ROS; with it: ``tests/process/slow``."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence

import pytest
from shmmap_clients.ros_node.settings import PARAMETERS, REMAPS, checked

from shmmap.errors import ConfigError
from tests.support.daemon_process import ROOT
from tests.support.pages import read_page


def run_without(module: str, words: Sequence[str]) -> subprocess.CompletedProcess[str]:
    """Run the program where a module is missing, and others of ROS are empty."""
    code = (
        "import sys, types\n"
        "for name in ('rclpy', 'autoware_map_msgs', 'autoware_map_msgs.msg'):\n"
        "    sys.modules[name] = types.ModuleType(name)\n"
        f"sys.modules[{module!r}] = None\n"
        f"from shmmap_clients.ros_node.cli import main\nsys.exit(main({list(words)!r}))"
    )
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)


def test_help_needs_no_ros() -> None:
    done = run_without("rclpy", ["--help"])
    assert done.returncode == 0, done.stderr
    for name in (*PARAMETERS, *REMAPS, *REMAPS.values(), "/diagnostics"):
        assert name in done.stdout


@pytest.mark.parametrize("module", ["rclpy", "autoware_map_msgs"])
def test_without_ros_it_says_what_to_source(module: str) -> None:
    done = run_without(module, ["--ros-args", "-p", "wait:=3.0"])
    assert done.returncode == 69
    assert f"needs {module}" in done.stderr
    assert "setup.bash" in done.stderr
    assert sys.executable in done.stderr
    assert "Traceback" not in done.stderr


def test_words_outside_of_those_for_ros_are_refused() -> None:
    done = run_without("rclpy", ["--domain", "3", "--ros-args", "-r", "a:=b"])
    assert done.returncode == 2
    assert "unknown option --domain" in done.stderr


def test_numbers_may_be_whole() -> None:
    assert checked("wait", 3) == 3.0
    assert checked("wait", 0.0) == 0.0
    assert checked("leaf_size", 0.5) == 0.5
    assert checked("pcd_paths_or_directory", []) == []


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *[("wait", value) for value in (-1.0, float("nan"), float("inf"), "3", True, None)],
        *[("leaf_size", value) for value in (0.0, -3.0, "3")],
    ],
)
def test_impossible_numbers_are_refused(name: str, value: object) -> None:
    with pytest.raises(ConfigError, match=f"parameter {name}: expected a number"):
        checked(name, value)


def test_names_are_those_that_autoware_uses() -> None:
    page = read_page("clients/shmmap_clients/ros_node/ROS_NODE.md").text
    for name in PARAMETERS:
        assert f"`{name}`" in page
    for old, new in REMAPS.items():
        assert f"| `{old}` | `/map/{new}` |" in page


def test_what_it_loads_of_a_client_only_install() -> None:
    code = (
        "import sys\nimport shmmap\nimport shmmap_clients.ros_node\n"
        "from shmmap_clients.ros_node import cli, point_cloud2, requests, settings, to_point_cloud2\n"
        "import shmmap_clients.command_line\nshmmap.connect\n"
        "more = {'open3d', 'numba', 'scipy', 'xxhash', 'yaml', 'lzf', 'sensor_msgs'}\n"
        "print(*more & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, timeout=60)
    assert (done.returncode, done.stdout) == (0, "\n"), done.stderr
