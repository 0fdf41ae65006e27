# SPDX-License-Identifier: Apache-2.0
"""``python -m tests.support.ros``: make the environment with ROS 2, or say why it cannot be had."""

from __future__ import annotations

from tests.support.ros.environment import OutOfReach, make_environment


def main() -> None:
    """Make it and print where it is."""
    try:
        print(f"ROS 2 for the tests is in {make_environment()}")
    except OutOfReach as reason:
        print(f"tests with ROS 2 will be skipped: {reason}")


if __name__ == "__main__":
    main()
