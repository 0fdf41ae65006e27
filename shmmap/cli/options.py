# SPDX-License-Identifier: Apache-2.0
"""Options that several verbs share, and how their values are read."""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Callable
from threading import TIMEOUT_MAX
from typing import TYPE_CHECKING, TypeAlias

from shmmap.errors import BadRequest, ConfigError

if TYPE_CHECKING:
    from shmmap.geometry import Area

__all__ = [
    "Subparsers",
    "add_area_options",
    "add_cells_argument",
    "add_daemon_options",
    "add_json_option",
    "add_statistics_options",
    "add_verb",
    "area_from",
    "at_least",
    "cells_or_all",
    "numbers",
    "seconds",
    "size_bytes",
]

# argparse offers no public name for this type
Subparsers: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"


def numbers(text: str, names: str) -> list[float]:
    """Read ``"-5,3,40"`` as the numbers that ``names`` (``"X,Y,R"``) announces."""
    parts = text.split(",")
    wanted = names.split(",")
    try:
        values = [float(part) for part in parts]
    except ValueError:
        values = []
    if len(values) != len(wanted) or any(math.isnan(value) for value in values):
        raise argparse.ArgumentTypeError(f"expected {len(wanted)} numbers {names}, not {text!r}")
    return values


def seconds(text: str) -> float:
    """Read a duration in seconds, not negative and no longer than threads can wait."""
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not (0.0 <= value <= TIMEOUT_MAX):
        raise argparse.ArgumentTypeError(f"expected seconds, not {text!r}")
    return value


def at_least(lowest: int) -> Callable[[str], int]:
    """Return an argparse type: a whole number, not below ``lowest``."""

    def parse(text: str) -> int:
        if not re.fullmatch(r"[+-]?\d{1,18}", text) or int(text) < lowest:
            raise argparse.ArgumentTypeError(f"expected a whole number, {lowest} or more, not {text!r}")
        return int(text)

    return parse


def size_bytes(text: str) -> int:
    """Read a size such as ``512M``, bytes."""
    from shmmap.daemon.config import parse_bytes

    try:
        return parse_bytes(text)
    except ConfigError as error:
        raise argparse.ArgumentTypeError(f"{error.message}; {error.hint}") from None


class _HelpFormatter(argparse.RawDescriptionHelpFormatter):
    """Leaves texts of several lines as they are written, and fills the others."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        if "\n" in text:
            return super()._fill_text(text, width, indent)
        return argparse.HelpFormatter._fill_text(self, text, width, indent)


def add_verb(
    subparsers: Subparsers,
    name: str,
    run: Callable[[argparse.Namespace], int],
    *,
    help: str,  # noqa: A002
    description: str,
    json: str = "",
    epilog: str = "",
) -> argparse.ArgumentParser:
    """Add a verb that ``run`` carries out; ``json`` and ``epilog`` are shown as written below its options."""
    if json:
        epilog = f"JSON (fields may be added, none is removed):\n{json}"
    parser = subparsers.add_parser(
        name,
        help=help,
        description=description,
        epilog=epilog,
        formatter_class=_HelpFormatter,
    )
    parser.set_defaults(run=run)
    return parser


def add_json_option(parser: argparse.ArgumentParser) -> None:
    """Add ``--json``."""
    parser.add_argument("--json", action="store_true", help="print JSON instead of text")


def add_statistics_options(parser: argparse.ArgumentParser, *, json: bool = True) -> None:
    """Add what finds a daemon's statistics segment, and ``--json`` unless the verb has none."""
    group = parser.add_argument_group("which daemon")
    group.add_argument("--instance", metavar="NAME", help="instance name (default: default)")
    group.add_argument("--endpoint", metavar="PATH", help="request socket, a path or an ipc:// URL")
    group.add_argument("--runtime-dir", metavar="DIR", help="directory of the request socket")
    group.add_argument("--shm-dir", metavar="DIR", help="directory of the segments (default: /dev/shm)")
    if json:
        add_json_option(parser)


def add_daemon_options(parser: argparse.ArgumentParser, *, json: bool = True) -> None:
    """Add what finds a daemon and bounds how long it is asked, and ``--json`` unless the verb has none."""
    add_statistics_options(parser, json=json)
    parser.add_argument(
        "--timeout",
        metavar="SECONDS",
        type=seconds,
        help="how long to wait for an answer (default: 0.9 to connect, then 5)",
    )


def add_cells_argument(parser: argparse.ArgumentParser) -> None:
    """Add ``CELL...``."""
    parser.add_argument("cells", metavar="CELL", nargs="*", help="ids, or file names where unique")


def cells_or_all(args: argparse.Namespace, verb: str) -> list[str] | None:
    """Return the cells that were named, or None for ``--all``; one of both has to be given."""
    if bool(args.cells) == args.all:
        raise BadRequest(f"{verb}: say which cells, or --all", hint=f"shmmap {verb} --help")
    return args.cells or None


def add_area_options(parser: argparse.ArgumentParser, group: argparse._MutuallyExclusiveGroup) -> None:
    """Add ``--circle``, ``--square``, ``--box`` to ``group`` and ``--z`` to the parser."""
    group.add_argument(
        "--circle", metavar="X,Y,R", type=lambda t: numbers(t, "X,Y,R"), help="true circle, metres, map frame"
    )
    group.add_argument(
        "--square",
        metavar="X,Y,R",
        type=lambda t: numbers(t, "X,Y,R"),
        help="Autoware's area: a square of half-side R",
    )
    group.add_argument(
        "--box", metavar="X0,Y0,X1,Y1", type=lambda t: numbers(t, "X0,Y0,X1,Y1"), help="rectangle"
    )
    parser.add_argument(
        "--z",
        metavar="MIN,MAX",
        type=lambda t: numbers(t, "MIN,MAX"),
        help="only cells with points in these heights",
    )


def area_from(args: argparse.Namespace) -> Area | None:
    """Return the area the options describe, or None where they name none."""
    from shmmap import geometry

    z = geometry.ZRange(*args.z) if args.z is not None else None
    if args.circle is not None:
        x, y, radius = args.circle
        return geometry.Circle(x, y, radius, z)
    if args.square is not None:
        x, y, radius = args.square
        return geometry.AutowareSquare(x, y, radius, z)
    if args.box is not None:
        min_x, min_y, max_x, max_y = args.box
        return geometry.Box(min_x, min_y, max_x, max_y, z)
    if z is not None:
        raise BadRequest("--z needs an area", hint="add --circle, --square or --box")
    return None
