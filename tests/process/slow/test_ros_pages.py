# SPDX-License-Identifier: Apache-2.0
"""Lines of the pages for a machine with ROS 2, as they stand; ROS is that of the tests, of wheels."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from shmmap.testing.daemon_process import without_settings
from tests.process.distributions import tree
from tests.support.daemon_process import ROOT, DaemonProcess
from tests.support.divided_map import DividedMap
from tests.support.pages import Reader, Terminal, read_page, write_program
from tests.support.ros.processes import RosDomain
from tests.support.skips import index_or_skip

README = read_page("README.md")
NODE = read_page("clients/shmmap_clients/ros_node/ROS_NODE.md")
BLOCKS = {
    "README.md": README.commands("ros"),
    "ROS_NODE.md": NODE.commands("install") + NODE.commands("node"),
}
AROUND = """
import rclpy
from sensor_msgs.msg import PointCloud2

rclpy.init()
node = rclpy.create_node("mine")
came = []
node.create_subscription(PointCloud2, "cells", came.append, 100)
publisher = node.create_publisher(PointCloud2, "cells", 100)
while publisher.get_subscription_count() == 0:
    rclpy.spin_once(node, timeout_sec=1.0)
x, y = 3.0, -4.0
"""
THEN = """
with shmmap.connect() as client:
    expected = sorted(len(cell) for cell in client.around(x, y, radius=50))
while len(came) < len(expected):
    rclpy.spin_once(node, timeout_sec=1.0)
print(sorted(one.width * one.height for one in came) == expected, {one.header.frame_id for one in came})
"""


def setup_of(python: Path) -> str:
    """Return what `setup.bash` of a ROS 2 sets that lies where this interpreter does."""
    program = "import os, site; print(site.getsitepackages()[0], os.environ['LD_LIBRARY_PATH'])"
    environment = without_settings()
    environment.pop("PYTHONPATH", None)
    packages, libraries = subprocess.check_output([python, "-c", program], text=True, env=environment).split()
    return f"export PYTHONPATH='{packages}' LD_LIBRARY_PATH='{libraries}'\n"


@pytest.fixture
def user(domain: RosDomain, served: DaemonProcess, tmp_path: Path) -> Iterator[Terminal]:
    """A terminal in a clone, on a machine with ROS 2 and Autoware's messages, beside a daemon."""
    for place in ("ros/setup.bash", "autoware/install/setup.bash"):
        (tmp_path / place).parent.mkdir(parents=True)
        (tmp_path / place).write_text(setup_of(domain.python))
    for name in tree():
        (tmp_path / "shmmap" / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / "shmmap" / name)
    mine = {name: text for name, text in domain.environment.items() if name.startswith(("ROS_", "RMW_"))}
    (tmp_path / "bin").mkdir()
    write_program(tmp_path / "bin" / "python3", f'exec "{sys.executable}" "$@"')  # as ROS's
    reader = Reader(
        tmp_path,
        [tmp_path / "bin"],
        {**mine, "SHMMAP_ENDPOINT": served.endpoint, "SHMMAP_SHM_DIR": served.shm_dir},
    )
    yield reader.terminal(tmp_path / "shmmap")
    reader.leave()


@pytest.mark.parametrize("page", BLOCKS)
def test_the_node_from_a_clone(
    user: Terminal, domain: RosDomain, divided_map: DividedMap, tmp_path: Path, page: str
) -> None:
    *commands, node = BLOCKS[page]
    with index_or_skip():
        for command in commands:
            user.run(command.replace("/opt/ros/jazzy", str(tmp_path / "ros")))
    near = 3.0, -4.0, 15.0
    with user.running(node):
        cells = domain.peer().asked("partial", area=near).cells
        assert len(cells) == len(divided_map.in_square(*near))
    if page == "ROS_NODE.md":
        program = [AROUND, *NODE.blocks["message"], THEN]
        assert user.python(program) == "True {'map'}\n"
