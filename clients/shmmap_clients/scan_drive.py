# SPDX-License-Identifier: Apache-2.0
"""Loop over the scans of a drive: a step for each scan, and the program's reports."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from itertools import chain, islice
from pathlib import Path
from typing import Any, Protocol, TextIO, TypeVar

from shmmap import BadRequest
from shmmap_clients.command_line import (
    ProgressLine,
    complain,
    nothing_found,
    open_output,
    print_line,
    writing_errors,
)
from shmmap_clients.scans.bag import Bag, is_bag, split_moment
from shmmap_clients.scans.bag_scans import BagOptions, BagScans, scan_at
from shmmap_clients.scans.scan_file import ScanReader
from shmmap_clients.scans.scan_names import stem
from shmmap_clients.scans.scan_sequence import Scan, ScanSequence
from shmmap_clients.scans.scan_stream import ScanSubscriber
from shmmap_clients.scans.trajectory import read_trajectory
from shmmap_clients.shared_options import bag_options_from, reader_from
from shmmap_clients.streams import is_endpoint

Outcome = TypeVar("Outcome")
_Outcome = TypeVar("_Outcome", contravariant=True)


class DriveReport(Protocol[_Outcome]):
    """Counter of the outcomes, which also describes them."""

    def add(self, outcome: _Outcome, /) -> None:
        """Count the next scan."""

    def line(self, outcome: _Outcome, /) -> str:
        """Return the progress after the scan as text."""


class ScanDrive:
    """The scans of a program's ``--scans``.

    Parameters
    ----------
    args
        Options of the program: those of ``--scans``, ``quiet``, ``allow_empty``, and ``json_lines`` if it has
        it.
    name
        Name of the program.
    poses
        File with the poses of a directory's scans, or topic or file of a bag's, if there is one.
    stack
        Exit stack that closes the subscription and the files.
    reader
        Reader of files, which also filters points; by default from the options.
    one_line
        Whether progress is one line of a terminal, overwritten each time; by default a line a scan.
    rate
        Largest number of scans a second from a directory or a bag, if any.
    bag
        What is taken from a bag; by default from the options.
    live
        Scans that come in place of those of ``--scans``: of ``--topic``.

    Attributes
    ----------
    reader
        Reader of the scans, with counts of the points left out.
    scans
        Scans from `open_scans`, or ``live``.
    is_live
        Whether scans come when they are measured: nothing waits for the second one.

    Raises
    ------
    BadRequest
        As `open_scans`.
    MapMissing, MapDataError
        The scans or their poses cannot be read.
    CannotWrite
        The file of ``--json-lines`` cannot be written.
    """

    def __init__(
        self,
        args: argparse.Namespace,
        name: str,
        poses: str | None,
        stack: ExitStack,
        *,
        reader: ScanReader | None = None,
        one_line: bool = False,
        rate: float | None = None,
        bag: BagOptions | None = None,
        live: Iterable[Scan] | None = None,
    ) -> None:
        self._args, self._name, self._stack, self._rate = args, name, stack, rate
        self.reader = reader if reader is not None else reader_from(args, name)
        bag = bag if bag is not None else bag_options_from(args)
        self.is_live = live is not None or is_endpoint(args.scans)
        self.scans = live if live is not None else open_scans(args.scans, poses, stack, self.reader, bag)
        quiet = args.quiet or (one_line and not sys.stderr.isatty())
        self._progress = stack.enter_context(ProgressLine(quiet=quiet, written_over=one_line))
        self._coming: Iterator[Scan] | None = None
        lines = getattr(args, "json_lines", None)
        self._lines = sys.stdout if lines == "-" else self.open_text(lines) if lines else None

    def open_text(self, path: str) -> TextIO:
        """Open a file for writing until the end; errors of writing raise `CannotWrite`."""
        with writing_errors(path):
            file = open(open_output(path), "w", encoding="utf-8")  # noqa: SIM115
        self._stack.enter_context(writing_errors(path))
        return self._stack.enter_context(file)

    def ahead(self, count: int) -> list[Scan]:
        """Wait for the first scans, at most ``count``, without consuming them: `run` begins with them."""
        coming = self._begin()
        scans = list(islice(coming, count))
        self._coming = chain(scans, coming)
        return scans

    def run(
        self,
        step: Callable[[Scan], Outcome],
        report: DriveReport[Outcome],
        document: Callable[[Outcome], dict[str, Any]] | None = None,
        *,
        max_scans: int | None = None,
    ) -> None:
        """Process all scans.

        Parameters
        ----------
        step
            Processes a scan.
        report
            Counts the outcome, and describes it for stderr.
        document
            Returns the JSON object that ``--json-lines`` writes for the outcome.
        max_scans
            Largest number of scans, if any.

        Raises
        ------
        ShmmapError
            A scan cannot be read, or the step fails.
        """
        coming = self._begin()
        paced = _paced(coming, self._rate) if self._rate and not self.is_live else coming
        for scan in islice(paced, max_scans):
            outcome = step(scan)
            report.add(outcome)
            if self._lines is not None and document is not None:
                self._lines.write(json.dumps(document(outcome), allow_nan=False) + "\n")
                self._lines.flush()
            if not self._progress.quiet:
                self._progress.show(report.line(outcome))

    def say(self, text: str, hint: str = "") -> None:
        """Print a note on stderr."""
        self._progress.end()
        complain(self._name, text, hint)

    def no_scans(self) -> int:
        """Report that there was no scan, and return the exit code."""
        return nothing_found(self._args, f"no scan came from {self._source}", name=self._name)

    @property
    def _source(self) -> str:
        return str(self._args.scans or self._args.topic)

    def _begin(self) -> Iterator[Scan]:
        """Return the remaining scans; from now on, wait for scans of a publisher."""
        if self._coming is None:
            if self.is_live and not self._args.quiet:
                print_line(f"waiting for scans from {self._source}", file=sys.stderr)
            self._coming = iter(self.scans)
        return self._coming


def open_scans(
    source: str, poses: str | None, stack: ExitStack, reader: ScanReader, bag: BagOptions
) -> Iterable[Scan]:
    """Return the scans of a directory or a bag, or of a publisher as they arrive.

    Parameters
    ----------
    source
        Directory of scans, a bag, or address of a publisher.
    poses
        File with T_map_sensor of each scan of a directory; the first and the last pair are printed.  For a
        bag as in `BagScans.read_poses`.
    stack
        Exit stack that closes a subscription or a bag.
    reader
        Reader of files, which also filters points of files and messages.
    bag
        What is taken from a bag.

    Raises
    ------
    BadRequest
        ``poses`` is given for a publisher, whose scans include poses; or the address is invalid.
    MapMissing, MapDataError
        The directory, the bag or the file cannot be read.
    PackageMissing
        The source is a bag, and the package that reads it is not installed.
    """
    if is_endpoint(source):
        if poses:
            raise BadRequest(f"{poses} is for a directory of scans: those of a publisher bring their poses")
        return _screened(stack.enter_context(ScanSubscriber(source)), reader)
    if is_bag(source):
        found = BagScans(stack.enter_context(Bag(source)), bag, reader)
        found.read_poses(poses)
        return found
    trajectory = read_trajectory(poses) if poses else None
    for note in trajectory.notes if trajectory is not None else ():
        reader.say(note)
    scans = ScanSequence(source, trajectory, reader)
    if scans.pairing:
        reader.say(scans.pairing)
    return scans


def read_one_scan(source: str, reader: ScanReader, bag: BagOptions) -> Scan:
    """Return one scan, screened: a file, or ``BAG@SECONDS``, the one nearest to a time since a bag's begin.

    Raises
    ------
    BadRequest
        A bag is named without a time, or with one that is not in it.
    MapMissing, MapDataError
        The file or the bag cannot be read.
    PackageMissing
        The source is a bag, and the package that reads it is not installed.
    """
    moment = split_moment(source)
    if moment is not None:
        return scan_at(*moment, bag, reader)
    columns, rows = reader.screened(reader.read(source))
    return Scan(stem(Path(source)), 0.0, columns, rows=rows)


def _screened(scans: Iterable[Scan], reader: ScanReader) -> Iterator[Scan]:
    for scan in scans:
        columns, rows = reader.screened(scan.columns)
        yield scan if rows is None else replace(scan, columns=columns, rows=rows)


def _paced(scans: Iterable[Scan], rate: float) -> Iterator[Scan]:
    begin_s = time.monotonic()
    for number, scan in enumerate(scans):
        time.sleep(max(0.0, begin_s + number / rate - time.monotonic()))
        yield scan
