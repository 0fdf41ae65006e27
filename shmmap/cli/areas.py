# SPDX-License-Identifier: Apache-2.0
"""Areas and cells as arguments on the command line, and messages for areas without cells."""

from __future__ import annotations

import argparse
import os
import sys
from typing import TYPE_CHECKING, TypeVar

from shmmap.cli.options import numbers
from shmmap.cli.program import nothing_found
from shmmap.errors import BadRequest
from shmmap.lacking import near_cells_hint
from shmmap.lacking import no_cell_there as nothing_there

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from shmmap.client.client import Client
    from shmmap.client.map_listing import CellInfo
    from shmmap.geometry import Area
    from shmmap.protocol.messages import Evicted, Pinned

BoxTuple = tuple[float, float, float, float]
Answer = TypeVar("Answer", "Evicted", "Pinned")


def add_area_options(
    parser: argparse.ArgumentParser, group: argparse._MutuallyExclusiveGroup, *, heights: bool = True
) -> None:
    """Add ``--circle``, ``--square`` and ``--box`` to ``group``, and ``--z`` if ``heights``."""
    parser.set_defaults(z=None)
    group.add_argument(
        "--circle",
        metavar="X,Y,R",
        type=lambda t: numbers(t, "X,Y,R"),
        help="cells within R metres of (X, Y) in the map frame",
    )
    group.add_argument(
        "--square",
        metavar="X,Y,R",
        type=lambda t: numbers(t, "X,Y,R"),
        help="cells that touch a square of half-side R about (X, Y), as Autoware's map loader selects them",
    )
    group.add_argument(
        "--box",
        metavar="X0,Y0,X1,Y1",
        type=lambda t: numbers(t, "X0,Y0,X1,Y1"),
        help="cells that touch a rectangle",
    )
    if heights:
        parser.add_argument(
            "--z",
            metavar="MIN,MAX",
            type=lambda t: numbers(t, "MIN,MAX"),
            help="only cells that reach into these heights, metres; also cells never loaded, whose heights "
            "are unknown",
        )


def add_area_or_ids(parser: argparse.ArgumentParser) -> None:
    """Add the areas and ``--id``, one of which must be given."""
    group = parser.add_mutually_exclusive_group(required=True)
    add_area_options(parser, group)
    group.add_argument(
        "--id",
        metavar="ID",
        nargs="+",
        action="extend",
        help="cells by id, or by file name where it is unique",
    )


def area_from(args: argparse.Namespace) -> Area | None:
    """Return the area that the options describe, or None if they describe none."""
    if all(getattr(args, name) is None for name in ("circle", "square", "box", "z")):
        return None
    import shmmap.geometry as geometry

    z = geometry.checked_heights(args.z)
    if args.circle is not None:
        x, y, radius = args.circle
        return geometry.Circle(x, y, radius, z)
    if args.square is not None:
        x, y, radius = args.square
        return geometry.AutowareSquare(x, y, radius, z)
    if args.box is not None:
        min_x, min_y, max_x, max_y = args.box
        return geometry.Box(min_x, min_y, max_x, max_y, z)
    raise BadRequest("--z needs an area", hint="add --circle, --square or --box")


def those_in(area: Area, boxes: Sequence[BoxTuple]) -> list[int]:
    """Return the indices of the boxes that touch an area; heights are ignored."""
    import numpy as np

    if not boxes:
        return []
    return [int(index) for index in np.flatnonzero(area.overlaps(np.array(boxes, np.float64)))]


# --- cells, named or in an area -----------------------------------------------------------------------


def add_cells_argument(parser: argparse.ArgumentParser) -> None:
    """Add ``CELL...``, and the area options that can replace the cell ids."""
    parser.add_argument("cells", metavar="CELL", nargs="*", help="cell ids; a file's name where it is unique")
    add_area_options(parser, parser.add_mutually_exclusive_group())


def act_on_cells(
    args: argparse.Namespace,
    verb: str,
    ask: Callable[[Client, list[str] | None], Answer],
    show: Callable[[Answer], None],
    *,
    nothing: Answer,
    optional: bool = False,
) -> int:
    """Apply a verb to the cells that the arguments name; return the exit code.

    Parameters
    ----------
    ask
        Called with the client and the ids (None for ``--all``); returns the daemon's answer.
    show
        Prints an answer; lists ids that the map does not have only with ``--json``.
    nothing
        The answer that ``--json`` prints if the area touches no cell.
    optional
        Whether neither cells nor an area need be given.

    Raises
    ------
    BadRequest
        Both cells and an area are given, or neither although one is required.
    """
    from shmmap.cli.daemon_address import connect
    from shmmap.cli.screens.output import print_line

    area = area_from(args)
    given = [bool(args.cells), area is not None, getattr(args, "all", False)]
    if sum(given) > 1 or (not any(given) and not optional):
        choices = "cells, an area or --all" if "all" in args else "cells or an area"
        only = "only one of: " if any(given) else ""
        raise BadRequest(f"{verb}: give {only}{choices}", hint=f"shmmap {verb} --help")
    with connect(args) as client:
        cells: list[str] | None = None if getattr(args, "all", False) else list(args.cells)
        if area is not None:
            cells = [cell.id for cell in client.metadata(area) if _at_height(area, cell)]
            if not cells:
                if args.json:
                    show(nothing)
                return no_cell_there(args, client, area)
        answer = ask(client, cells)
        hint = near_cells_hint(client, answer.unknown)
    show(answer)
    if not args.json:
        for name in answer.unknown:
            print_line(f"unknown cell: {name}")
    print_near_cells(hint)
    return 1 if answer.unknown else 0


def _at_height(area: Area, cell: CellInfo) -> bool:
    """Whether a cell may have points in the area's height range; True if the cell's heights are unknown."""
    from shmmap.geometry import heights_overlap

    return area.z is None or cell.z_bounds is None or heights_overlap(area.z, *cell.z_bounds)


# --- areas without cells ------------------------------------------------------------------------------


def around(boxes: Iterable[BoxTuple]) -> BoxTuple | None:
    """Return the smallest rectangle around all rectangles; None if there are none."""
    found = list(boxes)
    if not found:
        return None
    low_x, low_y, high_x, high_y = zip(*found, strict=True)
    return min(low_x), min(low_y), max(high_x), max(high_y)


def moved_by(id_prefix: str) -> tuple[float, float, float] | None:
    """Return the offset (metres) from a map's coordinates to those of the clouds it was divided from.

    None if the offset is zero, if another program made the map, or if the map's files are not on this
    machine.
    """
    map_dir = os.path.dirname(os.path.dirname(id_prefix + "_"))
    if not os.path.exists(os.path.join(map_dir, "shmmap_divide.json")):
        return None
    from shmmap.origin.map_report import read_map_frame

    origin = read_map_frame(map_dir).origin
    return origin if any(origin) else None


def no_cell_there(args: argparse.Namespace, client: Client, area: Area) -> int:
    """Report that no cell of the map touches an area, and where the map is; return the exit code."""
    return nothing_found(args, *nothing_there(client.welcome, area))


def print_near_cells(hint: str) -> None:
    """Print the hint of `shmmap.lacking.near_cells_hint` on stderr."""
    if hint:
        from shmmap.cli.screens.output import print_line  # takes 5 ms to import: only for error messages

        print_line(f"hint: {hint}", file=sys.stderr)
