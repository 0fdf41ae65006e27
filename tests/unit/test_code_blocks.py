# SPDX-License-Identifier: Apache-2.0
"""Every block of code on a page is run, or it says here why it cannot be.

A block of code is one with a language.  It has a name, in a comment before it, by which a test finds it.
"""

from __future__ import annotations

import ast

import pytest

from tests.support.daemon_process import ROOT
from tests.support.pages import all_pages, read_page

CI = ".ci/run"
FIRST_STEPS = "tests/process/slow/test_first_steps.py"
PAGES = "tests/process/test_pages.py"
BOOTED = "tests/systemd/test_booted_pages.py"
ROS = "tests/process/slow/test_ros_pages.py"
INSTALLS = "tests/process/slow/test_installs.py"

RUN = {  # what runs the blocks of a page, by their names
    ".github/CONTRIBUTING.md": {CI: "set-up"},
    ".github/site/START.md": {PAGES: "picture serve look window"},
    "README.md": {
        FIRST_STEPS: "clone demo",
        CI: "tests",
        PAGES: "server points cpp cpp-run",
        ROS: "ros",
    },
    "clients/IN_YOUR_PROGRAM.md": {
        "tests/process/test_in_your_program.py": "cells numpy window matplotlib open3d tables numba ray dask"
        " torch_loader many_processes asyncio_follow"
    },
    "clients/README.md": {
        FIRST_STEPS: "first-scan-map first-scan",
        PAGES: "ndt pose-init compare elevation elevation-whole",
        "tests/process/slow/test_bags.py": "bags",
        "tests/process/slow/test_ndt_devices.py": "device",
        "tests/process/slow/test_ndt_ros_topic.py": "topic",
        "tests/process/slow/test_rolling_map.py": "live rolling rolling-config",
    },
    "clients/cpp/AUTOWARE.md": {
        "tests/cpp/test_autoware_page.py": "serve venv launch-component launch-core member update patch"
        " options proposal proposal-ndt proposal-update ndt-leaves pcl-cloud",
    },
    "clients/cpp/README.md": {
        "tests/cpp/test_shipping.py": "gcc pkg-config cmake-lists cmake colcon window",
        "tests/unit/cli/test_cpp.py": "first-cells",
    },
    "clients/ros/README.md": {"tests/cpp/test_autoware_page.py": "component"},
    "clients/shmmap_clients/ros_bridge/ROS_BRIDGE.md": {
        PAGES: "install",
        "tests/process/slow/test_ros_bridge.py": "bridge",
    },
    "clients/shmmap_clients/ros_node/ROS_NODE.md": {ROS: "install node message"},
    "shmmap/CONTAINERS.md": {"tests/process/slow/test_container_files.py": "image host tmpfs"},
    "shmmap/INSTALL.md": {
        PAGES: "everything",
        FIRST_STEPS: "slim",
        CI: "client-only",
        "tests/unit/cli/test_completion.py": "completion",
        INSTALLS: "versions",
    },
    "shmmap/chunks/CHUNKS.md": {"tests/unit/live_worker/disk/test_map_database.py": "tables"},
    "shmmap/client/MULTIPROCESSING.md": {
        "tests/process/slow/test_pickled_cells.py": "pool ask together keep"
    },
    "shmmap/client/live/LIVE_MAPS.md": {PAGES: "serve settings map read"},
    "shmmap/daemon/MEMORY.md": {PAGES: "look", BOOTED: "larger huge"},
    "shmmap/dividing/OWN_CLOUD.md": {
        PAGES: "install",
        FIRST_STEPS: "serve query view",
        "tests/process/test_view_browser.py": "browser",
    },
    "shmmap/layers/LAYERS.md": {PAGES: "layers entry-point program"},
    "shmmap/origin/AUTOWARE_MAP.md": {FIRST_STEPS: "serve query python"},
    "shmmap/publishing/GATEWAY.md": {BOOTED: "start", "tests/process/slow/test_gateway.py": "serve"},
    "shmmap/publishing/PUBLISHING.md": {
        PAGES: "install credentials publish directory fetch install-sign sign rotate versions"
    },
    "shmmap/publishing/SERVING_FROM_A_BUCKET.md": {
        PAGES: "install credentials serve ask settings down trust health status doctor log"
    },
    "shmmap/publishing/SLICES.md": {PAGES: "install credentials by-hand parallel slurm dask"},
    "systemd/README.md": {
        FIRST_STEPS: "environment image",
        BOOTED: "service bucket user run prepare huge-pages upgrade",
        INSTALLS: "image-program",
    },
    "tests/benchmarks/BENCHMARKS.md": {
        PAGES: "install",
        "tests/process/slow/test_benchmarks.py": "one data",
    },
}

NOT_RUN = {  # blocks that nothing runs, and why
    (".github/CONTRIBUTING.md", "check"): "they are the tests and checks themselves, which `.ci/run` runs",
    ("clients/ros/README.md", "colcon"): "rclcpp is in no package index; where ROS 2 is sourced,"
    " `slow/test_ros_package.py` builds both packages, and runs the node",
}

LINES_NOT_RUN = {  # how lines begin that are left out of blocks, and why
    ("clients/IN_YOUR_PROGRAM.md", "open3d"): ("o3d.visualization.draw_geometries", "needs a display"),
    ("clients/README.md", "device"): ("sudo apt-get", "changes the machine: `.ci/run` installs it"),
    ("shmmap/CONTAINERS.md", "image"): (
        "MAPS=/srv/maps/town docker compose",
        "needs a container runtime: what that does with the files is done with namespaces",
    ),
    ("systemd/README.md", "user"): ("loginctl enable-linger", "needs a real login"),
    ("systemd/README.md", "upgrade"): (
        "sudo /opt/shmmap/bin/pip",
        "a booted machine has no network: pip installs a wheel of another version",
    ),
}


def words_of(path: str) -> set[str]:
    """Return the words of all texts of a module."""
    tree = ast.parse((ROOT / path).read_text(encoding="utf-8"))
    texts = (node.value for node in ast.walk(tree) if isinstance(node, ast.Constant))
    return {word for text in texts if isinstance(text, str) for word in (text, *text.split())}


@pytest.mark.parametrize("name", all_pages())
def test_every_block_is_run_or_says_why_not(name: str) -> None:
    page = read_page(name)
    run = [block for blocks in RUN.get(name, {}).values() for block in blocks.split()]
    left = [block for page_name, block in NOT_RUN if page_name == name]
    assert sorted(page.blocks) == sorted([*run, *left])
    assert page.fences == len(page.blocks), "a block has no name"


@pytest.mark.parametrize("name", RUN)
def test_what_runs_them_names_them(name: str) -> None:
    for path, blocks in RUN[name].items():
        if path == CI:
            assert name in (ROOT / CI).read_text(encoding="utf-8")
        else:
            assert {name, *blocks.split()} <= words_of(path), path


def test_lines_that_are_left_out_are_there() -> None:
    for (name, block), (begins, _) in LINES_NOT_RUN.items():
        assert [line for line in read_page(name).commands(block) if line.startswith(begins)], name
