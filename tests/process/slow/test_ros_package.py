# SPDX-License-Identifier: Apache-2.0
"""The node of ``clients/ros``, in C++: it does all that the tests of the node in Python ask of it.

It is built where CMake finds rclcpp, as with a sourced ROS.  ``SHMMAP_TEST_RMW`` names an RMW in place of
rmw_fastrtps_cpp.
"""

from __future__ import annotations

import os
import signal
import subprocess
from pathlib import Path

import pytest

from tests.process.slow.test_ros_node import (  # noqa: F401
    node,
    peer,
    test_a_changed_cell_comes_once_to_each_requester_over_restarts_of_node_and_daemon,
    test_a_path_may_hold_the_sign_before_versions,
    test_a_request_for_what_is_in_memory_waits_for_no_other,
    test_all_clients_of_a_process_that_ask_at_once_are_answered,
    test_an_id_without_a_version_is_outdated,
    test_clients_are_answered_by_the_next_node,
    test_clients_that_ask_while_there_is_no_daemon_are_answered_when_it_is_back,
    test_clients_that_come_and_go_leave_nothing,
    test_it_ends_while_requests_wait,
    test_it_is_a_node_with_types_that_ros_knows,
    test_it_is_started_as_autowares_launch_file_starts_the_loader,
    test_parameters_are_there_and_cannot_be_set,
    test_the_list_of_cells_is_latched_and_follows_the_map_whatever_else_is_off,
    test_the_whole_map_and_a_coarser_one,
    test_three_services_to_the_byte,
)
from tests.support.compiled_programs import built_once
from tests.support.daemon_process import ROOT, DaemonProcess
from tests.support.ros.processes import RosDomain
from tests.support.skips import programs_or_skip

_NEEDS = ("ament_cmake", "rclcpp", "rclcpp_components", "autoware_map_msgs", "diagnostic_msgs")


def _built(folder: Path) -> Path | None:
    """Install both packages below a directory, as colcon does; None where a package of ROS is missing."""
    probe, prefix = folder / "probe", folder / "install"
    probe.mkdir()
    lines = ["cmake_minimum_required(VERSION 3.16)", "project(probe)"]
    lines += [f"find_package({name} REQUIRED)" for name in _NEEDS]
    (probe / "CMakeLists.txt").write_text("\n".join(lines))
    quiet = {"capture_output": True, "text": True}
    if subprocess.run(["cmake", "-S", probe, "-B", folder / "asked"], check=False, **quiet).returncode:  # type: ignore[call-overload]
        return None
    given = os.environ.get("CMAKE_PREFIX_PATH", "")
    environment = {**os.environ, "CMAKE_PREFIX_PATH": f"{prefix}{os.pathsep}{given}"}
    for name in ("cpp", "ros"):
        build = folder / name
        for command in (
            ["cmake", "-S", ROOT / "clients" / name, "-B", build, f"-DCMAKE_INSTALL_PREFIX={prefix}"],
            ["cmake", "--build", build],
            ["cmake", "--install", build],
        ):
            done = subprocess.run(command, check=False, env=environment, **quiet)  # type: ignore[call-overload]
            assert done.returncode == 0, done.stdout + done.stderr
    return prefix / "lib" / "shmmap_ros" / "pointcloud_map_loader"


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the node."""
    programs_or_skip("g++", "cmake")
    found = built_once(tmp_path_factory, "shmmap_ros", _built)
    if found is None:
        pytest.skip(f"CMake does not find all of {', '.join(_NEEDS)}: no ROS 2 with rclcpp is sourced")
    return found


@pytest.fixture
def domain(domain: RosDomain, program: Path) -> RosDomain:
    """A domain whose nodes are this program."""
    domain.program = program
    return domain


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_it_ends_while_there_is_no_daemon(
    domain: RosDomain, served: DaemonProcess, number: signal.Signals
) -> None:
    served.kill()
    one = domain.node(served)
    one.wait_said("requests wait until the daemon answers")
    assert one.end(number) == 0, one.log


def test_a_parameter_that_is_wrong_is_refused(domain: RosDomain, served: DaemonProcess) -> None:
    one = domain.node(served, "-p", "wait:=-1")
    assert one.process.wait(60) == 78
    one.wait_said("parameter wait: expected a number, 0 or more, not -1")
