# SPDX-License-Identifier: Apache-2.0
"""Options that say which points the map explains."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from shmmap_clients.command_line import positive
from shmmap_clients.shared_options import add_backend_option

if TYPE_CHECKING:
    from shmmap_clients.compare_map_filter.rule import CompareRule

__all__ = ["add_rule_options", "rule_from"]


def add_rule_options(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    group = parser.add_argument_group("rule (Autoware's compare-map filters)")
    group.add_argument(
        "--mode",
        choices=("voxel", "voxel-distance", "distance"),
        default="voxel",
        help="a point is removed when voxel: a voxel's centroid is near it; voxel-distance: a map point is in"
        " its voxel or near it; distance: a map point is near it (default: voxel)",
    )
    group.add_argument(
        "--distance", type=positive, default=0.5, metavar="M", help="what near means (default: 0.5)"
    )
    group.add_argument(
        "--z-ratio",
        type=positive,
        default=0.5,
        metavar="R",
        help="height of a voxel, as a multiple of --distance (default: 0.5)",
    )
    add_backend_option(group)


def rule_from(args: argparse.Namespace) -> CompareRule:
    """Return the rule that the options ask for."""
    from shmmap_clients.compare_map_filter.rule import CompareRule

    return CompareRule(args.mode, args.distance, args.z_ratio)
