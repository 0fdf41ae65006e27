# SPDX-License-Identifier: Apache-2.0
"""Errors where ROS 2 is missing or does not start; ROS itself is not imported here."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

from shmmap.errors import BadRequest, CannotStart, PackageMissing, ShmmapError

_NOT_OF_ROS = frozenset({"numpy", "numba", "zmq", "posix_ipc", "msgspec"})


@contextmanager
def needs_ros(what: str, workspace: str = "") -> Iterator[None]:
    """Raise `PackageMissing` for an import that only a machine with ROS 2 has.

    Parameters
    ----------
    what
        What needs it.
    workspace
        The package of messages that comes from a workspace, if any.
    """
    try:
        yield
    except ImportError as error:
        missing = (error.name or "").partition(".")[0] or "ROS 2"
        if missing.startswith("shmmap") or missing in _NOT_OF_ROS:
            raise
        also = f", then the workspace that has {workspace} (source install/setup.bash)" if workspace else ""
        raise PackageMissing(
            f"{what} needs {missing}, which this Python does not find: {error}",
            hint=f"source ROS 2 first (source /opt/ros/DISTRO/setup.bash){also}; shmmap has to be installed"
            f" for the Python of that ROS, and {sys.executable} is running",
        ) from error


def start_error(error: Exception, help_of: str) -> ShmmapError:
    """Return the error that replaces one of rclpy at the start; the help of ``help_of`` is its remedy."""
    refused = "ROSArgs" in type(error).__name__ or "parse" in str(error)
    kind = BadRequest if refused else CannotStart
    return kind(f"ROS 2 does not start with these arguments: {error}", hint=f"{help_of} --help")
