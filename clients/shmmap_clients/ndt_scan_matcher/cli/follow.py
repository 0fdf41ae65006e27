# SPDX-License-Identifier: Apache-2.0
"""``shmmap-ndt follow``: localize a stream of scans in the daemon's map."""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final

from shmmap_clients.command_line import (
    add_allow_empty,
    add_daemon_options,
    add_json_option,
    add_verb,
    at_least,
    connect,
    not_negative,
    output_file,
    positive,
    print_json,
    seconds,
    write_text,
)
from shmmap_clients.ndt_scan_matcher.cli.align import add_alignment_options, matcher_from
from shmmap_clients.shared_options import (
    FAILED_LIMITS,
    add_height_option,
    add_json_lines_option,
    add_leaf_option,
    add_pose_format_option,
    add_pose_option,
    add_quiet_option,
    add_radius_option,
    add_scans_option,
    add_sigma_options,
    add_thin_option,
    bag_options_from,
    pose_from,
    reader_from,
    scoring_settings,
    trust_from,
)

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from shmmap import Client
    from shmmap_clients.ndt_scan_matcher.drive.motion_prediction import MotionPrediction
    from shmmap_clients.ndt_scan_matcher.drive.pose_stream import OdometrySubscriber
    from shmmap_clients.ndt_scan_matcher.drive.ros_topic import RosTopic
    from shmmap_clients.ndt_scan_matcher.map.map_updater import MapUpdater
    from shmmap_clients.ndt_scan_matcher.matching.matcher import NdtMatcher
    from shmmap_clients.pose_initializer import Relocalizer
    from shmmap_clients.scan_drive import ScanDrive
    from shmmap_clients.scans.bag_scans import BagOptions
    from shmmap_clients.scans.scan_file import ScanReader
    from shmmap_clients.scans.scan_sequence import Scan
    from shmmap_clients.scans.trajectory import Trajectory

_BEFORE_ODOMETRY_S: Final = 10.0  # scans may begin earlier than odometry

EPILOG: Final = f"""\
A scan's result is trusted when it is within all limits of trust.  A vehicle is
  tracking   when its last result was trusted,
  uncertain  at the beginning, and when its last result was not trusted,
  lost       after --lost-after such results in a row, or where there is no map.
A pose that is not trusted is marked so; the next scan is then predicted from
odometry or constant velocity alone, and without odometry a lost vehicle stands.
A time that is not 0 to 1 s after the one before (a clock that was set, a pause)
says nothing of motion: without odometry none is predicted there.

JSON (fields may be added, none is removed).
--json prints one document at the end:
  {{"frames", "converged", "trustworthy", "no_map": scans, "lost": scans,
   "relocalized": times, "clock_jumps": scans, "too_near", "not_finite": points
   of the scans left out, "failed_limits": {{name: scans}},
   "trust": {{"nvtl", "transform_probability", "oscillations", "points",
     "distance", "angle", "sharpness", "spread"}}: limits in force,
   "scans_left_out": of a topic of ROS 2, for newer ones had come; else absent,
   "waited": for the map, "too_slow": times that the map did not keep up,
   "cut_frames": cut by limits, "cut_by": {{limit: scans}}: points, neighbors,
     voxels, map_bytes, deadline,
   "backend": that computed last, "fault": why it is the fallback, or null,
   "errors": null without a truth, else {{"ate_rmse_m", "ate_m": spread,
     "ate_deg": spread, "rte": {{metres: metres per 100 m}}}},
   "transform_probability", "nvtl", "iterations", "latency_ms", "align_ms",
   "thin_ms", "map_ms", "map_request_ms", "map_build_ms",
   "map_prepare_ms": its part of the backend: spread each,
   "map_updates", "cells_added", "cells_removed", "map_private_bytes",
   "map_written_bytes", "map_writes": to a device,
   "map_laid_out_again": maps written again for lack of room}}
  A spread is {{"mean", "variance", "p50", "p99", "max"}}; ate is the distance
  of the poses to the true ones in metres, or degrees.
--json-lines writes a line for each scan, as soon as it is localized:
  {{"name", "stamp_s", "pose": [x, y, z, qx, qy, qz, qw], "converged",
   "trustworthy", "failed_limits": [name], "no_map",
   "state": tracking, uncertain or lost, "relocalized", "clock_jumped": bool,
   "iterations", "transform_probability", "nvtl", "waited", "latency_ms",
   "error_m", "error_deg": to the true pose, null without a truth}}
{FAILED_LIMITS}

Exit code: 0; 1 when a scan was not trusted (with --allow-empty: for another
reason than no map), the map did not keep up, or there was no scan."""


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
    from shmmap_clients.ndt_scan_matcher.drive.follower import Follower, Frame, Tracking
    from shmmap_clients.ndt_scan_matcher.drive.pose_stream import PosePublisher
    from shmmap_clients.scan_drive import ScanDrive
    from shmmap_clients.scans.trajectory import read_route, tum_line

    _check_source(args)
    plot = DrivePlot()
    route = read_route(args.route) if args.route is not None else ()
    with contextlib.ExitStack() as stack:
        # open all sockets before the first scan: a publisher may wait for this subscription
        publisher = stack.enter_context(PosePublisher(args.publish)) if args.publish else None
        subscriber = _odometry(args, stack)
        reader = reader_from(args, "shmmap-ndt")
        topic = _topic(args, stack, reader) if args.scans is None else None
        drive = ScanDrive(
            args,
            "shmmap-ndt",
            args.truth,
            stack,
            reader=reader,
            one_line=True,
            rate=args.rate,
            bag=_bag_options(args),
            live=topic,
        )
        tum = drive.open_text(str(args.tum)) if args.tum else None
        if publisher is not None and args.listener_wait > 0:
            publisher.wait_for_subscriber(args.listener_wait)
        given = args.init is not None or args.rough is not None
        guess = topic.wait_guess() if topic is not None and not given else None
        first = drive.ahead(1)
        if not first:
            return drive.no_scans()
        T_first, known = _start(args, first[0]) if guess is None else (guess, not args.relocalize)
        prediction = _prediction(args, T_first, subscriber, drive, first[0].stamp_s)
        matcher = stack.enter_context(matcher_from(args))
        client = stack.enter_context(connect(args, "shmmap-ndt"))
        maps = stack.enter_context(_map_updater(args, client, matcher, route))
        relocalizer = _relocalizer(args, stack, is_live=drive.is_live)
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
            if subscriber is not None and args.odometry_wait > 0:
                subscriber.wait_until(scan.stamp_s, args.odometry_wait)
            if topic is not None and (guess := topic.take_guess()) is not None:
                follower.restart(guess, lost=relocalizer is not None)
                if relocalizer is not None:
                    relocalizer.restart()
            frame = follower.follow(scan)
            if topic is not None:
                topic.publish(frame)
            if args.plot:
                plot.add(frame, follower.map)
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
    late = {} if topic is None else {"scans_left_out": topic.left_out}
    if args.json:
        print_json({**summary.as_document(), **drive.reader.counts, **late})
    else:
        scans = f"{topic.left_out} scans, for newer ones" if topic is not None and topic.left_out else ""
        print_summary(summary, ", ".join(filter(None, [scans, drive.reader.left_out])))
    allowed = summary.no_map if args.allow_empty else 0
    return 0 if summary.trustworthy + allowed == summary.frames and not summary.too_slow else 1


def _check_source(args: argparse.Namespace) -> None:
    """Refuse options that contradict each other."""
    from shmmap import BadRequest

    if args.scans is None and args.topic is None:
        raise BadRequest(
            "no scans are named",
            hint="give --scans DIR, BAG or ENDPOINT, or --topic TOPIC of a running ROS 2 system",
        )
    if args.scans is not None and (args.publish_tf is not None or args.ros_args is not None):
        raise BadRequest("--publish-tf and --ros-args are for --topic of a running system, without --scans")
    if args.scans is None and args.truth is not None:
        raise BadRequest(
            "--truth is for --scans: a running system has no true poses", hint="start with --init"
        )


def _topic(args: argparse.Namespace, stack: contextlib.ExitStack, reader: ScanReader) -> RosTopic:
    """Return the scans of ``--topic``; from now on, signals end them."""
    from shmmap_clients.ros_node.needs import needs_ros

    with needs_ros("--topic without --scans"):
        from shmmap_clients.ndt_scan_matcher.drive.ros_topic import RosTopic
    with connect(args, "shmmap-ndt") as client:
        frame_id = client.frame_id
    words = [] if args.ros_args is None else ["--ros-args", *args.ros_args]
    topic = RosTopic(
        args.topic,
        reader,
        base_frame=args.base_frame,
        map_frame=frame_id,
        odom_frame=args.publish_tf,
        words=words,
    )
    return stack.enter_context(topic)


def _bag_options(args: argparse.Namespace) -> BagOptions:
    """Return what is taken from a bag: without a start pose, from the first scan that has a true one."""
    starts = args.init is not None or args.rough is not None
    return bag_options_from(args, without_pose="keep" if starts else "begin", poses_option="--truth")


def _odometry(args: argparse.Namespace, stack: contextlib.ExitStack) -> OdometrySubscriber | None:
    """Return a subscriber to the odometry endpoint; None if odometry is in a file or absent."""
    from shmmap_clients.ndt_scan_matcher.drive.pose_stream import OdometrySubscriber
    from shmmap_clients.streams import is_endpoint

    if args.odometry is None or not is_endpoint(args.odometry):
        return None
    subscriber = OdometrySubscriber(args.odometry)
    stack.callback(subscriber.close)
    return subscriber


def _map_updater(
    args: argparse.Namespace,
    client: Client,
    matcher: NdtMatcher,
    route: NDArray[np.float64] | Sequence[tuple[float, float]],
) -> MapUpdater:
    """Return the updater of the map around the vehicle."""
    from shmmap_clients.ndt_scan_matcher.map.map_updater import MapRules, MapUpdater

    rules = MapRules(
        args.update_distance,
        args.map_radius,
        args.lidar_radius,
        args.leaf,
        matcher.limits.voxels,
        max_bytes=matcher.limits.max_map_bytes,
    )
    return MapUpdater(client, rules, prepare=matcher.prepare, uploads=matcher.uploads, route=route)


def _start(args: argparse.Namespace, first: Scan) -> tuple[NDArray[np.float64], bool]:
    """Return the first pose of the drive, and whether it is accurately known."""
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
    subscriber: OdometrySubscriber | None,
    drive: ScanDrive,
    first_s: float,
) -> MotionPrediction:
    """Return the motion prediction; its first velocity comes from the truth or the route's times."""
    import numpy as np

    from shmmap_clients.ndt_scan_matcher.drive import motion_prediction
    from shmmap_clients.ndt_scan_matcher.drive.motion_prediction import ConstantVelocity, Odometry
    from shmmap_clients.scans.bag_scans import BagScans
    from shmmap_clients.scans.trajectory import Trajectory, read_trajectory

    if subscriber is not None:
        return Odometry(T_first, lambda: subscriber.trajectory)
    if args.odometry is None:
        # the second scan of a publisher is not waited for
        two = () if drive.is_live else drive.ahead(min(2, args.frames or 2))
        poses = [scan.T_map_sensor for scan in two if scan.T_map_sensor is not None]
        if poses and len(poses) == len(two):
            truth = Trajectory(np.array([scan.stamp_s for scan in two]), np.array(poses))
            return ConstantVelocity(T_first, motion_prediction.first_twist(truth))
        if args.route is not None and not args.route.lower().endswith(".csv"):
            route = read_trajectory(args.route)
            return ConstantVelocity(T_first, motion_prediction.twist_on_route(route, T_first))
        return ConstantVelocity(T_first)
    if isinstance(drive.scans, BagScans):
        read = drive.scans.motion(args.odometry)
    else:
        read = read_trajectory(args.odometry)
        for note in read.notes if args.odometry != args.truth else ():
            drive.reader.say(note)
    if note := not_covered(str(args.odometry), read, first_s):
        drive.reader.say(note)
    return Odometry(T_first, lambda: read)


def not_covered(name: str, odometry: Trajectory, first_s: float) -> str:
    """Return a note if odometry has no times near the first scan's; empty if it has."""
    low, high = float(odometry.stamps_s.min()), float(odometry.stamps_s.max())
    if low - _BEFORE_ODOMETRY_S <= first_s <= high:
        return ""
    return (
        f"{name} has times from {low:.12g} to {high:.12g} s, the first scan {first_s:.12g} s: no motion is"
        " known from it; scans of a directory have the times of --truth, else they count from 0"
    )


def _relocalizer(
    args: argparse.Namespace, stack: contextlib.ExitStack, *, is_live: bool
) -> Relocalizer | None:
    """Return the search for a lost vehicle, or None if it is disabled.

    The search opens its own session with the daemon at the first use.
    """
    from shmmap_clients.pose_initializer import InitializerRules, PoseInitializer, Relocalizer

    by_default = args.rough is not None or not is_live
    if not (by_default if args.relocalize is None else args.relocalize):
        return None
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

    guessed = args.scans is None and args.height is not None  # RViz knows no z
    knows_z = not guessed and (args.rough is None or args.pose_format != "xyyaw")
    return Relocalizer(initializer, sigma_m=args.sigma, sigma_yaw=args.sigma_yaw, knows_z=knows_z)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    add_scans_option(parser, live=True)
    parser.add_argument(
        "--truth",
        metavar="FILE|TOPIC",
        help="true poses to compare with and to start from: of the scans of a directory, TUM format; of the"
        " --base-frame of a bag, TUM format or their topic (default: the only one in frame map, else /tf); a"
        " publisher's scans bring theirs",
    )
    add_pose_option(
        parser,
        "--init",
        "start pose of the frame that the points are in (default: the first scan's true pose; of a running"
        " system what comes on /initialpose)",
    )
    add_pose_format_option(parser)
    parser.add_argument(
        "--odometry",
        metavar="FILE|TOPIC|ENDPOINT",
        help="motion between scans: a TUM file, a topic of the bag (poses or velocities of the vehicle), or"
        " poses over ZeroMQ (default: constant velocity)",
    )
    parser.add_argument(
        "--odometry-wait",
        type=seconds,
        default=0.0,
        metavar="SECONDS",
        help="how long a scan may wait until an endpoint's odometry has reached its time; else constant"
        " velocity is assumed from the last entry on (default: 0)",
    )
    add_thin_option(parser, default=1.0)
    parser.add_argument("--frames", type=at_least(1), metavar="N", help="stop after N scans")
    parser.add_argument(
        "--rate", type=positive, metavar="HZ", help="read at most HZ scans a second from a directory or a bag"
    )
    window = parser.add_argument_group("map around the vehicle, as in Autoware")
    add_leaf_option(window)
    add_radius_option(window)
    window.add_argument(
        "--update-distance",
        type=not_negative,
        default=20.0,
        metavar="M",
        help="distance after which the next map is asked for (default: 20)",
    )
    window.add_argument(
        "--lidar-radius",
        type=not_negative,
        default=100.0,
        metavar="M",
        help="range of the scanner: a scan waits where the map does not reach so far (default: 100)",
    )
    window.add_argument(
        "--route",
        metavar="FILE",
        help="the vehicle's path, in the map's frame: a TUM file, or x,y a line in a .csv; the"
        " daemon fetches the map along it beforehand (default: along the predicted motion)",
    )
    _add_ros_options(parser)
    _add_relocalization_options(parser)
    add_alignment_options(parser)
    _add_output_options(parser)
    add_daemon_options(parser, json=False)


def _add_ros_options(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group(
        "on a running ROS 2 system (--topic without --scans)",
        "Scans are those of the topic, of which only the newest counts; the start, or a new one, is a pose"
        " on /initialpose; trusted poses are published on ndt_pose_with_covariance.",
    )
    group.add_argument(
        "--publish-tf",
        nargs="?",
        const="odom",
        metavar="FRAME",
        help="publish the transform from the map's frame to this one on /tf, where that leads from"
        " --base-frame to it (default: none; FRAME: odom)",
    )
    group.add_argument(
        "--ros-args",
        nargs=argparse.REMAINDER,
        metavar="ARG",
        help="all that follows is ROS's: remaps, -p use_sim_time:=true",
    )


def _add_relocalization_options(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("when the vehicle is lost")
    group.add_argument(
        "--lost-after",
        type=at_least(1),
        default=5,
        metavar="N",
        help="lost after N results in a row that are not trusted (default: 5)",
    )
    group.add_argument(
        "--relocalize",
        action=argparse.BooleanOptionalAction,
        default=None,
        help="search for a lost vehicle as shmmap-pose-init does, around its last trusted pose and what"
        " odometry has added: with each scan until it is found, each time twice as far, up to eight times"
        " --sigma; without odometry, at the beginning and after a jump of the clock, with the first scan that"
        " is not trusted (default: for a directory and a bag, not for a publisher)",
    )
    add_pose_option(
        group,
        "--rough",
        "start pose that is metres and degrees off: search around it; --relocalize is then the default",
    )
    add_sigma_options(group)
    add_height_option(group, default=None, shown="keep the z of the pose that is searched around")


def _add_output_options(parser: argparse.ArgumentParser) -> None:
    out = parser.add_argument_group("output")
    out.add_argument("--tum", type=output_file, metavar="FILE", help="write the poses, TUM format")
    out.add_argument("--publish", metavar="ENDPOINT", help="publish the poses at this ZeroMQ address")
    out.add_argument(
        "--listener-wait",
        type=seconds,
        default=0.0,
        metavar="SECONDS",
        help="how long to wait for the first subscriber, which then gets every pose (default: 0)",
    )
    out.add_argument(
        "--plot",
        type=output_file,
        metavar="FILE",
        help="write an SVG of the path on the map, errors and latency",
    )
    add_json_lines_option(out)
    add_quiet_option(out)
    add_allow_empty(parser)
    add_json_option(parser)
