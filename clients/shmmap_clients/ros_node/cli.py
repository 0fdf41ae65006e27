# SPDX-License-Identifier: Apache-2.0
"""The program ``shmmap-ros-node``."""

from __future__ import annotations

import _signal  # type: ignore[import-not-found]  # `signal` and `typing` take milliseconds to import
import os
import sys

_ENDS = (_signal.SIGINT, _signal.SIGTERM)
_EPILOG = """\
Parameters are given as to any node, --ros-args -p NAME:=VALUE or --params-file FILE:
{parameters}
Without remaps (-r OLD:=NEW) the names are, in the namespace /map:
{names}
The topic /diagnostics has the node's state.  Without a daemon, requests wait until it is there.
Ends with SIGTERM or Ctrl-C; a second one ends it at once.
Exit code: 0; 2 wrong usage, or ROS refuses its arguments; 69 ROS 2 or a package is missing; 71 ROS does not
start; 78 a parameter is wrong."""


def main(argv: list[str] | None = None) -> int:
    """Serve the map until a signal arrives, and return the exit code; in a process of its own."""
    for number in _ENDS:  # until ROS starts there is nothing to clean up
        _signal.signal(number, lambda *_: os._exit(0))
    from shmmap_clients.command_line import run_command
    from shmmap_clients.ros_node.settings import NAME, PARAMETERS, REMAPS

    words = list(sys.argv[1:] if argv is None else argv)
    ros_at = words.index("--ros-args") if "--ros-args" in words else len(words)
    return run_command(
        NAME,
        "Serve the daemon's map as a node of ROS 2, over any RMW, in place of Autoware's map loader.",
        lambda _: None,
        lambda _: _run(words[ros_at:]),
        words[:ros_at],
        epilog=_EPILOG.format(
            parameters="\n".join(f"  {name:<30} {text}" for name, (_, text) in PARAMETERS.items()),
            names="\n".join(f"  {old:<40} {new}" for old, new in REMAPS.items()),
        ),
    )


def _run(words: list[str]) -> int:
    from shmmap_clients.ros_node.needs import needs_ros

    with needs_ros("the node", "autoware_map_msgs"):
        from shmmap_clients.ros_node.node import serve
    _signal.pthread_sigmask(_signal.SIG_BLOCK, _ENDS)  # from here on `serve` waits for them
    serve(words, _ENDS)
    return 0
