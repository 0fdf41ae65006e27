# SPDX-License-Identifier: Apache-2.0
"""Progress messages of ``shmmap-ndt follow``, and its summary as text."""

from __future__ import annotations

from shmmap import Client
from shmmap_clients.command_line import format_bytes
from shmmap_clients.map_extent import map_extent
from shmmap_clients.ndt_scan_matcher.drive.drive_summary import DriveStatistics, DriveSummary
from shmmap_clients.ndt_scan_matcher.drive.follower import Frame
from shmmap_clients.ndt_scan_matcher.map.map_updater import MapUpdater
from shmmap_clients.ndt_scan_matcher.matching.matcher import NdtMatcher
from shmmap_clients.pose_initializer import Relocalizer
from shmmap_clients.scan_drive import ScanDrive


class FollowReport:
    """Counter of the frames of a drive, with reports of notable events on stderr.

    Parameters
    ----------
    drive
        Drive over the scans; prints the reports.
    client, matcher, maps, relocalizer
        Objects that the drive uses.
    hint
        Hint printed once when the vehicle is lost and no search is configured.
    """

    def __init__(
        self,
        drive: ScanDrive,
        client: Client,
        matcher: NdtMatcher,
        maps: MapUpdater,
        relocalizer: Relocalizer | None,
        hint: str = "",
    ) -> None:
        self.statistics = DriveStatistics()
        self._say = drive.say
        self._client = client
        self._matcher = matcher
        self._maps = maps
        self._relocalizer = relocalizer
        self._hint = hint
        self._too_slow = 0
        self._state = ""
        self._error = ""
        self._has_fault = False
        self._last_stamp_s = 0.0

    def add(self, frame: Frame) -> None:
        """Count the next frame, and report changes."""
        statistics, where = self.statistics, f"at scan {frame.name}"
        statistics.add(frame)
        if frame.result.no_map and statistics.no_map == 1:
            self._say(f"no map {where}: {map_extent(self._client, frame.result.T_map_base[:2, 3])}")
        if self._maps.too_slow > self._too_slow:
            self._too_slow = self._maps.too_slow
            self._say(f"the map did not keep up with the vehicle: scan {frame.name} waited for it")
        if frame.clock_jumped and statistics.clock_jumps == 1:
            step_s = frame.stamp_s - self._last_stamp_s
            self._say(f"the clock jumped {where}, {step_s:+.6g} s: no motion is predicted there (said once)")
        self._last_stamp_s = frame.stamp_s
        self._say_state(frame, where)
        if self._matcher.fault is not None and not self._has_fault:
            self._has_fault = True
            why = self._matcher.fault.message
            self._say(f"the device failed {where}, {self._matcher.backend_name} goes on: {why}")

    def _say_state(self, frame: Frame, where: str) -> None:
        """Report when the vehicle is lost or found again; without a search, print the hint once."""
        before, self._state = self._state, frame.state
        if frame.relocalized:
            x, y = frame.result.T_map_base[:2, 3]
            self._say(f"relocalized {where}: ({x:.2f}, {y:.2f})")
        elif frame.state == "lost" and before != "lost":
            failed = ", ".join(self._matcher.trust.describe(name) for name in frame.result.failed_limits)
            self._say(f"lost {where}: {failed}", self._hint)
            self._hint = ""
        elif frame.state == "tracking" and before == "lost":
            self._say(f"tracking again {where}")
        error = self._relocalizer.error if self._relocalizer is not None else None
        text = "" if error is None else str(error)
        if text and not self._error:
            self._say(f"relocalization failed {where}: {text}")
        self._error = text

    def line(self, frame: Frame) -> str:
        """Return the progress after a frame."""
        x, y = frame.result.T_map_base[:2, 3]
        return (
            f"{self.statistics.frames:6} {frame.name:20.20} ({x:9.2f}, {y:9.2f})"
            f" NVTL {frame.result.nvtl:5.2f} {frame.result.iterations:3} iterations"
            f" {frame.latency_s * 1e3:7.1f} ms {frame.state:9}"
        )


def print_summary(summary: DriveSummary, left_out: str = "") -> None:
    """Print the summary of a drive as text, without rows that have no data (scores without a map)."""
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
    print(f"  own memory    {format_bytes(s.map_private_bytes)} at most, beside the shared memory")
    if s.map_writes:
        again = f", laid out again {s.map_laid_out_again} times" if s.map_laid_out_again else ""
        print(f"  on the device {format_bytes(s.map_written_bytes)} written in {s.map_writes} writes{again}")
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
        if not spread.max > 0.0:  # NaN, or no scan has this value
            continue
        print(
            f"{name:22} mean {spread.mean:8.3f}  variance {spread.variance:10.4f}  p50 {spread.p50:8.3f}"
            f"  p99 {spread.p99:8.3f}  max {spread.max:8.3f}"
        )
