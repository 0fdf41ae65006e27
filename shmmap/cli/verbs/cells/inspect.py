# SPDX-License-Identifier: Apache-2.0
"""``shmmap inspect PATH``: describe a point-cloud file, or every cloud of a directory."""

from __future__ import annotations

import argparse
import os
import sys
from typing import TYPE_CHECKING

from shmmap.cli.options import Subparsers, add_json_option, add_verb
from shmmap.cli.program import add_allow_empty, complain, nothing_found
from shmmap.cli.screens.output import (
    Column,
    counted,
    format_bytes,
    format_metres,
    print_json,
    print_line,
    print_pairs,
    print_table,
)
from shmmap.cli.screens.work_progress import StageProgress
from shmmap.errors import MapDataError, MapMissing

if TYPE_CHECKING:
    from shmmap.cli.verbs.cells import outputs
    from shmmap.formats.cloud import CloudDescription
    from shmmap.formats.coordinate_system import CoordinateSystem

_EXIT = """\
Exit code: 0; 1 when there is no finite point, 65 bad data (the message has path, byte offset and cause),
66 no such file, or no cloud in the directory."""

_NAMED_OUTSIDE = 10

_FILES = (
    Column("FILE"),
    Column("FORMAT", spare=4),
    Column("SIZE", "right", spare=3),
    Column("POINTS", "right"),
    Column("LEFT OUT", "right", spare=6),
    Column("X", "right", spare=1),
    Column("Y", "right", spare=1),
    Column("Z", "right", spare=2),
    Column("FIELDS", spare=5),
)


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb ``inspect``."""
    parser = add_verb(
        subparsers,
        "inspect",
        run,
        help="what point-cloud files hold",
        description="Read a point-cloud file to its end and show its fields, points, bounds and whatever "
        "is odd about it.  Of a directory (a map, or a folder of clouds): one line for each file, and "
        "totals.",
        output="cells.outputs.CloudFile cells.outputs.Directory",
        epilog=_EXIT,
    )
    parser.add_argument(
        "path",
        metavar="PATH",
        help="a PCD file, or .las .laz .ply .pts .xyz .xyzn .xyzrgb .txt .csv .asc, or a directory of files",
    )
    add_allow_empty(parser)
    add_json_option(parser)


def run(args: argparse.Namespace) -> int:
    """Print the description of a file or directory."""
    from shmmap.cli.verbs.cells import outputs

    if os.path.isdir(args.path):
        return _directory(args)
    found = _described(args.path)
    if args.json:
        print_json(outputs.CloudFile.of(found))
    else:
        print_pairs(_lines(found))
        print_line()
        print_table(
            (Column("FIELD"), Column("DTYPE"), Column("COUNT", "right"), Column("UNIT")),
            [
                [_field_name(field.name), field.dtype, str(field.count), field.unit]
                for field in outputs.CloudFile.of(found).fields
            ],
        )
    if outputs.Bounds.of(found) is None:
        what = f"none of its {found.points:,} points is finite" if found.points else "it has no points"
        return nothing_found(args, f"{args.path}: {what}")
    return 0


def _described(path: str) -> CloudDescription:
    from shmmap.formats.cloud import describe

    try:
        return describe(path)
    except MapDataError as error:
        if error.cause == "missing":
            raise MapMissing(error.message, hint=error.hint) from error
        raise


# --- a directory --------------------------------------------------------------------------------------


def _directory(args: argparse.Namespace) -> int:
    from shmmap.cli.verbs.cells import outputs
    from shmmap.dividing.inputs import find_inputs

    files = [file.path for file in find_inputs([args.path])]
    found: list[CloudDescription] = []
    failed: list[tuple[str, str]] = []
    progress = StageProgress(quiet=not sys.stderr.isatty(), unit="files", scale=1.0)
    progress.stage("inspect", len(files))
    for path in files:
        try:
            found.append(_described(path))
        except (MapDataError, MapMissing) as error:
            failed.append((path, error.message))
        progress.advance(1)
    progress.done(len(files))
    points, dropped = sum(one.points for one in found), sum(one.dropped for one in found)
    nbytes = sum(one.file_bytes for one in found)
    bounds = _all_bounds(found)
    served = _as_map(args.path, found)
    if args.json:
        failures = [outputs.UnreadFile(path, message) for path, message in failed]
        whole = outputs.Directory(
            args.path,
            list(map(outputs.CloudFile.of, found)),
            failures,
            points,
            dropped,
            nbytes,
            bounds,
            served,
        )
        print_json(whole)
    else:
        print_table(_FILES, [_row(one, os.path.abspath(args.path)) for one in found])
        print_line()
        print_pairs(
            [
                ("files", f"{len(found):,}" + (f", {len(failed):,} that cannot be read" if failed else "")),
                ("points", f"{points:,}" + (f", {dropped:,} left out" if dropped else "")),
                ("size", format_bytes(nbytes)),
                *_bounds_lines(bounds),
                *_grouped_warnings(found),
                *_map_lines(served),
            ]
        )
    for _, message in failed:
        complain("shmmap", message)
    if failed:
        return MapDataError.exit_code
    if bounds is None:
        return nothing_found(args, f"{args.path}: no finite point in {counted(len(found), 'file')}")
    return 0


def _as_map(path: str, found: list[CloudDescription]) -> outputs.ServedMap | None:
    """Compare files with the metadata of their divided map; None if they have none."""
    import numpy as np

    from shmmap.cli.verbs.cells import outputs
    from shmmap.layers.points import OutsideBox
    from shmmap.origin.map_directory import open_map
    from shmmap.origin.map_layout import absolute_path, find_layout
    from shmmap.origin.map_report import far_cells_notes

    try:
        if find_layout(absolute_path(path), None).metadata is None:
            return None
        catalogue = open_map(path).load(fresh=True)
    except (MapDataError, MapMissing) as error:
        return outputs.ServedMap(0, [], [], problems=[error.message])
    cells: list[tuple[CloudDescription, tuple[float, float, float, float]]] = []
    for one in found:
        index = catalogue.find(os.path.abspath(one.path))
        if index is not None:
            cells.append((one, catalogue.box(index)))
    outside = []
    for one, box in cells:
        corners = np.array(one.bounds)
        checked = OutsideBox(box)
        checked.add(corners, *corners.tolist())
        if checked.count:
            outside.append(outputs.Outside(one.path, box))
    far = far_cells_notes(
        np.array([box[:2] for _, box in cells]).reshape(-1, 2),
        max(catalogue.mean_size),
        [os.path.basename(one.path) for one, _ in cells],
        [one.points for one, _ in cells],
    )
    return outputs.ServedMap(
        len(catalogue),
        outside,
        far,
        catalogue.frame.origin,
        catalogue.frame.crs,
        catalogue.frame.unit_m,
        list(catalogue.problems),
    )


def _map_lines(served: outputs.ServedMap | None) -> list[tuple[str, str]]:
    if served is None:
        return []
    lines = [("map", counted(served.cells, "cell"))] if served.cells else []
    if served.crs:
        lines.append(("crs", served.crs))
    if any(served.origin):
        x, y, z = map(format_metres, served.origin)
        lines.append(("frame", f"add ({x}, {y}, {z}) m for the coordinates of the cloud it was divided from"))
    outside = served.outside_box
    for one in outside[:_NAMED_OUTSIDE]:
        min_x, min_y, max_x, max_y = one.box
        box = f"x {min_x:g} .. {max_x:g}, y {min_y:g} .. {max_y:g}"
        what = f"{os.path.basename(one.path)} has points outside its box {box}"
        lines.append(("outside", f"{what}: was it moved, and the metadata not?"))
    if len(outside) > _NAMED_OUTSIDE:
        lines.append(("outside", f"and {len(outside) - _NAMED_OUTSIDE:,} more cells"))
    return [*lines, *(("far", text) for text in served.far), *(("problem", t) for t in served.problems)]


def _row(found: CloudDescription, directory: str) -> list[str]:
    from shmmap.cli.verbs.cells import outputs

    bounds = outputs.Bounds.of(found)
    spans = ["-"] * 3
    if bounds is not None:
        low, high = ([format_metres(round(v, 1)) for v in side] for side in (bounds.min, bounds.max))
        spans = [f"{a} .. {b}" for a, b in zip(low, high, strict=True)]
    return [
        os.path.relpath(found.path, directory),
        " ".join(part for part in (found.format, found.encoding or found.version) if part),
        format_bytes(found.file_bytes),
        f"{found.points:,}",
        f"{found.dropped:,}",
        *spans,
        " ".join(_field_name(spec.name) for spec in found.columns),
    ]


def _field_name(name: str) -> str:
    return "x y z" if name == "xyz" else name


def _all_bounds(found: list[CloudDescription]) -> outputs.Bounds | None:
    from shmmap.cli.verbs.cells import outputs

    each = [bounds for one in found if (bounds := outputs.Bounds.of(one)) is not None]
    if not each:
        return None
    return outputs.Bounds(
        [min(values) for values in zip(*(one.min for one in each), strict=True)],
        [max(values) for values in zip(*(one.max for one in each), strict=True)],
    )


def _grouped_warnings(found: list[CloudDescription]) -> list[tuple[str, str]]:
    """Return each distinct warning once, with its file or the number of files that have it."""
    files: dict[str, list[str]] = {}
    for one in found:
        for warning in one.warnings:
            files.setdefault(warning, []).append(os.path.basename(one.path))
    return [
        ("warning", f"{names[0] if len(names) == 1 else f'{len(names):,} files'}: {warning}")
        for warning, names in files.items()
    ]


# --- one file -----------------------------------------------------------------------------------------


def _crs_lines(crs: CoordinateSystem | None) -> list[tuple[str, str]]:
    """Return the name and units of a file's coordinate system, without text that its warnings repeat."""
    if crs is None:
        return []
    from shmmap.formats.coordinate_system import units_text

    said = "x and y are in degrees" if crs.geographic else units_text(*crs.units)
    unsaid = "" if crs.geographic or crs.plane is not None else " (taken so: the file does not say)"
    return [*([("crs", crs.label)] if crs.label else []), ("units", said + unsaid)]


def _coordinate(value: float) -> str:
    return f"{value:.3f}" if abs(value) < 1e15 else f"{value:g}"


def _bounds_lines(bounds: outputs.Bounds | None, metric: bool = True) -> list[tuple[str, str]]:
    if bounds is None:
        return [("bounds", "none: no finite point")]
    unit = " m" if metric else ""
    return [
        (axis, f"{_coordinate(low)} .. {_coordinate(high)}{unit} ({_coordinate(high - low)}{unit})")
        for axis, low, high in zip("xyz", bounds.min, bounds.max, strict=True)
    ]


def _lines(found: CloudDescription) -> list[tuple[str, str]]:
    from shmmap.cli.verbs.cells import outputs
    from shmmap.formats.coordinate_system import unit_warnings

    kind = " ".join(part for part in (found.format.upper(), found.version, found.encoding) if part)
    lines = [
        ("file", f"{found.path} ({format_bytes(found.file_bytes)}, {kind})"),
        ("points", f"{found.points:,}" + (f", {found.dropped:,} left out" if found.dropped else "")),
    ]
    if found.height > 1:
        lines.append(("organised", f"{found.width} x {found.height}"))
    lines += _bounds_lines(outputs.Bounds.of(found), metric=not unit_warnings(found.crs))
    lines += _crs_lines(found.crs)
    if tuple(found.viewpoint) != (0, 0, 0, 1, 0, 0, 0):
        lines.append(("viewpoint", " ".join(f"{value:g}" for value in found.viewpoint)))
    lines += [("warning", warning) for warning in found.warnings]
    return lines
