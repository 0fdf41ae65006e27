# SPDX-License-Identifier: Apache-2.0
"""Options that several programs have: the same name, value and help wherever they mean the same."""

from __future__ import annotations

import argparse
import os
from typing import TYPE_CHECKING, Any

from shmmap_clients.command_line import complain, finite, not_negative, positive

if TYPE_CHECKING:
    from shmmap_clients.scans.bin_layout import BinLayout
    from shmmap_clients.scans.scan_file import ScanReader

__all__ = [
    "Parser",
    "add_backend_option",
    "add_height_option",
    "add_leaf_option",
    "add_min_range_option",
    "add_quiet_option",
    "add_radius_option",
    "add_scan_option",
    "add_scans_option",
    "add_sigma_options",
    "add_thin_option",
    "add_threads_option",
    "reader_from",
]

Parser = argparse.ArgumentParser | argparse._ArgumentGroup


def add_scan_option(parser: Parser) -> None:
    """Add ``--scan``, a file as `shmmap_clients.scans.scan_file` reads it, and how it is read."""
    parser.add_argument(
        "--scan",
        required=True,
        metavar="FILE",
        help="scan: PCD, NPZ (xyz or xyz_4mm), or bare rows in a .bin",
    )
    _add_bin_option(parser)
    add_min_range_option(parser)


def add_scans_option(parser: Parser, *, min_range: bool = True) -> None:
    """Add ``--scans``, see `shmmap_clients.scans.scan_source`, and how they are read."""
    parser.add_argument(
        "--scans",
        required=True,
        metavar="DIR|ENDPOINT",
        help="scans: a directory (PCD, NPZ, .bin; in the order of their names), or the ZeroMQ address of a"
        " publisher",
    )
    _add_bin_option(parser)
    if min_range:
        add_min_range_option(parser)


def _add_bin_option(parser: Parser) -> None:
    parser.add_argument(
        "--bin-columns",
        type=_bin_layout,
        metavar="NAMES",
        help="columns of .bin files, such as x,y,z,intensity,ring: float32, or as x:f8,y,z,t:u4 says; _ skips"
        " one (default: recognised by their numbers, and said)",
    )


def _bin_layout(text: str) -> BinLayout:
    from shmmap import BadRequest
    from shmmap_clients.scans.bin_layout import BinLayout

    try:
        return BinLayout.parse(text)
    except BadRequest as error:
        raise argparse.ArgumentTypeError(f"{error.message} ({error.hint})") from None


def add_min_range_option(parser: Parser) -> None:
    """Add ``--min-range``."""
    parser.add_argument(
        "--min-range",
        type=not_negative,
        default=0.5,
        metavar="M",
        help="leave out points of the scan nearer than that to its frame's origin: no-returns at (0, 0, 0)"
        " (default: 0.5; 0: none)",
    )


def reader_from(args: argparse.Namespace, name: str, **settings: Any) -> ScanReader:
    """Return what reads scans as the options say; what a user should know goes to stderr, unless ``--quiet``.

    Parameters
    ----------
    args
    name
        The program's.
    settings
        Of `ScanReader`, instead of the options.
    """
    from shmmap_clients.scans.scan_file import ScanReader

    def say(note: str) -> None:
        if not getattr(args, "quiet", False):
            complain(name, note)

    given = {"bin_layout": args.bin_columns, "min_range": getattr(args, "min_range", None), "say": say}
    return ScanReader(**{**given, **settings})


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
