# SPDX-License-Identifier: Apache-2.0
"""``shmmap-ndt follow``: localize a stream of scans in the daemon's map."""

from __future__ import annotations

import argparse
import contextlib
import json
import sys
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, TextIO

from shmmap_clients.command_line import (
    add_daemon_options,
    add_json_option,
    at_least,
    connect,
    numbers,
    output_file,
    positive,
    print_json,
    seconds,
    write_text,
    writing_errors,
)
from shmmap_clients.ndt_scan_matcher.cli.align import add_alignment_options, matcher_from

if TYPE_CHECKING:
    from shmmap_clients.ndt_scan_matcher.drive.drive_summary import DriveSummary
    from shmmap_clients.ndt_scan_matcher.drive.follower import Frame

__all__ = ["add_parser", "run"]


_JSON = """\
--json prints one document at the end:
  {"frames", "converged", "trustworthy", "waited", "too_slow", "cut_frames",
   "errors": null without a truth, else
     {"ate_rmse_m", "ate_m": spread, "ate_deg": spread, "rte": {metres: m per 100 m}},
   "transform_probability", "nvtl", "iterations", "latency_ms", "align_ms",
   "thin_ms", "map_ms", "map_request_ms", "map_build_ms": spread each,
   "map_updates", "cells_added", "cells_removed", "map_private_bytes"}
  a spread is {"mean", "variance", "p50", "p99", "max"}; ate is the distance of each
  pose to the true one in metres, or degrees.
--json-lines writes a line for each scan, as soon as it is localized:
  {"name", "stamp_s", "pose": [x, y, z, qx, qy, qz, qw], "converged", "trustworthy",
   "iterations", "transform_probability", "nvtl", "waited", "latency_ms",
   "error_m", "error_deg": distance to the true pose, null without a truth}
Exit code: 0; 1 where a scan could not be trusted, or the map did not keep up."""


def add_parser(subparsers: Any) -> None:
    """Add the verb."""
    parser = subparsers.add_parser(
        "follow",
        help="localize a stream of scans in the daemon's map",
        description="Localize scan after scan in the map that a daemon serves.  Scans come from a directory"
        " (PCD, NPZ, KITTI .bin; by name) or a ZeroMQ endpoint; the map around the vehicle is kept by"
        " Autoware's rules in a thread of its own.",
        epilog=_JSON,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--scans", required=True, metavar="DIR|ENDPOINT")
    parser.add_argument(
        "--truth", metavar="FILE", help="TUM poses of the scans, to start from and compare with"
    )
    parser.add_argument(
        "--init", type=numbers(6), metavar="X,Y,Z,ROLL,PITCH,YAW", help="where to start (default: the truth)"
    )
    parser.add_argument("--odometry", metavar="FILE|ENDPOINT", help="TUM file, or poses over ZeroMQ")
    parser.add_argument(
        "--odometry-wait",
        type=seconds,
        default=0.0,
        metavar="S",
        help="how long a scan may wait until an endpoint's odometry has reached its time (default: not at"
        " all; what is not there yet is predicted at constant velocity)",
    )
    parser.add_argument(
        "--thin", type=float, default=1.0, metavar="M", help="one point per cube (default 1 m; 0: all)"
    )
    parser.add_argument("--frames", type=at_least(1), metavar="N", help="stop after so many scans")
    parser.add_argument(
        "--rate", type=positive, metavar="HZ", help="hold scans of a directory back to this rate"
    )
    window = parser.add_argument_group("map window, as in Autoware")
    window.add_argument("--leaf", type=float, default=2.0, metavar="M", help="voxel edge (default 2.0)")
    window.add_argument("--update-distance", type=float, default=20.0, metavar="M", help="default 20")
    window.add_argument("--map-radius", type=float, default=150.0, metavar="M", help="default 150")
    window.add_argument("--lidar-radius", type=float, default=100.0, metavar="M", help="default 100")
    add_alignment_options(parser)
    out = parser.add_argument_group("output")
    out.add_argument("--tum", type=output_file, metavar="FILE", help="write poses in the TUM format")
    out.add_argument("--publish", metavar="ENDPOINT", help="bind a ZeroMQ publisher of poses")
    out.add_argument(
        "--listener-wait",
        type=seconds,
        default=0.0,
        metavar="S",
        help="how long to wait for the first subscriber, which then gets every pose (default: not at all)",
    )
    out.add_argument(
        "--plot", type=output_file, metavar="FILE", help="write an SVG of way, errors and latency"
    )
    out.add_argument(
        "--json-lines", metavar="FILE", help="write a line of JSON for each scan (-: standard output)"
    )
    add_json_option(out)
    add_daemon_options(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Follow, then print the summary."""
    import numpy as np

    from shmmap import BadRequest
    from shmmap_clients.ndt_scan_matcher.drive.drive_plot import drive_svg
    from shmmap_clients.ndt_scan_matcher.drive.drive_summary import summarize
    from shmmap_clients.ndt_scan_matcher.drive.follower import Follower
    from shmmap_clients.ndt_scan_matcher.drive.frame_json import frame_document
    from shmmap_clients.ndt_scan_matcher.drive.motion_prediction import ConstantVelocity, Odometry, Prediction
    from shmmap_clients.ndt_scan_matcher.drive.pose_stream import OdometryListener, PosePublisher
    from shmmap_clients.ndt_scan_matcher.map.map_updater import MapRules, MapUpdater
    from shmmap_clients.ndt_scan_matcher.matching.euler_derivatives import matrix_from_pose
    from shmmap_clients.scans.scan_source import open_scans
    from shmmap_clients.scans.trajectory import read_trajectory, tum_line
    from shmmap_clients.streams import is_endpoint

    frames: list[Frame] = []
    with contextlib.ExitStack() as stack:
        # all sockets before the first scan: who waits for this program's subscription finds it
        publisher = stack.enter_context(PosePublisher(args.publish)) if args.publish else None
        listener = None
        if args.odometry is not None and is_endpoint(args.odometry):
            listener = OdometryListener(args.odometry)
            stack.callback(listener.close)
        source = open_scans(args.scans, args.truth, stack)
        scans = iter(_paced(source, args.rate) if args.rate and not is_endpoint(args.scans) else source)
        if publisher is not None and args.listener_wait > 0:
            publisher.wait_for_listener(args.listener_wait)
        first = next(scans, None)
        if first is None:
            raise BadRequest("there are no scans")
        if args.init is not None:
            T_first = matrix_from_pose(np.array(args.init))
        elif first.T_map_sensor is not None:
            T_first = first.T_map_sensor
        else:
            raise BadRequest("where does the drive begin?", hint="give --init, or poses with --truth")
        prediction: Prediction
        if listener is not None:
            heard = listener
            prediction = Odometry(T_first, lambda: heard.trajectory)
        elif args.odometry is None:
            prediction = ConstantVelocity(T_first)
        else:
            read = read_trajectory(args.odometry)
            prediction = Odometry(T_first, lambda: read)
        matcher = stack.enter_context(matcher_from(args))
        rules = MapRules(
            args.update_distance, args.map_radius, args.lidar_radius, args.leaf, matcher.caps.voxels
        )
        client = stack.enter_context(connect(args, "shmmap-ndt"))
        maps = stack.enter_context(MapUpdater(client, rules, prepare=matcher.prepare))
        follower = Follower(matcher, maps, prediction, thin=args.thin or None)
        tum = None
        if args.tum:
            stack.enter_context(writing_errors(str(args.tum)))
            tum = stack.enter_context(open(args.tum, "w", encoding="utf-8"))
        lines = stack.enter_context(_line_writer(args.json_lines))
        told = 0
        scan = first
        while scan is not None and (args.frames is None or len(frames) < args.frames):
            if listener is not None and args.odometry_wait > 0:
                listener.wait_until(scan.stamp_s, args.odometry_wait)
            frame = follower.follow(scan)
            frames.append(frame)
            if publisher is not None:
                publisher.send(frame)
            if tum is not None:
                tum.write(tum_line(frame.stamp_s, frame.result.T_map_base) + "\n")
            if lines is not None:
                lines.write(json.dumps(frame_document(frame), allow_nan=False) + "\n")
                lines.flush()
            if maps.too_slow > told:
                told = maps.too_slow
                _say(f"shmmap-ndt: error: the map is not keeping up at {frame.name}; the scan waited for it")
            _progress(len(frames), frame)
            scan = next(scans, None)
        summary = summarize(frames, list(maps.updates), maps.too_slow)
    if sys.stderr.isatty():
        print(file=sys.stderr)
    if args.plot:
        write_text(args.plot, drive_svg(frames))
    if args.json:
        print_json(summary.as_document())
    else:
        _print(summary)
    return 0 if summary.trustworthy == summary.frames and not summary.too_slow else 1


@contextlib.contextmanager
def _line_writer(name: str | None) -> Iterator[TextIO | None]:
    """Open the file of ``--json-lines``; its name ``-`` is standard output."""
    if name is None or name == "-":
        yield sys.stdout if name else None
        return
    with writing_errors(name), open(name, "w", encoding="utf-8") as file:
        yield file


def _paced(scans: Any, rate: float) -> Any:
    import time

    begin = time.monotonic()
    for number, scan in enumerate(scans):
        time.sleep(max(0.0, begin + number / rate - time.monotonic()))
        yield scan


def _say(text: str) -> None:
    print(("\n" if sys.stderr.isatty() else "") + text, file=sys.stderr)


def _progress(number: int, frame: Frame) -> None:
    if sys.stderr.isatty():
        x, y = frame.result.T_map_base[:2, 3]
        state = "ok" if frame.result.trustworthy else "NOT TO BE TRUSTED"
        line = (
            f"\r{number:6} {frame.name:20.20} ({x:9.2f}, {y:9.2f}) NVTL {frame.result.nvtl:5.2f}"
            f" {frame.result.iterations:3} it {frame.latency_s * 1e3:7.1f} ms {state:18}"
        )
        print(line, end="", file=sys.stderr, flush=True)


def _print(summary: DriveSummary) -> None:
    s = summary
    print(
        f"scans           {s.frames}: {s.converged} converged, {s.trustworthy} to be trusted,"
        f" {s.cut_frames} cut by caps"
    )
    print(
        f"map             {s.map_updates} updates, +{s.cells_added} -{s.cells_removed} cells;"
        f" {s.waited} scans waited"
    )
    print(f"  own memory    {s.map_private_bytes / 1e6:.2f} MB at most")
    if s.errors is not None:
        e = s.errors
        print(
            f"error           ATE {e.ate_rmse_m:.3f} m RMSE, p50 {e.ate_m.p50:.3f} p99 {e.ate_m.p99:.3f}"
            f" max {e.ate_m.max:.3f} m; p50 {e.ate_deg.p50:.3f} max {e.ate_deg.max:.3f} deg"
        )
        words = [f"{value:.2f} per 100 m over {metres:.0f} m" for metres, value in e.rte.items()]
        if words:
            print(f"  relative      {'; '.join(words)}")
    for name, spread in (
        ("TP", s.transform_probability),
        ("NVTL", s.nvtl),
        ("iterations", s.iterations),
        ("latency ms", s.latency_ms),
        ("  thin ms", s.thin_ms),
        ("  map ms", s.map_ms),
        ("  align ms", s.align_ms),
        ("update ask ms", s.map_request_ms),
        ("update make ms", s.map_build_ms),
    ):
        print(
            f"{name:15} mean {spread.mean:8.3f}  variance {spread.variance:10.4f}  p50 {spread.p50:8.3f}"
            f"  p99 {spread.p99:8.3f}  max {spread.max:8.3f}"
        )
