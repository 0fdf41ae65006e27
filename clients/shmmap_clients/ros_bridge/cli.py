# SPDX-License-Identifier: Apache-2.0
"""The program ``shmmap-ros-bridge``."""

from __future__ import annotations

import argparse
import os
import signal
import sys
from collections.abc import Sequence
from datetime import datetime
from typing import TYPE_CHECKING, Any, Final

from shmmap_clients.command_line import (
    add_daemon_options,
    connect,
    positive,
    print_line,
    run_command,
    seconds,
)

if TYPE_CHECKING:
    from shmmap import Client

_NAME: Final = "shmmap-ros-bridge"
_GB: Final = 10**9
_MAX_GB: Final = (2**31 - 1) / _GB
_NAMES: Final = ("partial", "differential", "selected", "metadata", "whole", "live")
_EPILOG: Final = """\
Names, in the namespace unless they begin with a slash; --name WHAT=NAME changes one:
  partial        service get_partial_pointcloud_map
  differential   service get_differential_pointcloud_map
  selected       service get_selected_pointcloud_map
  metadata       topic pointcloud_map_metadata, latched
  whole          topic pointcloud_map, latched, with --whole-map
  live           /shmmap/live: of a live map the services get_occupied_voxels, get_free_voxels (in memory),
                 get_saved_occupied_voxels, get_saved_free_voxels (on disk), and the topics
                 occupied_voxels, free_voxels
and the six parameter services of the node.  CYCLONEDDS_URI, ROS_AUTOMATIC_DISCOVERY_RANGE, ROS_STATIC_PEERS
and ROS_LOCALHOST_ONLY count as they do for nodes.  Nodes have to run with
RMW_IMPLEMENTATION=rmw_cyclonedds_cpp: `shmmap doctor` names those that do not.
Where ROS 2 is installed, use the node instead, shmmap-ros-node: it serves every implementation.
Ends with SIGTERM or Ctrl-C.
Exit code: 0; 2 a name, or the whole map is too large; 69 no daemon; 71 DDS does not start; 75 another bridge
of this daemon runs in this domain."""


def main(argv: Sequence[str] | None = None) -> int:
    """Serve ROS nodes until a signal arrives, and return the exit code."""
    return run_command(
        _NAME,
        "Serve the daemon's map to ROS 2 nodes as Autoware's pointcloud_map_loader does, over CycloneDDS."
        " Nodes need no change; those that use shmmap themselves are faster.",
        _add_options,
        _run,
        argv,
        epilog=_EPILOG,
    )


def _add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--domain",
        type=_domain,
        default=None,
        metavar="N",
        help="DDS domain, 0 to 232 (default: ROS_DOMAIN_ID, else 0)",
    )
    parser.add_argument(
        "--node", default="pointcloud_map_loader", metavar="NAME", help="the node (default: %(default)s)"
    )
    parser.add_argument(
        "--namespace",
        default="/map",
        metavar="NAME",
        help="where the node and its services are (default: %(default)s)",
    )
    parser.add_argument(
        "--name",
        action="append",
        type=_renamed,
        default=[],
        metavar="WHAT=NAME",
        help="remap a name; see below; may be repeated",
    )
    parser.add_argument(
        "--wait",
        type=seconds,
        default=30.0,
        metavar="SECONDS",
        help="how long cells of a request may take to load; what is missing then is left out (default: 30)",
    )
    parser.add_argument(
        "--plain-ids",
        action="store_true",
        help="ids of cells are those of Autoware, without versions: changed cells are not sent again",
    )
    parser.add_argument(
        "--whole-map",
        action="store_true",
        help="publish the whole map as one cloud, for small maps; the bridge holds it in memory",
    )
    parser.add_argument(
        "--whole-map-limit",
        type=positive,
        default=_MAX_GB,
        metavar="GB",
        help="refuse to if it takes more (default and most: 2.147, the largest message of CycloneDDS)",
    )
    parser.add_argument(
        "--live",
        metavar="NAME",
        help="serve this live map (default: the daemon's, where it keeps just one)",
    )
    parser.add_argument(
        "--voxels-every",
        type=positive,
        default=1.0,
        metavar="SECONDS",
        help="publish voxels of the live map at most this often (default: 1)",
    )
    add_daemon_options(parser, json=False)


def _domain(text: str) -> int:
    try:
        value = int(text)
    except ValueError:
        value = -1
    if not 0 <= value <= 232:
        raise argparse.ArgumentTypeError(f"expected a domain, 0 to 232, not {text!r}")
    return value


def _renamed(text: str) -> tuple[str, str]:
    what, found, name = text.partition("=")
    if not found or what not in _NAMES or not name:
        raise argparse.ArgumentTypeError(f"expected WHAT=NAME, WHAT one of {', '.join(_NAMES)}, not {text!r}")
    return what, name


def _run(args: argparse.Namespace) -> int:
    from shmmap.errors import ConfigError
    from shmmap_clients.ros_bridge.node import BridgeSettings, RosBridge

    domain = args.domain
    if domain is None:
        try:
            domain = _domain(os.environ.get("ROS_DOMAIN_ID") or "0")
        except argparse.ArgumentTypeError as error:
            raise ConfigError(str(error), key="ROS_DOMAIN_ID", origin="environment") from None
    settings = BridgeSettings(
        domain=domain,
        node=args.node,
        namespace=args.namespace,
        names=dict(args.name),
        wait_s=args.wait,
        plain_ids=args.plain_ids,
        whole_map=args.whole_map,
        whole_bytes=min(int(args.whole_map_limit * _GB), 2**31 - 1),
        voxels_every_s=args.voxels_every,
    )
    with connect(args, _NAME) as client, connect(args, _NAME) as live_client:
        name = _live_map(args, live_client)
        live = live_client.live(name) if name else None
        with RosBridge(client, settings, _log, live) as bridge:
            before = {
                number: signal.signal(number, lambda *_: bridge.stop())
                for number in (signal.SIGTERM, signal.SIGINT)
            }
            try:
                more = f" and live map {name}" if name else ""
                _log(
                    f"ready: {args.node} in domain {domain}, map {client.welcome.map_path or '(none)'}{more}"
                )
                bridge.run()
            finally:
                for number, handler in before.items():
                    signal.signal(number, handler)
    return 0


def _live_map(args: argparse.Namespace, client: Client) -> str:
    """Return the name of the live map to serve; empty for none."""
    from shmmap import BadRequest

    there = [row.name for row in client.live_maps()]
    if args.live:
        return str(args.live)
    if len(there) > 1:
        raise BadRequest(
            f"the daemon keeps several live maps: {', '.join(there)}", hint="choose one with --live"
        )
    return there[0] if there else ""


def _log(text: str, *_: Any) -> None:
    print_line(f"{datetime.now():%Y-%m-%d %H:%M:%S} {_NAME}: {text}", file=sys.stderr)
    sys.stderr.flush()
