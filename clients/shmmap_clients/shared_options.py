# SPDX-License-Identifier: Apache-2.0
"""Options that several programs have: the same name, value and help wherever they mean the same."""

from __future__ import annotations

import argparse
import os

from shmmap_clients.command_line import finite, not_negative, positive

__all__ = [
    "Parser",
    "add_backend_option",
    "add_height_option",
    "add_leaf_option",
    "add_quiet_option",
    "add_radius_option",
    "add_scan_option",
    "add_scans_option",
    "add_sigma_options",
    "add_thin_option",
    "add_threads_option",
]

Parser = argparse.ArgumentParser | argparse._ArgumentGroup


def add_scan_option(parser: Parser) -> None:
    """Add ``--scan``, a file as `shmmap_clients.scans.scan_file` reads it."""
    parser.add_argument(
        "--scan", required=True, metavar="FILE", help="scan: PCD, NPZ (xyz or xyz_4mm) or KITTI .bin"
    )


def add_scans_option(parser: Parser) -> None:
    """Add ``--scans``, see `shmmap_clients.scans.scan_source`."""
    parser.add_argument(
        "--scans",
        required=True,
        metavar="DIR|ENDPOINT",
        help="scans: a directory (PCD, NPZ, KITTI .bin; in the order of their names), or the ZeroMQ address"
        " of a publisher",
    )


def add_leaf_option(parser: Parser) -> None:
    """Add ``--leaf``."""
    parser.add_argument(
        "--leaf", type=positive, default=2.0, metavar="M", help="edge length of an NDT voxel (default: 2)"
    )


def add_thin_option(parser: Parser, *, default: float) -> None:
    """Add ``--thin``."""
    shown = (
        f"{default:g}; 0: use all points"
        if default
        else "0: use all points, to equal the original programs; 1 is recommended: about 20 times faster,"
        " and more accurate"
    )
    parser.add_argument(
        "--thin",
        type=not_negative,
        default=default,
        metavar="M",
        help=f"replace the scan's points in each cube of M metres by their mean (default: {shown})",
    )


def add_radius_option(parser: Parser) -> None:
    """Add ``--map-radius``."""
    parser.add_argument(
        "--map-radius",
        type=positive,
        default=150.0,
        metavar="M",
        help="how far around the vehicle the map is kept (default: 150)",
    )


def add_backend_option(parser: Parser) -> None:
    """Add ``--backend``."""
    parser.add_argument(
        "--backend",
        default="numba",
        metavar="NAME",
        help="numba, or numpy: same results, slower, no compiler (default: numba)",
    )


def add_threads_option(parser: Parser, *, all_processors: bool = False) -> None:
    """Add ``--threads``; by default one, or as many as there are processors, but at most four."""
    parser.add_argument(
        "--threads",
        type=int,
        default=min(len(os.sched_getaffinity(0)), 4) if all_processors else 1,
        metavar="N",
        help="threads to compute with; results do not depend on it (default:"
        f" {'as many as there are processors, at most 4' if all_processors else '1'})",
    )


def add_quiet_option(parser: Parser) -> None:
    """Add ``--quiet``."""
    parser.add_argument("--quiet", action="store_true", help="no progress on stderr")


def add_sigma_options(parser: Parser) -> None:
    """Add ``--sigma`` and ``--sigma-yaw``."""
    parser.add_argument(
        "--sigma",
        type=positive,
        default=2.0,
        metavar="M",
        help="how far off the rough x and y may be, standard deviation (default: 2)",
    )
    parser.add_argument(
        "--sigma-yaw",
        type=positive,
        default=0.1745,
        metavar="RAD",
        help="how far off the rough yaw may be, standard deviation; 3.14: the yaw is unknown (default:"
        " 0.1745, 10 degrees)",
    )


def add_height_option(parser: Parser, *, default: float | None, shown: str) -> None:
    """Add ``--height``."""
    parser.add_argument(
        "--height",
        type=finite,
        default=default,
        metavar="M",
        help=f"height of the frame that the points are in above the map's ground (default: {shown})",
    )
