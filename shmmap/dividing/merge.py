# SPDX-License-Identifier: Apache-2.0
"""Merge divided maps and clouds into one PCD file: the inverse of dividing."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import IO, Final

import numpy as np

from shmmap.dividing.cell_files import pcd_fields
from shmmap.dividing.frame import choose_units
from shmmap.dividing.inputs import InputFile, check_output_place, check_space, check_unchanged, find_inputs
from shmmap.dividing.settings import memory_left
from shmmap.dividing.sources import (
    NO_MOVE,
    RowLayout,
    Source,
    common_rows,
    field_types,
    open_source,
    with_axes,
)
from shmmap.errors import BadRequest, MapDataError
from shmmap.formats.durable_file import appearing_file, writing_errors
from shmmap.formats.pcd.writer import pcd_header, pcd_rows
from shmmap.formats.point_checks import LasChecks
from shmmap.origin.map_report import REPORT_NAME, UNKNOWN_FRAME, frame_of, read_report
from shmmap.progress import NoProgress, Progress

MERGED_ENCODINGS: Final = ("binary", "ascii")
"""Encodings that can be written without all points in memory."""

_BLOCK_BYTES: Final = 16 << 20
_MEMORY_BYTES: Final = 1 << 30
_Move = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class MergedCloud:
    """Result of `merge`; ``origin`` is the offset added to the points of each map that has one.

    ``notes`` are remarks about the inputs for the user.
    """

    path: str
    points: int
    bytes: int
    files: int
    fields: list[tuple[str, str]]
    origin: dict[str, list[float]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


def merge(
    inputs: Sequence[str | os.PathLike[str]],
    out_file: str | os.PathLike[str],
    *,
    encoding: str = "binary",
    keep_frame: bool = False,
    common_fields: bool = False,
    force: bool = False,
    progress: Progress | None = None,
) -> MergedCloud:
    """Write all points of ``inputs`` to one PCD file, which appears complete or not at all.

    Points of a map that `divide` moved are moved back, in float64, unless ``keep_frame``; all other values
    keep their bits.  Points of LAS that are flagged withheld are left out.  Points are in the order of their
    files, and files in the order of their paths.

    Parameters
    ----------
    inputs
        Divided maps, directories of clouds, and clouds in any supported format.
    out_file
        A name that ends in .pcd; ``force`` replaces an existing file.
    encoding
        One of `MERGED_ENCODINGS`.
    common_fields
        Keep only the common fields if the inputs' fields differ.

    Raises
    ------
    BadRequest, MapMissing, MapDataError, CannotWrite
        As `divide`.
    """
    progress = progress or NoProgress()
    out = os.path.abspath(out_file)
    _check_output(out, encoding, force=force)
    with contextlib.ExitStack() as stack:
        names = [os.fspath(path) for path in inputs]
        moves = {path: NO_MOVE if keep_frame else _origin_of(path) for path in names}
        opened: list[tuple[InputFile, Source, _Move]] = []
        for path in names:
            files = find_inputs([path])
            check_output_place([path], files, out)
            for file in files:
                source = open_source(
                    file.path, memory_bytes=memory_left(_MEMORY_BYTES) // 2, scratch_dir=os.path.dirname(out)
                )
                stack.callback(source.close)
                _check_metres(source)
                opened.append((file, source, moves[path]))
        if not opened:
            raise BadRequest("nothing to merge")
        sources = [source for _, source, _ in opened]
        origins = {os.path.abspath(path): list(move) for path, move in moves.items() if move != NO_MOVE}
        row = common_rows(
            [source.row for source in sources], [source.path for source in sources], common_only=common_fields
        )
        if origins:
            row = with_axes(row, np.dtype("<f8"))
        points = sum(source.points for source in sources)
        if not points:
            raise MapDataError("there is no point in any of the inputs", cause="no_points")
        header = pcd_header(pcd_fields(row), points, encoding)
        stack.enter_context(writing_errors(out))
        check_space(out, len(header) + points * row.itemsize, os.path.dirname(out))
        progress.stage("merging", points)
        with appearing_file(out) as target:
            target.write(header)
            written = 0
            for _, source, move in opened:
                written += _append(target, source, RowLayout(row, move), encoding, progress)
            if not written:
                raise MapDataError("all points of the inputs are left out", cause="no_points")
            if written < points:
                target.seek(0)
                target.write(pcd_header(pcd_fields(row), written, encoding, header_bytes=len(header)))
            check_unchanged([file for file, _, _ in opened])
        progress.done(points)
        notes = [
            f"{source.path}: {note}"
            for source in sources
            for note in (*source.warnings, *source.checks.notes())
        ]
    return MergedCloud(
        path=out,
        points=written,
        bytes=os.stat(out).st_size,
        files=len(sources),
        fields=field_types(row),
        origin=origins,
        notes=notes,
    )


def _check_output(out: str, encoding: str, *, force: bool) -> None:
    if not out.lower().endswith(".pcd"):
        raise BadRequest(f"{out} does not end in .pcd", hint="the merged cloud is a PCD file")
    if encoding not in MERGED_ENCODINGS:
        raise BadRequest(f"encoding {encoding!r} is not one of {', '.join(MERGED_ENCODINGS)}")
    if os.path.isdir(out) or (os.path.lexists(out) and not force):
        raise BadRequest(f"{out} exists", hint="--force replaces a file")


def _origin_of(path: str) -> _Move:
    """Return the offset to add to an input's points: the origin of a divided map, else zero."""
    report = read_report(path) if os.path.isdir(path) else None
    if report is None:
        return NO_MOVE
    if (frame := frame_of(report)) is UNKNOWN_FRAME:
        raise MapDataError(
            f"the origin in its {REPORT_NAME} is none",
            path=path,
            hint="--keep-frame leaves points as they are",
        )
    return frame.origin


def _check_metres(source: Source) -> None:
    """Refuse coordinates in another unit, which a PCD file cannot declare."""
    try:
        choose_units([source], "", "")
    except MapDataError as error:
        if error.cause == "not_metres":
            error.hint = "`shmmap divide --unit` converts them or says what they are; merge the map it makes"
        raise


def _append(file: IO[bytes], source: Source, layout: RowLayout, encoding: str, progress: Progress) -> int:
    """Append the points of a source, and return their number without those that LAS marks to leave out."""
    rows = np.empty(max(1, min(source.points, _BLOCK_BYTES // layout.row.itemsize)), layout.row)
    source.begin(layout, 0)
    left, written = source.points, 0
    while left:
        count = source.read(rows[:left])
        kept = rows[:count]
        if isinstance(source.checks, LasChecks):
            kept = kept[~np.isnan(kept["x"])]
        file.write(pcd_rows(kept, encoding))
        written += len(kept)
        left -= count
        progress.advance(count)
    source.close()  # a map has more cells than a process may have open files
    return written
