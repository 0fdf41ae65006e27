# SPDX-License-Identifier: Apache-2.0
"""Divides clouds of any size into a map of square cells, in bounded memory."""

from __future__ import annotations

import contextlib
import json
import math
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from shmmap.dividing.cell_files import CellFiles, raise_open_files_limit
from shmmap.dividing.cell_order import ORDERS
from shmmap.dividing.check import check_cells
from shmmap.dividing.finishing import thin_out, write_ordered
from shmmap.dividing.frame import Translation, choose_frame
from shmmap.dividing.inputs import (
    REPORT_NAME,
    InputFile,
    check_output_directory,
    check_output_place,
    find_inputs,
)
from shmmap.dividing.lattice import CellLattice
from shmmap.dividing.memory import MIN_MEMORY_BYTES, memory_left
from shmmap.dividing.partition import Partition, block_points_for, worker_count
from shmmap.dividing.progress import NoProgress, Progress
from shmmap.dividing.row_layout import AXES, RowLayout, common_rows
from shmmap.dividing.sources import Source, open_source
from shmmap.dividing.stream import Stream
from shmmap.dividing.workspace import Workspace, writing_errors
from shmmap.errors import BadRequest, CannotWrite, MapDataError
from shmmap.formats.pcd_header import ENCODINGS
from shmmap.origin.metadata_text import METADATA_NAME, metadata_text

__all__ = ["DivideSettings", "DividedMap", "divide", "read_report"]

_CELLS: Final = "pointcloud_map.pcd"
_FORMAT: Final = "shmmap divided map"
_VERSION: Final = 1


@dataclass(frozen=True, slots=True)
class DivideSettings:
    """How to divide.

    Attributes
    ----------
    cell_size
        Side of a cell, metres, at most 9 decimals.
    origin
        A corner of the lattice of cells, metres, in the frame of the inputs.
    translate
        Added to every point, or ``auto``, or ``none``; see `shmmap.dividing.frame`.
    leaf
        Side of the voxels whose points become one, metres; 0 keeps every point.
    prefix
        Start of every file name.
    encoding
        Of the PCD files: ``binary``, ``binary_compressed`` or ``ascii``.
    order
        Of the points in a cell: ``input`` or ``morton``; see `shmmap.dividing.cell_order`.
    memory_bytes
        Most memory that the process may take, code and libraries included.
    common_fields
        Keep only what all inputs have, where their fields differ.
    force
        Replace a divided map that is there.
    resume
        Go on where a killed run with the same inputs and settings stopped.
    check
        Read everything back and prove that each point is in its cell, before the map appears.
    durable
        Force the map to the disk before it appears.
    checkpoint_s
        How often the state to resume from is saved.
    """

    cell_size: float = 20.0
    origin: tuple[float, float] = (0.0, 0.0)
    translate: Translation = "auto"
    leaf: float = 0.0
    prefix: str = ""
    encoding: str = "binary"
    order: str = "input"
    memory_bytes: int = 1 << 30
    common_fields: bool = False
    force: bool = False
    resume: bool = False
    check: bool = False
    durable: bool = True
    checkpoint_s: float = 5.0


@dataclass(frozen=True, slots=True)
class DividedMap:
    """What was made; also kept in the map as ``shmmap_divide.json``.

    Attributes
    ----------
    path
        The map directory.
    cells, points
        Files, and points in them.
    points_read, dropped
        Points in the inputs, and how many were not finite.
    origin
        Where the map's frame lies in that of the inputs: add it to a point to come back, metres.
    cell_size, leaf, order, encoding
        As in `DivideSettings`.
    fields
        Names and dtypes of what each point has.
    bounds
        Least and greatest coordinates in the map; None for an empty one.
    sources
        The inputs: path, bytes, mtime_ns, points.
    notes
        What a person should know.
    resumed_points
        Points that an earlier, killed run had divided.
    """

    path: str
    cells: int
    points: int
    points_read: int
    dropped: int
    origin: tuple[float, float, float]
    cell_size: float
    leaf: float
    order: str
    encoding: str
    fields: list[tuple[str, str]]
    bounds: list[list[float]] | None
    sources: list[dict[str, Any]]
    notes: list[str] = field(default_factory=list)
    resumed_points: int = 0


def divide(
    inputs: Sequence[str | os.PathLike[str]],
    out_dir: str | os.PathLike[str],
    settings: DivideSettings | None = None,
    *,
    progress: Progress | None = None,
) -> DividedMap:
    """Divide clouds into the map ``out_dir``, which appears complete or not at all.

    Parameters
    ----------
    inputs
        Files, or directories of files, of any format that is read; all together become one map.
    out_dir
        The map directory: ``pointcloud_map.pcd/<prefix>_<x>_<y>.pcd`` and the metadata for Autoware.

    Raises
    ------
    BadRequest, MapMissing
        A setting makes no sense, an input is not there, or the output may not lie there.
    MapDataError
        An input is not what it claims to be.
    CannotWrite
        The disk is full or not writable.
    InstanceBusy
        Another run is making the same map.
    """
    settings = settings or DivideSettings()
    progress = progress or NoProgress()
    out = os.path.abspath(out_dir)
    lattice = _check_settings(settings)
    names = [os.fspath(path) for path in inputs]
    files = find_inputs(names)
    if not files:
        raise BadRequest("nothing to divide")
    check_output_place(names, files, out)
    check_output_directory(out, force=settings.force)
    raise_open_files_limit()
    with contextlib.ExitStack() as stack:
        space = stack.enter_context(Workspace(out))
        # from here on an error of the system is about writing: sources turn theirs into MapDataError
        stack.enter_context(writing_errors(out))
        return _Run(space, files, settings, lattice, progress, stack).run()


def read_report(map_dir: str | os.PathLike[str]) -> dict[str, Any] | None:
    """Return what `divide` left about a map, or None for a map made by others."""
    try:
        report = json.loads(Path(map_dir, REPORT_NAME).read_bytes())
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise MapDataError(f"cannot be read: {error}", path=str(Path(map_dir, REPORT_NAME))) from error
    if not isinstance(report, dict) or report.get("format") != _FORMAT or report.get("version") != _VERSION:
        raise MapDataError("not made by this version", path=str(Path(map_dir, REPORT_NAME)))
    return report


class _Run:
    """One run of `divide`, from its first look at the inputs to the map's appearance."""

    def __init__(
        self,
        space: Workspace,
        files: list[InputFile],
        settings: DivideSettings,
        lattice: CellLattice,
        progress: Progress,
        stack: contextlib.ExitStack,
    ) -> None:
        self._space = space
        self._settings = settings
        self._progress = progress
        self._files = files
        self._state = space.state() if settings.resume else None
        if self._state is None:
            space.empty()
        room = memory_left(settings.memory_bytes)
        self._sources: list[Source] = []
        for file in files:
            source = open_source(file.path, memory_bytes=room // 2, scratch_dir=space.path)
            stack.callback(source.close)
            self._sources.append(source)
        row = common_rows(
            [source.row for source in self._sources],
            [source.path for source in self._sources],
            common_only=settings.common_fields,
        )
        progress.stage("looking at coordinates", 0)
        self._frame = choose_frame(self._sources, row, lattice, settings.translate)
        self._row = np.dtype(
            [(name, self._frame.axis if name in AXES else row[name]) for name in row.names or ()]
        )
        origin_x, origin_y, _ = self._frame.origin
        self._lattice = lattice.moved(origin_x, origin_y)
        self._points = sum(source.points for source in self._sources)

    def run(self) -> DividedMap:
        settings, space = self._settings, self._space
        self._check_space()
        final = space.directory("map/" + _CELLS)
        if settings.leaf:
            self._buckets = self._bucket_lattice()
            stage = CellFiles(space.directory("buckets"), self._row, lambda x, y: f"{x}_{y}")
        elif settings.order != "input" or settings.encoding != "binary":
            self._buckets = self._lattice
            stage = CellFiles(space.directory("buckets"), self._row, self._name)
        else:
            self._buckets = self._lattice
            stage = CellFiles(final, self._row, self._name)
        stream = self._read_into(stage)
        self._frame.check(stream.extremes)
        if not stream.kept:
            raise MapDataError(
                "no finite point in it" if len(self._files) == 1 else "no finite point in any of them",
                path=self._files[0].path if len(self._files) == 1 else "",
                cause="no_points",
            )
        cells = self._finish(stage, final)
        points = sum(cells.counts.values())
        report = self._report(stream, cells)
        self._write_texts(cells, report)
        if settings.check:
            check_cells(final, cells.counts, self._name, self._lattice, self._row, self._progress)
        self._progress.stage("forcing to the disk" if settings.durable else "publishing", 0)
        check_output_directory(space.out, force=settings.force)
        space.publish(replace=settings.force, durable=settings.durable)
        self._progress.done(points)
        return report

    # --- parts ----------------------------------------------------------------------------------

    def _read_into(self, files: CellFiles) -> Stream:
        settings = self._settings
        threads = worker_count()
        room = memory_left(settings.memory_bytes)
        stream = Stream(self._sources, RowLayout(self._row, self._frame.move))
        job = self._job()
        if self._state is not None and self._state.get("job") == job:
            stream.restore(self._state)
            files.restore((ix, iy, rows) for ix, iy, rows in self._state["cells"])
        elif self._state is not None:
            self._space.empty()
            os.makedirs(files.directory, exist_ok=True)
        self.resumed = stream.position
        points = block_points_for(room, self._row.itemsize, threads)
        points = max(1, min(points, -(-self._points // (2 * threads)) or 1))
        with Partition(files, self._buckets, block_points=points, threads=threads) as partition:
            stream.run(
                partition,
                self._progress,
                save=lambda state: self._space.save(
                    {
                        **state,
                        "job": job,
                        "cells": [(ix, iy, rows) for (ix, iy), rows in files.counts.items()],
                    }
                ),
                every_s=settings.checkpoint_s,
            )
        return stream

    def _finish(self, stage: CellFiles, final: str) -> CellFiles:
        settings = self._settings
        room = memory_left(settings.memory_bytes)
        if settings.leaf:
            later = settings.order != "input" or settings.encoding != "binary"
            thinned = self._space.directory("thinned") if later else final
            _empty_directory(thinned)
            cells = CellFiles(thinned, self._row, self._name)
            stage.close()
            voxels = CellLattice.of(settings.leaf, self._settings.origin).moved(*self._frame.origin[:2])
            thin_out(stage, cells, voxels, self._lattice, room, self._progress)
            stage = cells
        if settings.order != "input" or settings.encoding != "binary":
            _empty_directory(final)
            stage.close()
            return write_ordered(
                stage, final, self._lattice, settings.order, settings.encoding, room, self._progress
            )
        stage.finish()
        return stage

    def _bucket_lattice(self) -> CellLattice:
        """Squares of whole voxels, about as large as a cell, so that no voxel is cut by a border."""
        leaf = CellLattice.of(self._settings.leaf, self._settings.origin)
        voxels = max(1, round(self._settings.cell_size / self._settings.leaf))
        bucket = CellLattice(leaf.step * voxels, leaf.origin_x, leaf.origin_y, leaf.scale)
        return bucket.moved(*self._frame.origin[:2])

    def _name(self, ix: int, iy: int) -> str:
        x, y = self._lattice.corner_text(ix, iy)
        return f"{self._settings.prefix}_{x}_{y}.pcd"

    def _job(self) -> dict[str, Any]:
        """What must be the same for a run to be resumed; as JSON would give it back."""
        settings = self._settings
        job = {
            "files": [asdict(file) for file in self._files],
            "row": self._row.descr,
            "frame": self._frame.move,
            "lattice": asdict(self._lattice),
            "buckets": asdict(self._buckets),
            "prefix": settings.prefix,
            "staged": bool(settings.leaf or settings.order != "input" or settings.encoding != "binary"),
        }
        loaded: dict[str, Any] = json.loads(json.dumps(job))
        return loaded

    def _check_space(self) -> None:
        """Refuse what cannot fit, before anything is read."""
        needed = self._points * self._row.itemsize
        if self._settings.order != "input" or self._settings.encoding != "binary":
            needed *= 2  # cells as they were read, and in their final form
        have = os.statvfs(self._space.path)
        free = have.f_bavail * have.f_frsize
        if self._state is not None:
            return  # much of it is there already
        if needed > free:
            raise CannotWrite(
                f"the map needs about {needed >> 20} MiB in {os.path.dirname(self._space.out)}, "
                f"{free >> 20} MiB are free",
                hint="free some space, or choose another disk",
            )

    def _report(self, stream: Stream, cells: CellFiles) -> DividedMap:
        notes = [*self._frame.notes]
        for source in self._sources:
            notes += [f"{source.path}: {warning}" for warning in source.warnings]
        if not self._lattice.whole:
            notes.append(
                "cells have fractional corners: Autoware's loader, which reads whole metres, refuses them"
            )
        settings = self._settings
        bounds = stream.extremes.tolist() if stream.kept else None
        return DividedMap(
            path=self._space.out,
            cells=len(cells.counts),
            points=sum(cells.counts.values()),
            points_read=self._points,
            dropped=stream.dropped,
            origin=self._frame.origin,
            cell_size=settings.cell_size,
            leaf=settings.leaf,
            order=settings.order,
            encoding=settings.encoding,
            fields=[(name, self._row[name].str) for name in self._row.names or ()],
            bounds=bounds,
            sources=[
                {**asdict(file), "points": source.points}
                for file, source in zip(self._files, self._sources, strict=True)
            ],
            notes=notes,
            resumed_points=self.resumed,
        )

    def _write_texts(self, cells: CellFiles, report: DividedMap) -> None:
        entries = ((self._name(*where), self._lattice.corner_text(*where)) for where in cells.counts)
        text = metadata_text(self._lattice.size_text, entries)
        Path(self._space.content, METADATA_NAME).write_text(text, encoding="utf-8")
        content = {"format": _FORMAT, "version": _VERSION, **asdict(report)}
        Path(self._space.content, REPORT_NAME).write_text(
            json.dumps(content, indent=1, ensure_ascii=False) + "\n", encoding="utf-8"
        )


def _check_settings(settings: DivideSettings) -> CellLattice:
    lattice = CellLattice.of(settings.cell_size, settings.origin)
    if settings.leaf:
        CellLattice.of(settings.leaf, settings.origin)
        if settings.leaf > settings.cell_size:
            raise BadRequest(f"voxels of {settings.leaf} m are larger than cells of {settings.cell_size} m")
    if "/" in settings.prefix or not settings.prefix.isprintable():
        raise BadRequest(f"{settings.prefix!r} cannot start a file name")
    choices = (("encoding", settings.encoding, ENCODINGS), ("order", settings.order, ORDERS))
    for name, value, allowed in choices:
        if value not in allowed:
            raise BadRequest(f"{name} {value!r} is not one of {', '.join(allowed)}")
    if isinstance(settings.translate, tuple) and not all(map(math.isfinite, settings.translate)):
        raise BadRequest("a translation is three numbers of metres")
    if settings.memory_bytes < MIN_MEMORY_BYTES:
        raise BadRequest(
            f"{settings.memory_bytes >> 20} MiB of memory are too little",
            hint=f"at least {MIN_MEMORY_BYTES >> 20}M: code and libraries are counted",
        )
    return lattice


def _empty_directory(path: str) -> None:
    for name in os.listdir(path):
        os.unlink(os.path.join(path, name))
