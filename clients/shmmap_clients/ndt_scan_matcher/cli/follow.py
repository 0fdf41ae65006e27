# SPDX-License-Identifier: Apache-2.0
"""``shmmap-ndt follow``: localize a stream of scans in the daemon's map."""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from shmmap_clients.command_line import add_verb, connect, print_json, write_text
from shmmap_clients.ndt_scan_matcher.cli.alignment_options import matcher_from
from shmmap_clients.ndt_scan_matcher.cli.follow_options import EPILOG, add_options
from shmmap_clients.pose_option import pose_from
from shmmap_clients.shared_options import scoring_settings, trust_from

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from shmmap_clients.ndt_scan_matcher.drive.motion_prediction import MotionPrediction
    from shmmap_clients.ndt_scan_matcher.drive.pose_stream import OdometryListener
    from shmmap_clients.pose_initializer import Relocalizer
    from shmmap_clients.scans.scan_sequence import Scan

__all__ = ["add_parser", "run"]


def add_parser(subparsers: Any) -> None:
    """Add the verb."""
    parser = add_verb(
        subparsers,
        "follow",
        run,
        help="localize scan after scan in the daemon's map",
        description="Localize scan after scan in the map that a daemon serves.  The map around the vehicle is"
        " kept by Autoware's rules, in a thread of its own.",
        epilog=EPILOG,
    )
    add_options(parser)


def run(args: argparse.Namespace) -> int:
    """Follow, then print the summary."""
    from shmmap_clients.ndt_scan_matcher.cli.follow_report import FollowReport, print_summary
    from shmmap_clients.ndt_scan_matcher.drive.drive_plot import DrivePlot
    from shmmap_clients.ndt_scan_matcher.drive.drive_summary import frame_document
    from shmmap_clients.ndt_scan_matcher.drive.follower import Follower, Frame
    from shmmap_clients.ndt_scan_matcher.drive.pose_stream import OdometryListener, PosePublisher
    from shmmap_clients.ndt_scan_matcher.drive.tracking import Tracking
    from shmmap_clients.ndt_scan_matcher.map.map_updater import MapRules, MapUpdater
    from shmmap_clients.scan_drive import ScanDrive
    from shmmap_clients.scans.trajectory import read_route, tum_line
    from shmmap_clients.streams import is_endpoint

    plot = DrivePlot()
    route = read_route(args.route) if args.route is not None else ()
    with contextlib.ExitStack() as stack:
        # all sockets before the first scan: who waits for this program's subscription finds it
        publisher = stack.enter_context(PosePublisher(args.publish)) if args.publish else None
        listener = None
        if args.odometry is not None and is_endpoint(args.odometry):
            listener = OdometryListener(args.odometry)
            stack.callback(listener.close)
        drive = ScanDrive(args, "shmmap-ndt", args.truth, stack, one_line=True, rate=args.rate)
        tum = drive.open_text(str(args.tum)) if args.tum else None
        if publisher is not None and args.listener_wait > 0:
            publisher.wait_for_listener(args.listener_wait)
        first = drive.first()
        if first is None:
            return drive.no_scans()
        T_first, known = _start(args, first)
        prediction = _prediction(args, T_first, listener, drive.scans)
        matcher = stack.enter_context(matcher_from(args))
        rules = MapRules(
            args.update_distance,
            args.map_radius,
            args.lidar_radius,
            args.leaf,
            matcher.limits.voxels,
            max_bytes=matcher.limits.most_map_bytes,
        )
        client = stack.enter_context(connect(args, "shmmap-ndt"))
        maps = stack.enter_context(
            MapUpdater(client, rules, prepare=matcher.prepare, uploads=matcher.uploads, route=route)
        )
        relocalizer = None
        by_default = args.rough is not None or not is_endpoint(args.scans)
        if by_default if args.relocalize is None else args.relocalize:
            relocalizer = _relocalizer(args, stack)
        follower = Follower(
            matcher,
            maps,
            prediction,
            thin=args.thin or None,
            tracking=Tracking(args.lost_after, lost=not known),
            relocalize=relocalizer,
        )
        asked = relocalizer is not None or args.relocalize is False
        hint = "" if asked else "--relocalize searches for it"
        report = FollowReport(drive, client, matcher, maps, relocalizer, hint)

        def step(scan: Scan) -> Frame:
            if listener is not None and args.odometry_wait > 0:
                listener.wait_until(scan.stamp_s, args.odometry_wait)
            frame = follower.follow(scan)
            if args.plot:
                plot.add(frame)
            if publisher is not None:
                publisher.send(frame)
            if tum is not None:
                tum.write(tum_line(frame.stamp_s, frame.result.T_map_base) + "\n")
            return frame

        drive.run(step, report, frame_document, max_scans=args.frames)
    summary = report.statistics.summary(
        maps.statistics, maps.too_slow, matcher.trust, backend=matcher.backend_name, fault=matcher.fault
    )
    if args.plot:
        write_text(args.plot, plot.svg())
    if args.json:
        print_json({**summary.as_document(), **drive.reader.counts})
    else:
        print_summary(summary, drive.reader.left_out)
    allowed = summary.no_map if args.allow_empty else 0
    return 0 if summary.trustworthy + allowed == summary.frames and not summary.too_slow else 1


def _start(args: argparse.Namespace, first: Scan) -> tuple[NDArray[np.float64], bool]:
    """Return the pose where the drive begins, and whether it is known well."""
    from shmmap import BadRequest

    if args.init is not None:
        return pose_from(args, "--init"), True
    if args.rough is not None:
        return pose_from(args, "--rough"), False
    if first.T_map_sensor is not None:
        return first.T_map_sensor, True
    raise BadRequest("no start pose: give --init, --rough or --truth")


def _prediction(
    args: argparse.Namespace,
    T_first: NDArray[np.float64],
    listener: OdometryListener | None,
    source: Iterable[Scan],
) -> MotionPrediction:
    """Return what predicts the next pose; the first velocity is the truth's, or that of the route's times."""
    from shmmap_clients.ndt_scan_matcher.drive import motion_prediction
    from shmmap_clients.ndt_scan_matcher.drive.motion_prediction import ConstantVelocity, Odometry
    from shmmap_clients.scans.scan_sequence import ScanSequence
    from shmmap_clients.scans.trajectory import read_trajectory

    if listener is not None:
        return Odometry(T_first, lambda: listener.trajectory)
    if args.odometry is None:
        truth = source.trajectory if isinstance(source, ScanSequence) else None
        if truth is not None:
            return ConstantVelocity(T_first, motion_prediction.first_twist(truth))
        if args.route is not None and not args.route.lower().endswith(".csv"):
            route = read_trajectory(args.route)
            return ConstantVelocity(T_first, motion_prediction.twist_on_route(route, T_first))
        return ConstantVelocity(T_first)
    read = read_trajectory(args.odometry)
    return Odometry(T_first, lambda: read)


def _relocalizer(args: argparse.Namespace, stack: contextlib.ExitStack) -> Relocalizer:
    """Return what searches for a lost vehicle; it has a session of its own from the first search on."""
    from shmmap_clients.pose_initializer import InitializerRules, PoseInitializer, Relocalizer

    rules = InitializerRules(map_radius=args.map_radius, leaf=args.leaf, height=args.height)

    def initializer() -> PoseInitializer:
        client = stack.enter_context(connect(args, "shmmap-ndt (relocalization)"))
        made = PoseInitializer(
            client,
            rules,
            trust=trust_from(args),
            threads=args.threads,
            **scoring_settings(args),
        )
        return stack.enter_context(made)

    return Relocalizer(initializer, sigma_m=args.sigma, sigma_yaw=args.sigma_yaw)
