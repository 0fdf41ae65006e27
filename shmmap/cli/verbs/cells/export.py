# SPDX-License-Identifier: Apache-2.0
"""``shmmap export``: write cells from shared memory to files."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from shmmap.cli.areas import add_area_or_ids, area_from, no_cell_there, print_near_cells
from shmmap.cli.compiling_lines import saying_what_the_daemon_does
from shmmap.cli.daemon_address import connect
from shmmap.cli.options import Subparsers, add_daemon_options, add_verb, seconds
from shmmap.cli.program import add_allow_empty, complain, nothing_found
from shmmap.cli.screens.output import counted, print_json, print_line
from shmmap.errors import BadRequest
from shmmap.lacking import PREPARE_HINT, area_text, failure_lines, near_cells_hint, not_covered, unknown_ids

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from shmmap.cli.verbs.cells import outputs
    from shmmap.client.cell import Cell
    from shmmap.client.cell_set import CellSet
    from shmmap.geometry import Area

_FORMATS = ("pcd", "ply", "npz")

_EXIT = """\
Exit code: 0; 1 when a cell could not be loaded, or there is no cell or no point (then nothing is written);
73 a file cannot be written."""


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb ``export``."""
    parser = add_verb(
        subparsers,
        "export",
        run,
        help="write cells to PCD, PLY or NPZ files",
        description="Write cells, as the daemon serves them, to one merged file or to one file per cell.  "
        "Whole cells are written, unless --crop is given.  A layer without points, such as ndt(leaf=2.0), is "
        "written to one NPZ file per cell.",
        output="cells.outputs.Exported",
        epilog=_EXIT,
    )
    add_area_or_ids(parser)
    parser.add_argument(
        "--layer", metavar="SPEC", default="points", help="what to have of each cell (default: points)"
    )
    parser.add_argument("--crop", action="store_true", help="leave out points outside the area (and --z)")
    out = parser.add_mutually_exclusive_group(required=True)
    out.add_argument("-o", "--output", metavar="FILE", help="one merged file, .pcd, .ply or .npz")
    out.add_argument("--output-dir", metavar="DIR", help="one file per cell, named as the cell")
    parser.add_argument(
        "--format", choices=_FORMATS, help="format of the files (default: as FILE ends; pcd in a DIR)"
    )
    parser.add_argument(
        "--encoding",
        choices=("ascii", "binary", "binary_compressed"),
        default="binary",
        help="encoding of PCD files (default: binary)",
    )
    parser.add_argument("--force", action="store_true", help="overwrite files that exist")
    parser.add_argument(
        "--wait", metavar="SECONDS", type=seconds, default=60.0, help="how long loads may take (default: 60)"
    )
    add_allow_empty(parser)
    add_daemon_options(parser)


def run(args: argparse.Namespace) -> int:
    """Write the files of an export."""
    from shmmap.cli.verbs.cells import outputs

    area = area_from(args)
    if args.crop and area is None:
        raise BadRequest("--crop needs an area", hint="add --circle, --square or --box")
    kind = _format(args)
    with connect(args) as client:
        with saying_what_the_daemon_does(client):
            if area:
                found = client.area(area, args.layer, wait=args.wait, strict=None)
            else:
                found = client.selected(args.id, args.layer, wait=args.wait, strict=None)
        if not found.complete:
            _complain_of(found, args.wait)
            print_near_cells(near_cells_hint(client, unknown_ids(found.failed)))
            return 1
        written: list[outputs.File] = []
        if found.cells:
            _refuse_without_points(args, found.cells, kind)
            plan = _plan(args, found.cells, kind)
            for path, _ in plan:
                if path.exists() and not args.force:
                    raise _exists(path)
            for path, cells in plan:
                columns = _merged_columns(cells, area if args.crop else None)
                rows = len(columns["xyz"]) if "xyz" in columns else sum(cell.points for cell in cells)
                if rows:
                    _write(path, columns, kind, args)
                    ids = [cell.id for cell in cells]
                    written.append(outputs.File(str(path), rows, ids))
        if args.json:
            print_json(outputs.Exported(written))
        else:
            for file in written:
                cells_text = counted(len(file.cells), "cell")
                rows_text = counted(file.points, "point" if args.layer == "points" else "row")
                print_line(f"{file.path}: {rows_text} of {cells_text}")
        if written:
            return 0
        if area is not None and not found.cells:
            return no_cell_there(args, client, area)
        where = f" {area_text(area)}" if area is not None and args.crop else ""
        return nothing_found(
            args, f"no point{where} in {counted(len(found.cells), 'cell')}: nothing is written"
        )


def _complain_of(found: CellSet, wait_s: float) -> None:
    """Report the cells that could not be loaded."""
    for line in failure_lines(found.failed):
        complain("shmmap", line)
    for pending in found.pending:
        complain("shmmap", f"{pending.id}: not loaded within {wait_s:g} s")
    if any(pending.layer != "points" for pending in found.pending):
        complain("shmmap", "what is pending is still being computed", f"--wait SECONDS; {PREPARE_HINT}")
    if not found.covered:
        complain("shmmap", *not_covered(found))


def _format(args: argparse.Namespace) -> str:
    suffix = "pcd" if args.output is None else Path(args.output).suffix.lower().removeprefix(".")
    kind: str = args.format or suffix
    if kind not in _FORMATS:
        raise BadRequest(
            f"{args.output}: what format is that?", hint="name it .pcd, .ply or .npz, or give --format"
        )
    return kind


def _refuse_without_points(args: argparse.Namespace, cells: Sequence[Cell], kind: str) -> None:
    """Refuse to merge or crop a layer that is no table of points, or to write it as a cloud."""
    apart = kind == "npz" and args.output is None and not args.crop
    for cell in cells if not apart else ():
        if "xyz" not in cell.columns or any(len(one) != cell.points for one in cell.columns.values()):
            raise BadRequest(
                f"{cell.layer} is no table of points", hint="write it with --output-dir DIR --format npz"
            )


def _plan(args: argparse.Namespace, cells: Sequence[Cell], kind: str) -> list[tuple[Path, list[Cell]]]:
    """Return the cells of each output file."""
    unique = list({cell.id: cell for cell in cells}.values())
    if args.output is not None:
        return [(Path(args.output), unique)]
    names = [Path(cell.id).with_suffix(f".{kind}").name for cell in unique]
    if len(set(names)) != len(names):
        raise BadRequest("several cells have the same file name", hint="export them merged, with --output")
    return [(Path(args.output_dir, name), [cell]) for name, cell in zip(names, unique, strict=True)]


def _merged_columns(cells: Sequence[Cell], area: Area | None) -> dict[str, NDArray[Any]]:
    """Concatenate the points of several cells; given an area, only the points in it.

    Raises
    ------
    BadRequest
        The cells have different columns, so that one table cannot hold them all.
    """
    import numpy as np

    kinds = {
        tuple((name, view.dtype.str, view.shape[1:]) for name, view in cell.columns.items()) for cell in cells
    }
    if len(kinds) > 1:
        described = " and ".join(
            ", ".join(f"{name} {dtype}" for name, dtype, _ in kind) for kind in sorted(kinds)
        )
        raise BadRequest(
            f"the cells have different columns: {described}", hint="export them with --output-dir"
        )
    if area is None:
        return {name: np.concatenate([cell[name] for cell in cells]) for name in cells[0].column_names}
    masks = [_inside(area, cell) for cell in cells]
    return {
        name: np.concatenate([cell[name][mask] for cell, mask in zip(cells, masks, strict=True)])
        for name in cells[0].column_names
    }


def _inside(area: Area, cell: Cell) -> NDArray[np.bool_]:
    """Return a mask (N,) of a cell's points in an area; each point counts as a box without extent."""
    import numpy as np

    x, y, z = (cell.xyz[:, axis].astype(np.float64) + cell.origin[axis] for axis in range(3))
    inside = area.overlaps(np.column_stack((x, y, x, y)))
    if area.z is not None:
        inside &= (z >= area.z[0]) & (z <= area.z[1])
    return inside


def _write(path: Path, columns: dict[str, NDArray[Any]], kind: str, args: argparse.Namespace) -> None:
    """Write one file, complete or not at all."""
    from shmmap.formats.durable_file import appearing_file, writing_errors
    from shmmap.formats.npz_writer import write_npz
    from shmmap.formats.pcd.writer import write_pcd
    from shmmap.formats.ply_writer import write_ply

    with writing_errors(str(path)):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with appearing_file(path, replace=args.force) as file:
                if kind == "npz":
                    write_npz(file, columns)
                elif kind == "ply":
                    write_ply(file, columns)
                else:
                    write_pcd(file, columns, encoding=args.encoding)
        except FileExistsError as error:
            raise _exists(path) from error


def _exists(path: Path) -> BadRequest:
    return BadRequest(f"{path} exists", hint="give another name, or --force to overwrite it")
