# SPDX-License-Identifier: Apache-2.0
"""Divide clouds of any size into a map of square cells, in bounded memory."""

from __future__ import annotations

import contextlib
import json
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap.dividing.cell_files import CellFiles, raise_open_files_limit, write_metadata
from shmmap.dividing.finishing import thin_out, write_encoded
from shmmap.dividing.frame import choose_frame, choose_units
from shmmap.dividing.inputs import (
    InputFile,
    check_output_directory,
    check_output_place,
    check_space,
    check_unchanged,
    find_inputs,
)
from shmmap.dividing.lattice import CellLattice
from shmmap.dividing.partition import Partition, block_points_for, worker_count
from shmmap.dividing.settings import DivideSettings, lattice_of, memory_left
from shmmap.dividing.sources import RowLayout, Source, common_rows, field_types, open_source, with_axes
from shmmap.dividing.workspace import Workspace
from shmmap.errors import BadRequest, MapDataError
from shmmap.formats.coordinate_system import GEOGRAPHIC_SYSTEM, degrees_warning
from shmmap.formats.durable_file import writing_errors
from shmmap.formats.pcd.reader import PcdReader
from shmmap.formats.point_checks import LasChecks, step_warning
from shmmap.formats.source_file import refusal
from shmmap.origin.map_report import DividedMap, far_cells_notes, write_report
from shmmap.progress import NoProgress, Progress

_CELLS: Final = "pointcloud_map.pcd"
_JOURNAL: Final = "pieces"


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
        Files in any supported format, or directories of them; together they become one map.
    out_dir
        The map directory: ``pointcloud_map.pcd/<prefix>_<x>_<y>.pcd`` and the metadata for Autoware.

    Raises
    ------
    BadRequest, MapMissing
        A setting is invalid, an input is missing, or the output's place is not allowed.
    MapDataError
        An input contradicts its header or format.
    CannotWrite
        The disk is full or not writable.
    InstanceBusy
        Another run is making the same map.
    """
    settings = settings or DivideSettings()
    progress = progress or NoProgress()
    out = os.path.abspath(out_dir)
    lattice = lattice_of(settings)
    names = [os.fspath(path) for path in inputs]
    files = find_inputs(names)
    if not files:
        raise BadRequest("nothing to divide")
    check_output_place(names, files, out)
    check_output_directory(out, force=settings.force)
    raise_open_files_limit()
    with contextlib.ExitStack() as stack:
        # sources convert OSErrors of reading to MapDataError, so the rest are about writing
        stack.enter_context(writing_errors(out))
        space = stack.enter_context(Workspace(out))
        return _Run(space, files, settings, lattice, progress, stack).run()


class _Run:
    """One run of `divide`, from opening the inputs to publishing the map."""

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
        self._stack = stack
        self._state = space.state() if settings.resume else None
        if self._state is None:
            space.empty()
        room = memory_left(settings.memory_bytes)
        self._sources: list[Source] = []
        for file in files:
            source = open_source(
                file.path,
                memory_bytes=room // 2,
                scratch_dir=space.path,
                drop_noise=settings.drop_noise,
            )
            stack.callback(source.close)
            self._sources.append(source)
        self._units = choose_units(self._sources, settings.unit, settings.vertical_unit)
        for source, scale in zip(self._sources, self._units.scales, strict=True):
            source.scale = scale
        row = common_rows(
            [source.row for source in self._sources],
            [source.path for source in self._sources],
            common_only=settings.common_fields,
            wanted=settings.fields,
        )
        progress.stage("looking at coordinates", 0)
        self._frame = choose_frame(self._sources, row, lattice, settings.translate, settings.frame_before)
        self._row = with_axes(row, self._frame.axis)
        origin_x, origin_y, _ = self._frame.origin
        self._lattice = lattice.moved(origin_x, origin_y)
        self._is_encoded = settings.encoding != "binary"
        self._points = sum(source.points for source in self._sources)

    def run(self) -> DividedMap:
        """Divide and publish the map; return what was made."""
        settings, space = self._settings, self._space
        if self._state is None:  # a resumed run has already written much of it
            needed = self._points * self._row.itemsize
            if self._is_encoded:
                needed *= 2  # cells as they were read, and in their final encoding
            check_space("the map", needed, space.path, place=f" in {os.path.dirname(space.out)}")
        final = space.directory("map/" + _CELLS)
        space.clear("map", but=(_CELLS,))
        self._buckets = self._bucket_lattice() if settings.leaf else self._lattice
        stage = self._cell_files(
            space.directory("buckets") if settings.leaf or self._is_encoded else final,
            (lambda x, y: f"{x}_{y}") if settings.leaf else self._name,
            journal=os.path.join(space.path, _JOURNAL),
        )
        read = self._read_into(stage)
        check_unchanged(self._files)
        self._frame.check(read.extremes)
        if not read.kept:
            alone = len(self._files) == 1
            raise MapDataError(
                f"no finite point in {'it' if alone else 'any of them'}",
                path=self._files[0].path if alone else "",
                cause="no_points",
            )
        cells = self._finish(stage, final)
        report = self._report(read, cells)
        write_metadata(space.content, self._lattice, settings.prefix, cells.counts)
        write_report(space.content, report)
        if settings.check:
            _check_cells(final, cells.counts, self._name, self._lattice, self._row, self._progress)
        self._progress.stage("forcing to the disk" if settings.durable else "publishing", 0)
        check_output_directory(space.out, force=settings.force)
        space.publish(replace=settings.force, durable=settings.durable)
        self._progress.done(report.points)
        return report

    # --- parts ----------------------------------------------------------------------------------

    def _cell_files(self, directory: str, name: Callable[[int, int], str], journal: str = "") -> CellFiles:
        """Return cell files that are closed when the run ends in any way."""
        files = CellFiles(directory, self._row, name, journal=journal)
        self._stack.callback(files.close)
        return files

    def _read_into(self, files: CellFiles) -> Partition:
        """Read all sources into the files of cells, or what an interrupted run has left of them."""
        settings, threads = self._settings, worker_count()
        points = block_points_for(memory_left(settings.memory_bytes), self._row.itemsize, threads)
        points = max(1, min(points, -(-self._points // (2 * threads)) or 1))
        job = self._job()
        with Partition(files, self._buckets, block_points=points, threads=threads) as partition:
            self.resumed = self._restore(job, files, partition)

            def save(position: int) -> None:
                partition.drain()
                state = {
                    "job": job,
                    "noted_bytes": files.noted_bytes(),
                    "cells": [(ix, iy, rows) for (ix, iy), rows in files.counts.items()],
                    "position": position,
                    "kept": partition.kept,
                    "dropped": partition.dropped,
                    "extremes": partition.extremes.tolist(),
                    "checks": [source.checks.counts for source in self._sources],
                }
                self._space.save(state)

            self._read(partition, save)
            partition.drain()
        return partition

    def _restore(self, job: dict[str, Any], files: CellFiles, partition: Partition) -> int:
        """Return to the saved state of an interrupted run; return the number of points that it has read.

        0 if there is none, or it is of another job or does not match the files.
        """
        state = self._state
        if state is None:
            return 0
        if state.get("job") == job:
            with contextlib.suppress(OSError, LookupError, TypeError, ValueError):
                files.restore(((ix, iy, rows) for ix, iy, rows in state["cells"]), state["noted_bytes"])
                partition.kept, partition.dropped = state["kept"], state["dropped"]
                partition.extremes = np.array(state["extremes"])
                for source, counts in zip(self._sources, state["checks"], strict=True):
                    source.checks.counts = counts
                return int(state["position"])
        files.forget()
        self._space.clear("map/" + _CELLS)
        self._space.clear(files.directory)
        return 0

    def _read(self, partition: Partition, save: Callable[[int], None]) -> None:
        """Read the sources into a partition, from the resumed point on; save the position now and then."""
        self._progress.stage("dividing", self._points)
        self._progress.advance(self.resumed)
        position = skip = self.resumed
        saved_s = time.monotonic()
        for source in self._sources:
            if skip >= source.points:
                skip -= source.points
                continue
            source.begin(RowLayout(self._row, self._frame.move, source.scale), skip)
            left = source.points - skip
            skip = 0
            while left:
                if time.monotonic() - saved_s >= self._settings.checkpoint_s:
                    save(position)
                    saved_s = time.monotonic()
                buffer = partition.buffer()
                count = source.read(buffer[:left])
                if not count:
                    points = source.points
                    raise refusal(
                        "truncated", f"{points} points announced, {points - left} are there", path=source.path
                    )
                partition.submit(buffer, count)
                position += count
                left -= count
                self._progress.advance(count)
            source.close()

    def _finish(self, stage: CellFiles, final: str) -> CellFiles:
        settings = self._settings
        room = memory_left(settings.memory_bytes)
        if settings.leaf:
            thinned = self._space.directory("thinned") if self._is_encoded else final
            self._space.clear(thinned)
            cells = self._cell_files(thinned, self._name)
            stage.close()
            voxels = CellLattice.of(settings.leaf, settings.origin).moved(*self._frame.origin[:2])
            thin_out(stage, cells, voxels, self._lattice, room, self._progress)
            stage = cells
        if self._is_encoded:
            self._space.clear(final)
            stage.close()
            return write_encoded(stage, final, settings.encoding, room, self._progress)
        stage.finish()
        return stage

    def _bucket_lattice(self) -> CellLattice:
        """Return squares about as large as a cell, made of whole voxels, so that no border cuts a voxel."""
        leaf = CellLattice.of(self._settings.leaf, self._settings.origin)
        voxels = max(1, round(self._settings.cell_size / self._settings.leaf))
        bucket = CellLattice(leaf.step * voxels, leaf.origin_x, leaf.origin_y, leaf.scale)
        return bucket.moved(*self._frame.origin[:2])

    def _name(self, ix: int, iy: int) -> str:
        return self._lattice.file_name(self._settings.prefix, ix, iy)

    def _job(self) -> dict[str, Any]:
        """Return all that must be equal for a run to be resumed, in the form that JSON restores."""
        settings = self._settings
        job = {
            "files": [asdict(file) for file in self._files],
            "row": self._row.descr,
            "frame": self._frame.move,
            "scales": self._units.scales,
            "lattice": asdict(self._lattice),
            "buckets": asdict(self._buckets),
            "prefix": settings.prefix,
            "drop_noise": settings.drop_noise,
            "staged": bool(settings.leaf or self._is_encoded),
        }
        loaded: dict[str, Any] = json.loads(json.dumps(job))
        return loaded

    def _report(self, read: Partition, cells: CellFiles) -> DividedMap:
        notes = [*self._units.notes, *self._frame.notes]
        for source in self._sources:
            notes += [f"{source.path}: {note}" for note in (*source.warnings, *source.checks.notes())]
        if self._settings.drop_noise:
            notes += self._not_classified()
        notes += self._steps(read.extremes)
        if not any(GEOGRAPHIC_SYSTEM in note for note in notes):
            low, high = read.extremes + self._frame.origin
            notes += [warning] if (warning := degrees_warning(low, high)) else []
        where = list(cells.counts)
        notes += far_cells_notes(
            np.array([self._lattice.corner(*one) for one in where]),
            self._lattice.size,
            [self._name(*one) for one in where],
            [cells.counts[one] for one in where],
        )
        if not self._lattice.whole:
            notes.append(
                "cells have fractional corners: Autoware's loader, which reads whole metres, refuses them"
            )
        settings = self._settings
        return DividedMap(
            path=self._space.out,
            cells=len(cells.counts),
            points=sum(cells.counts.values()),
            points_read=self._points,
            dropped=read.dropped,
            origin=self._frame.origin,
            cell_size=settings.cell_size,
            leaf=settings.leaf,
            encoding=settings.encoding,
            fields=field_types(self._row),
            bounds=read.extremes.tolist(),
            sources=[
                {**asdict(file), "points": source.points}
                for file, source in zip(self._files, self._sources, strict=True)
            ],
            notes=notes,
            resumed_points=self.resumed,
            crs=self._units.crs,
            unit_m=self._units.unit_m,
        )

    def _not_classified(self) -> list[str]:
        """Return a note about inputs of formats that do not mark noise."""
        others = [source.path for source in self._sources if not isinstance(source.checks, LasChecks)]
        where = others[0] if len(others) == 1 else f"{len(others)} inputs"
        return [f"{where}: --drop-noise had no effect, as only LAS and LAZ mark noise"] if others else []

    def _steps(self, extremes: NDArray[np.float64]) -> list[str]:
        """Return a note if the inputs' coordinates are float32, and too large for it."""
        single = [source for source in self._sources if source.row["x"].itemsize == 4]
        low, high = extremes + self._frame.origin
        note = step_warning(low, high, np.dtype(np.float32)) if single else ""
        where = single[0].path if len(single) == 1 else f"{len(single)} inputs"
        return [f"{where}: {note}"] if note else []


def _check_cells(
    directory: str,
    counts: Mapping[tuple[int, int], int],
    name: Callable[[int, int], str],
    lattice: CellLattice,
    row: Any,
    progress: Progress,
) -> None:
    """Read the cells back; check files, numbers of points, and that each point is in its cell.

    Raises
    ------
    MapDataError
        The files differ from what was written: a defect of the disk, of the memory, or of shmmap.
    """
    progress.stage("checking", sum(counts.values()))
    wanted = {name(*where): where for where in counts}
    if set(os.listdir(directory)) != set(wanted):
        raise MapDataError("not the files that were written", path=directory, cause="check_failed")
    fields = set(row.names)
    for file, where in wanted.items():
        path = os.path.join(directory, file)
        with PcdReader(path) as reader:
            for block in reader.blocks():
                progress.advance(len(block[0]))
            (low_x, low_y, _), (high_x, high_y, _) = reader.bounds
            names = {field.name for field in reader.header.fields}
            points, kept = reader.header.points, reader.kept
        (x, y), (next_x, next_y) = lattice.corner(*where), lattice.corner(where[0] + 1, where[1] + 1)
        if not (points == kept == counts[where] and names == fields):
            raise MapDataError(
                f"{kept} of {points} points read, {counts[where]} were written",
                path=path,
                cause="check_failed",
            )
        if not (x <= low_x and high_x < next_x and y <= low_y and high_y < next_y):
            raise MapDataError("it has points outside its cell", path=path, cause="check_failed")
