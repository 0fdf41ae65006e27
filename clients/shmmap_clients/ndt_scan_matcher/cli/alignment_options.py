# SPDX-License-Identifier: Apache-2.0
"""Options that say how to align, and which results are trusted."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from shmmap_clients.command_line import at_least, positive
from shmmap_clients.shared_options import add_scoring_options, add_trust_options, scoring_settings, trust_from

if TYPE_CHECKING:
    from shmmap_clients.ndt_scan_matcher.matching.matcher import NdtMatcher

__all__ = ["add_alignment_options", "matcher_from"]


def add_alignment_options(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    group = parser.add_argument_group("alignment")
    group.add_argument(
        "--variant",
        choices=("autoware", "pclomp", "pcl"),
        default="autoware",
        help="behave as this NDT program: its covariances, stop rule and neighbours (default: autoware)",
    )
    group.add_argument(
        "--neighbors",
        choices=("direct1", "direct7", "radius"),
        help="voxels that a point is scored against: its own, also the six beside it, or all whose mean is"
        " within one leaf (default: the variant's)",
    )
    group.add_argument(
        "--epsilon", type=positive, metavar="E", help="end when a step is shorter (default: the variant's)"
    )
    group.add_argument(
        "--max-iterations", type=at_least(1), metavar="N", help="Newton steps (default: the variant's)"
    )
    group.add_argument(
        "--step-size", type=positive, default=0.1, metavar="M", help="longest step (default: 0.1)"
    )
    group.add_argument(
        "--line-search",
        action=argparse.BooleanOptionalAction,
        default=None,
        help="More-Thuente line search (default: the variant's)",
    )
    group.add_argument(
        "--fine",
        action="store_true",
        help="align once more after the variant's alignment, with the voxels' true covariances: several times"
        " more accurate",
    )
    group.add_argument(
        "--steady",
        action=argparse.BooleanOptionalAction,
        default=None,
        help="steps that do not oscillate between two places, as the originals' can (default: if --fine)",
    )
    add_scoring_options(group)
    limits = parser.add_argument_group("limits (what exceeds one is left out and counted)")
    limits.add_argument(
        "--max-points", type=at_least(1), metavar="N", help="points of a scan (default: 131072)"
    )
    limits.add_argument(
        "--max-neighbors",
        type=at_least(1),
        metavar="N",
        help="voxels per point; the nearest are taken (default: 32)",
    )
    limits.add_argument(
        "--max-voxels",
        type=at_least(1),
        metavar="N",
        help="voxels of the map; whole cells are left out (default: 1000000)",
    )
    limits.add_argument(
        "--max-map-bytes",
        type=at_least(1),
        metavar="N",
        help="memory that matching needs of the map; whole cells are left out (default: 96 for each voxel"
        " that is allowed)",
    )
    limits.add_argument(
        "--deadline",
        type=positive,
        metavar="SECONDS",
        help="for one alignment: it ends then, not converged; a device that has not answered is not waited"
        " for (default: none)",
    )
    add_trust_options(parser)


def matcher_from(args: argparse.Namespace) -> NdtMatcher:
    """Return the matcher that the options ask for."""
    from shmmap_clients.ndt_scan_matcher.matching.limits import Limits
    from shmmap_clients.ndt_scan_matcher.matching.matcher import NdtMatcher
    from shmmap_clients.ndt_scan_matcher.matching.settings import Settings

    settings = Settings(
        variant=args.variant,
        neighbors=args.neighbors,
        epsilon=args.epsilon,
        max_iterations=args.max_iterations,
        step_size=args.step_size,
        line_search=args.line_search,
        mode="coarse_fine" if args.fine else "single",
        steady=args.steady,
        **scoring_settings(args),
    )
    given: dict[str, Any] = {
        "source_points": args.max_points,
        "neighbors": args.max_neighbors,
        "voxels": args.max_voxels,
        "map_bytes": args.max_map_bytes,
        "deadline_s": args.deadline,
    }
    limits = Limits(**{name: value for name, value in given.items() if value is not None})
    return NdtMatcher(settings, limits=limits, trust=trust_from(args), threads=args.threads)
