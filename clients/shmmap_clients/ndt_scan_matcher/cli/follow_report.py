# SPDX-License-Identifier: Apache-2.0
"""What ``shmmap-ndt follow`` tells while it runs, and its summary in words."""

from __future__ import annotations

import argparse
import contextlib
import json
import sys
from types import TracebackType
from typing import TYPE_CHECKING, TextIO

from shmmap_clients.command_line import complain, nothing_found, printable, writing_errors

if TYPE_CHECKING:
    from shmmap import Client
    from shmmap_clients.ndt_scan_matcher.drive.drive_summary import DriveSummary
    from shmmap_clients.ndt_scan_matcher.drive.follower import Frame
    from shmmap_clients.ndt_scan_matcher.matching.matcher import NdtMatcher
    from shmmap_clients.ndt_scan_matcher.matching.trust import TrustLimits
    from shmmap_clients.pose_initializer import Relocalizer

__all__ = ["FollowReport", "print_summary"]

_NAME: str = "shmmap-ndt"


class FollowReport:
    """Writes ``--tum`` and ``--json-lines``, and says on stderr what a reader has to know.

    Parameters
    ----------
    args
        Of the program.
    """

    def __init__(self, args: argparse.Namespace) -> None:
        self._args = args
        self._stack = contextlib.ExitStack()
        self._tum: TextIO | None = None
        self._lines: TextIO | None = None
        self._terminal = sys.stderr.isatty() and not args.quiet
        self._frames = 0
        self._too_slow = 0
        self._state = ""
        self._no_map_told = False
        self._hinted = False
        self._error_told = ""
        self._fault_told = False
        self._jump_told = False
        self._last_stamp_s = 0.0

    def __enter__(self) -> FollowReport:
        args = self._args
        if args.tum:
            self._tum = self._opened(str(args.tum))
        if args.json_lines == "-":
            self._lines = sys.stdout
        elif args.json_lines:
            self._lines = self._opened(args.json_lines)
        return self

    def _opened(self, path: str) -> TextIO:
        """Open a file to write; until this report is closed, what cannot be written is `CannotWrite`."""
        with writing_errors(path):
            file = open(path, "w", encoding="utf-8")  # noqa: SIM115
        self._stack.enter_context(writing_errors(path))
        return self._stack.enter_context(file)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._terminal and self._frames:
            print(file=sys.stderr)
        self._stack.__exit__(kind, error, trace)

    def no_scans(self) -> int:
        """Say that there was no scan; returns the exit code."""
        return nothing_found(self._args, f"no scan came from {self._args.scans}", name=_NAME)

    def frame(
        self,
        frame: Frame,
        client: Client,
        trust: TrustLimits,
        too_slow: int,
        relocalizer: Relocalizer | None,
    ) -> None:
        """Tell of the next frame."""
        from shmmap_clients.ndt_scan_matcher.drive.frame_json import frame_document
        from shmmap_clients.scans.trajectory import tum_line

        self._frames += 1
        if self._tum is not None:
            self._tum.write(tum_line(frame.stamp_s, frame.result.T_map_base) + "\n")
        if self._lines is not None:
            self._lines.write(json.dumps(frame_document(frame), allow_nan=False) + "\n")
            self._lines.flush()
        if frame.result.no_map and not self._no_map_told:
            self._no_map_told = True
            self._say_no_map(frame, client)
        if too_slow > self._too_slow:
            self._too_slow = too_slow
            self._say(f"the map did not keep up with the vehicle: scan {frame.name} waited for it")
        if frame.clock_jumped and not self._jump_told:
            self._jump_told = True
            step_s = frame.stamp_s - self._last_stamp_s
            self._say(
                f"the clock jumped at scan {frame.name}, {step_s:+.6g} s: no motion is predicted there"
                " (said once)"
            )
        self._last_stamp_s = frame.stamp_s
        self._tell_state(frame, trust, relocalizer)
        self._progress(frame)

    def fault(self, frame: Frame, matcher: NdtMatcher) -> None:
        """Say, once, that another backend goes on."""
        if matcher.fault is not None and not self._fault_told:
            self._fault_told = True
            why = matcher.fault.message
            self._say(f"the device failed at scan {frame.name}, {matcher.backend_name} goes on: {why}")

    def _say_no_map(self, frame: Frame, client: Client) -> None:
        from shmmap_clients.map_extent import map_extent

        x, y = frame.result.T_map_base[:2, 3]
        self._say(f"no map at scan {frame.name}: {map_extent(client)}, the pose is at ({x:.3f}, {y:.3f})")

    def _tell_state(self, frame: Frame, trust: TrustLimits, relocalizer: Relocalizer | None) -> None:
        """Say when the vehicle gets lost or is found again."""
        before, self._state = self._state, frame.state
        where = f"at scan {frame.name}"
        if frame.relocalized:
            x, y = frame.result.T_map_base[:2, 3]
            self._say(f"relocalized {where}: ({x:.2f}, {y:.2f})")
        elif frame.state == "lost" and before != "lost":
            failed = ", ".join(trust.describe(name) for name in frame.result.failed_limits)
            self._say(f"lost {where}: {failed}", self._lost_hint(relocalizer))
        elif frame.state == "tracking" and before == "lost":
            self._say(f"tracking again {where}")
        error = "" if relocalizer is None or relocalizer.error is None else str(relocalizer.error)
        if error and not self._error_told:
            self._say(f"relocalization failed {where}: {error}")
        self._error_told = error

    def _lost_hint(self, relocalizer: Relocalizer | None) -> str:
        """Say, once, what finds a lost vehicle again, where nothing searches and nothing forbids it."""
        if relocalizer is not None or self._args.relocalize is False or self._hinted:
            return ""
        self._hinted = True
        return "--relocalize searches for it"

    def _say(self, text: str, hint: str = "") -> None:
        if self._terminal and self._frames > 1:
            print(file=sys.stderr)  # the progress stands there
        complain(_NAME, text, hint)

    def _progress(self, frame: Frame) -> None:
        if self._terminal:
            x, y = frame.result.T_map_base[:2, 3]
            line = (
                f"\r{self._frames:6} {printable(frame.name):20.20} ({x:9.2f}, {y:9.2f})"
                f" NVTL {frame.result.nvtl:5.2f} {frame.result.iterations:3} iterations"
                f" {frame.latency_s * 1e3:7.1f} ms {frame.state:9}"
            )
            print(line, end="", file=sys.stderr, flush=True)


def print_summary(summary: DriveSummary, left_out: str = "") -> None:
    """Print the summary of a drive for people; rows without data (scores without a map) are left out."""
    s = summary
    print(
        f"scans           {s.frames}: {s.converged} converged, {s.trustworthy} trusted,"
        f" {s.cut_frames} shortened by the limits"
    )
    if left_out:
        print(f"  left out      {left_out}")
    if s.clock_jumps:
        print(f"  clock         jumped before {s.clock_jumps} of them")
    if s.cut_by:
        print(f"  shortened by  {', '.join(f'{name} ({count})' for name, count in s.cut_by.items())}")
    if s.fault is not None:
        print(f"backend         {s.backend} went on without the device: {s.fault}")
    if s.failed_limits:
        why = (f"{s.trust.describe(name)} ({count})" for name, count in s.failed_limits.items())
        print(f"  not trusted   {', '.join(why)}")
    if s.lost or s.relocalized:
        print(f"  lost          scans: {s.lost}, times relocalized: {s.relocalized}")
    print(
        f"map             updates: {s.map_updates}, cells added: {s.cells_added}, cells removed:"
        f" {s.cells_removed}, scans that waited for it: {s.waited}"
    )
    print(f"  own memory    {s.map_private_bytes / 1e6:.2f} MB at most, beside the shared memory")
    if s.map_writes:
        again = f", laid out anew {s.map_laid_out_anew} times" if s.map_laid_out_anew else ""
        print(f"  on the device {s.map_written_bytes / 1e6:.2f} MB written in {s.map_writes} writes{again}")
    if s.errors is not None:
        e = s.errors
        print(
            f"error           ATE {e.ate_rmse_m:.3f} m RMSE, p50 {e.ate_m.p50:.3f} p99 {e.ate_m.p99:.3f}"
            f" max {e.ate_m.max:.3f} m; p50 {e.ate_deg.p50:.3f} max {e.ate_deg.max:.3f} deg"
        )
        words = [f"{value:.2f} m per 100 m over {metres:.0f} m" for metres, value in e.rte.items()]
        if words:
            print(f"  relative      {'; '.join(words)}")
    for name, spread in (
        ("transform probability", s.transform_probability),
        ("NVTL", s.nvtl),
        ("iterations", s.iterations),
        ("latency, ms", s.latency_ms),
        ("  thinning, ms", s.thin_ms),
        ("  getting the map, ms", s.map_ms),
        ("  alignment, ms", s.align_ms),
        ("map request, ms", s.map_request_ms),
        ("map building, ms", s.map_build_ms),
        ("  preparing, ms", s.map_prepare_ms),
    ):
        if not spread.max > 0.0:  # none (NaN), or no scan had it
            continue
        print(
            f"{name:22} mean {spread.mean:8.3f}  variance {spread.variance:10.4f}  p50 {spread.p50:8.3f}"
            f"  p99 {spread.p99:8.3f}  max {spread.max:8.3f}"
        )
