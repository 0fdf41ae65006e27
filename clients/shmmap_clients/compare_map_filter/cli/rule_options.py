# SPDX-License-Identifier: Apache-2.0
"""Options that say when the map explains a point."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

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
        help="a voxel's centroid is near; or a map point is in the voxel or near; or a map point is near",
    )
    group.add_argument("--distance", type=float, default=0.5, metavar="M", help="how near (default 0.5)")
    group.add_argument(
        "--z-ratio", type=float, default=0.5, metavar="R", help="height of a voxel over the distance (0.5)"
    )
    group.add_argument("--backend", choices=("numba", "numpy"), default="numba", help="same result, slower")


def rule_from(args: argparse.Namespace) -> CompareRule:
    """Return the rule that the options ask for."""
    from shmmap_clients.compare_map_filter.rule import CompareRule

    return CompareRule(args.mode, args.distance, args.z_ratio)
