# SPDX-License-Identifier: Apache-2.0
"""The scans of a drive, one after the other through one step, and what a program prints of each."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from itertools import chain, islice
from typing import Any, Protocol, TextIO, TypeVar

from shmmap import BadRequest
from shmmap_clients.command_line import ProgressLine, complain, nothing_found, print_line, writing_errors
from shmmap_clients.scans.scan_file import ScanReader
from shmmap_clients.scans.scan_sequence import Scan, ScanSequence
from shmmap_clients.scans.scan_stream import ScanSubscriber
from shmmap_clients.scans.trajectory import read_trajectory
from shmmap_clients.shared_options import reader_from
from shmmap_clients.streams import is_endpoint

__all__ = ["DriveReport", "ScanDrive", "open_scans"]

Outcome = TypeVar("Outcome")
_Outcome = TypeVar("_Outcome", contravariant=True)


class DriveReport(Protocol[_Outcome]):
    """Counts the outcomes, and puts each in words."""

    def add(self, outcome: _Outcome, /) -> None:
        """Count the next scan."""

    def line(self, outcome: _Outcome, /) -> str:
        """Return the progress after that scan."""


class ScanDrive:
    """The scans that a program's ``--scans`` names.

    Parameters
    ----------
    args
        Of the program: ``scans``, ``quiet``, ``allow_empty``, and ``json_lines`` where it has that option.
    name
        The program's.
    poses
        File with the poses of a directory's scans, if there is one.
    stack
        Closes the subscription and the files.
    reader
        How files are read, and which points count; by default as the options say.
    one_line
        Progress is one line of a terminal, which is written over; by default it is a line for each scan.
    rate
        Scans a second that a directory is read at most, if that is given.

    Attributes
    ----------
    reader
        Reads the scans, and has counted which points were left out.
    scans
        As `open_scans` returns them.

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
    ) -> None:
        self._args, self._name, self._stack, self._rate = args, name, stack, rate
        self.reader = reader if reader is not None else reader_from(args, name)
        self.scans = open_scans(args.scans, poses, stack, self.reader)
        quiet = args.quiet or (one_line and not sys.stderr.isatty())
        self._progress = stack.enter_context(ProgressLine(quiet=quiet, written_over=one_line))
        self._coming: Iterator[Scan] | None = None
        lines = getattr(args, "json_lines", None)
        self._lines = sys.stdout if lines == "-" else self.open_text(lines) if lines else None

    def open_text(self, path: str) -> TextIO:
        """Open a file to write until the end; what keeps it from being written is `CannotWrite`."""
        with writing_errors(path):
            file = open(path, "w", encoding="utf-8")  # noqa: SIM115
        self._stack.enter_context(writing_errors(path))
        return self._stack.enter_context(file)

    def first(self) -> Scan | None:
        """Wait for the first scan, with which `run` begins all the same; None where there is none."""
        coming = self._begin()
        scan = next(coming, None)
        if scan is not None:
            self._coming = chain([scan], coming)
        return scan

    def run(
        self,
        step: Callable[[Scan], Outcome],
        report: DriveReport[Outcome],
        document: Callable[[Outcome], dict[str, Any]] | None = None,
        *,
        max_scans: int | None = None,
    ) -> None:
        """Go through the scans to their end.

        Parameters
        ----------
        step
            What is done with a scan.
        report
            Counts the outcome, and puts it in words for stderr.
        document
            Returns what ``--json-lines`` writes of it.
        max_scans
            Number of scans that are taken at most, if that is given.

        Raises
        ------
        ShmmapError
            A scan cannot be read, or the step cannot be done.
        """
        for scan in islice(self._begin(), max_scans):
            outcome = step(scan)
            report.add(outcome)
            if self._lines is not None and document is not None:
                self._lines.write(json.dumps(document(outcome), allow_nan=False) + "\n")
                self._lines.flush()
            if not self._progress.quiet:
                self._progress.show(report.line(outcome))

    def say(self, text: str, hint: str = "") -> None:
        """Print on stderr what a reader has to know."""
        self._progress.end()
        complain(self._name, text, hint)

    def no_scans(self) -> int:
        """Print that there was no scan and return the exit code."""
        return nothing_found(self._args, f"no scan came from {self._args.scans}", name=self._name)

    def _begin(self) -> Iterator[Scan]:
        """Return the scans that have not been taken; those of a publisher are waited for from now on."""
        if self._coming is None:
            endpoint = is_endpoint(self._args.scans)
            if endpoint and not self._args.quiet:
                print_line(f"waiting for scans from {self._args.scans}", file=sys.stderr)
            self._coming = iter(_paced(self.scans, self._rate) if self._rate and not endpoint else self.scans)
        return self._coming


def open_scans(source: str, poses: str | None, stack: ExitStack, reader: ScanReader) -> Iterable[Scan]:
    """Return the scans of a directory, or those of a publisher as they come.

    Parameters
    ----------
    source
        Directory or address.
    poses
        File with T_map_sensor of each scan of a directory; the first and the last pair are printed.
    stack
        Closes a subscription.
    reader
        How files are read, and which points of files and messages count.

    Raises
    ------
    BadRequest
        A file of poses for scans of a publisher, which bring their own; or the address makes no sense.
    MapMissing, MapDataError
        The directory or the file cannot be read.
    """
    if not is_endpoint(source):
        scans = ScanSequence(source, read_trajectory(poses) if poses else None, reader)
        if scans.pairing:
            reader.say(scans.pairing)
        return scans
    if poses:
        raise BadRequest(f"{poses} is for a directory of scans: those of a publisher bring their poses")
    return _screened(stack.enter_context(ScanSubscriber(source)), reader)


def _screened(scans: Iterable[Scan], reader: ScanReader) -> Iterator[Scan]:
    for scan in scans:
        columns, rows = reader.screened(scan.columns)
        yield scan if rows is None else replace(scan, columns=columns, rows=rows)


def _paced(scans: Iterable[Scan], rate: float) -> Iterator[Scan]:
    begin_s = time.monotonic()
    for number, scan in enumerate(scans):
        time.sleep(max(0.0, begin_s + number / rate - time.monotonic()))
        yield scan
