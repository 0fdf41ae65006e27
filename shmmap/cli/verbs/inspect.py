# SPDX-License-Identifier: Apache-2.0
"""``shmmap inspect FILE``: what a point-cloud file holds."""

from __future__ import annotations

import argparse
import math
from typing import TYPE_CHECKING

from shmmap.cli.options import Subparsers, add_json_option, add_verb
from shmmap.cli.screens.output import Column, format_bytes, print_json, print_pairs, print_table
from shmmap.errors import MapDataError, MapMissing

if TYPE_CHECKING:
    from shmmap.formats.cloud import CloudDescription

__all__ = ["add_parser", "run"]

_JSON = """\
  {"path", "format", "encoding": of a PCD file, "version", "file_bytes", "points": points in the file,
   "dropped": how many of them are not finite, "width", "height",
   "fields": [{"name", "dtype": as numpy writes it, "count": values per point, "unit"}],
   "bounds": {"min": [x, y, z], "max": [x, y, z]} of the finite points, null when there are none,
   "viewpoint": [x, y, z, qw, qx, qy, qz], "warnings": [text]}
Exit code: 0, 65 bad data (the message has path, byte offset and cause), 66 no such file."""


def add_parser(subparsers: Subparsers) -> None:
    """Describe the verb."""
    parser = add_verb(
        subparsers,
        "inspect",
        run,
        help="what a point-cloud file holds",
        description="Read a point-cloud file to its end and show its fields, points, bounds and oddities.",
        json=_JSON,
    )
    parser.add_argument("file", metavar="FILE", help="a PCD file, or .las .laz .ply .pts .xyz .xyzn .xyzrgb")
    add_json_option(parser)


def run(args: argparse.Namespace) -> int:
    """Print what the file holds."""
    from shmmap.formats.cloud import describe

    try:
        found = describe(args.file)
    except MapDataError as error:
        if error.cause == "missing":
            raise MapMissing(error.message, hint=error.hint) from error
        raise
    if args.json:
        print_json(_as_json(found))
        return 0
    print_pairs(_lines(found))
    print()
    print_table(
        (Column("FIELD"), Column("DTYPE"), Column("COUNT", "right"), Column("UNIT")),
        [[spec.name, spec.dtype.str, str(spec.components), spec.unit] for spec in found.columns],
    )
    return 0


def _bounds(found: CloudDescription) -> dict[str, list[float]] | None:
    lowest, highest = (bound.tolist() for bound in found.bounds)
    return {"min": lowest, "max": highest} if all(map(math.isfinite, lowest)) else None


def _as_json(found: CloudDescription) -> dict[str, object]:
    return {
        "path": found.path,
        "format": found.format,
        "encoding": found.encoding,
        "version": found.version,
        "file_bytes": found.file_bytes,
        "points": found.points,
        "dropped": found.dropped,
        "width": found.width,
        "height": found.height,
        "fields": [
            {"name": spec.name, "dtype": spec.dtype.str, "count": spec.components, "unit": spec.unit}
            for spec in found.columns
        ],
        "bounds": _bounds(found),
        "viewpoint": list(found.viewpoint),
        "warnings": list(found.warnings),
    }


def _lines(found: CloudDescription) -> list[tuple[str, str]]:
    bounds = _bounds(found)
    kind = " ".join(part for part in (found.format.upper(), found.version, found.encoding) if part)
    lines = [
        ("file", f"{found.path} ({format_bytes(found.file_bytes)}, {kind})"),
        ("points", f"{found.points:,}" + (f", {found.dropped:,} not finite" if found.dropped else "")),
    ]
    if found.height > 1:
        lines.append(("organised", f"{found.width} x {found.height}"))
    if bounds is None:
        lines.append(("bounds", "none: no finite point"))
    else:
        for axis, low, high in zip("xyz", bounds["min"], bounds["max"], strict=True):
            lines.append((axis, f"{low:.3f} .. {high:.3f} m ({high - low:.3f} m)"))
    if tuple(found.viewpoint) != (0, 0, 0, 1, 0, 0, 0):
        lines.append(("viewpoint", " ".join(f"{value:g}" for value in found.viewpoint)))
    lines += [("warning", warning) for warning in found.warnings]
    return lines
