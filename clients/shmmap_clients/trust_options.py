# SPDX-License-Identifier: Apache-2.0
"""Options that say which poses are trusted."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from shmmap_clients.command_line import at_least, not_negative

if TYPE_CHECKING:
    from shmmap_clients.ndt_scan_matcher import TrustLimits

__all__ = ["FAILED_LIMITS", "add_trust_options", "trust_from"]

FAILED_LIMITS = """\
failed_limits names what did not hold: no_map, converged (the alignment did not
converge), nvtl, transform_probability, oscillations, points, distance,
angle, sharpness, spread."""


def add_trust_options(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    trust = parser.add_argument_group("trust (a result beyond one of these limits is not trusted)")
    trust.add_argument(
        "--trust-nvtl",
        type=not_negative,
        metavar="N",
        help="lowest nearest-voxel transformation likelihood (default by --leaf: 1.22 at 1 m, 2.30 at 2 m,"
        " 2.96 at 3 m; for alignments with true covariances 0.91 at 1 m)",
    )
    trust.add_argument(
        "--trust-tp", type=not_negative, metavar="N", help="lowest transform probability (default: any)"
    )
    trust.add_argument(
        "--trust-oscillations",
        type=at_least(0),
        default=10,
        metavar="N",
        help="most reversals of the step (default: 10)",
    )
    trust.add_argument(
        "--trust-points",
        type=at_least(0),
        default=80,
        metavar="N",
        help="least points of the scan with a voxel of the map near (default: 80)",
    )
    trust.add_argument(
        "--trust-distance",
        type=not_negative,
        default=10.0,
        metavar="M",
        help="20 points of the scan must be at least so far away (default: 10)",
    )
    trust.add_argument(
        "--trust-angle",
        type=not_negative,
        default=35.0,
        metavar="DEG",
        help="least width of the sector that the points of the scan lie in (default: 35)",
    )
    trust.add_argument(
        "--trust-sharpness",
        type=not_negative,
        metavar="N",
        help="lowest curvature of the score per matched point in any direction (default: 2.7; for alignments"
        " with true covariances 3.4)",
    )
    trust.add_argument(
        "--trust-spread",
        type=not_negative,
        default=0.03,
        metavar="N",
        help="lowest ratio of the variances of the position in its most and least certain directions, 0 to 1"
        " (default: 0.03)",
    )


def trust_from(args: argparse.Namespace) -> TrustLimits:
    """Return the limits of trust that the options ask for."""
    from shmmap_clients.ndt_scan_matcher import TrustLimits

    return TrustLimits(
        nvtl=args.trust_nvtl,
        transform_probability=args.trust_tp,
        oscillations=args.trust_oscillations,
        points=args.trust_points,
        distance=args.trust_distance,
        angle=args.trust_angle,
        sharpness=args.trust_sharpness,
        spread=args.trust_spread,
    )
