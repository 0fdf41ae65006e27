# SPDX-License-Identifier: Apache-2.0
"""Options of several programs, with the same name, value and help in all of them.

Poses are ``X,Y,Z,ROLL,PITCH,YAW`` in metres and radians, or in the format of ``--pose-format``.
"""

from __future__ import annotations

import argparse
import math
import os
from typing import TYPE_CHECKING, Any, Final

from shmmap import BadRequest
from shmmap_clients.command_line import at_least, complain, finite, not_negative, positive

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from shmmap_clients.ndt_scan_matcher import DeviceOptions, TrustLimits
    from shmmap_clients.scans.bag_scans import BagOptions
    from shmmap_clients.scans.bin_layout import BinLayout
    from shmmap_clients.scans.scan_file import ScanReader

Parser = argparse.ArgumentParser | argparse._ArgumentGroup
FAILED_LIMITS: Final = """\
failed_limits names what did not hold: no_map, converged (the alignment did not
converge), nvtl, transform_probability, oscillations, points, distance,
angle, sharpness, spread."""
_POSE: Final = "X,Y,Z,ROLL,PITCH,YAW"
"""Metavar of options whose values are poses."""
_FORMATS: Final = {"rpy": _POSE, "tum": "X,Y,Z,QX,QY,QZ,QW", "xyyaw": "X,Y,YAW"}


def add_scan_option(parser: Parser) -> None:
    """Add ``--scan``, see `shmmap_clients.scan_drive.read_one_scan`, and the options of reading it."""
    parser.add_argument(
        "--scan",
        required=True,
        metavar="FILE|BAG@SECONDS",
        help="scan: PCD, NPZ (xyz or xyz_4mm), or bare rows in a .bin; or that of a bag (rosbag2) nearest to"
        " a time since its begin",
    )
    _add_bin_option(parser)
    _add_bag_options(parser)
    add_min_range_option(parser)


def add_scans_option(parser: Parser, *, min_range: bool = True, live: bool = False) -> None:
    """Add ``--scans``, see `shmmap_clients.scan_drive.open_scans`, and the options of reading them.

    ``live``: without it, ``--topic`` is a topic of the running system.
    """
    parser.add_argument(
        "--scans",
        required=not live,
        metavar="DIR|BAG|ENDPOINT",
        help="scans: a directory (PCD, NPZ, .bin; in the order of their names), a bag (rosbag2: a directory,"
        " .db3 or .mcap), or the ZeroMQ address of a publisher",
    )
    _add_bin_option(parser)
    _add_bag_options(parser)
    if min_range:
        add_min_range_option(parser)


def add_poses_option(parser: Parser) -> None:
    """Add ``--poses``."""
    parser.add_argument(
        "--poses",
        metavar="FILE|TOPIC",
        help="poses of the frame that the points are in, for the scans of a directory, TUM format; for a bag"
        " those of its --base-frame, TUM format or their topic (default: the only one in the map's frame,"
        " else /tf); a publisher's scans bring theirs",
    )


def add_json_lines_option(parser: Parser) -> None:
    """Add ``--json-lines``."""
    parser.add_argument(
        "--json-lines", metavar="FILE", help="write a line of JSON for each scan (-: to standard output)"
    )


def _add_bin_option(parser: Parser) -> None:
    parser.add_argument(
        "--bin-columns",
        type=_bin_layout,
        metavar="NAMES",
        help="columns of .bin files, such as x,y,z,intensity,ring: float32, or as x:f8,y,z,t:u4 says; _ skips"
        " one (default: recognised by their numbers, and said)",
    )


def _add_bag_options(parser: Parser) -> None:
    parser.add_argument(
        "--topic", metavar="TOPIC", help="clouds of a bag (default: its only topic of PointCloud2)"
    )
    parser.add_argument(
        "--base-frame",
        default="base_link",
        metavar="FRAME",
        help="frame of the vehicle: poses of a bag are of it, and scans are transformed to it by /tf_static"
        " (of shmmap-rolling they stay in the scanner's; default: base_link)",
    )


def bag_options_from(args: argparse.Namespace, **settings: Any) -> BagOptions:
    """Return what is taken from a bag: the options, and a program's ``settings`` of `BagOptions`."""
    from shmmap_clients.scans.bag_scans import BagOptions

    return BagOptions(args.topic, args.base_frame, **settings)


def _bin_layout(text: str) -> BinLayout:
    from shmmap import BadRequest
    from shmmap_clients.scans.bin_layout import BinLayout

    try:
        return BinLayout.parse(text)
    except BadRequest as error:
        raise argparse.ArgumentTypeError(f"{error.message} ({error.hint})") from None


def add_min_range_option(parser: Parser) -> None:
    """Add ``--min-range``."""
    parser.add_argument(
        "--min-range",
        type=not_negative,
        default=0.5,
        metavar="M",
        help="leave out points of the scan nearer than that to its frame's origin: no-returns at (0, 0, 0)"
        " (default: 0.5; 0: none)",
    )


def reader_from(args: argparse.Namespace, name: str, **settings: Any) -> ScanReader:
    """Return a reader of scans with the options; it prints notes on stderr, unless ``--quiet``.

    Parameters
    ----------
    args
    name
        Name of the program.
    settings
        Settings of `ScanReader` that override the options.
    """
    from shmmap_clients.scans.scan_file import ScanReader

    def say(note: str) -> None:
        if not getattr(args, "quiet", False):
            complain(name, note)

    given = {"bin_layout": args.bin_columns, "min_range": getattr(args, "min_range", None), "say": say}
    return ScanReader(**{**given, **settings})


def add_leaf_option(parser: Parser) -> None:
    """Add ``--leaf``."""
    parser.add_argument(
        "--leaf", type=positive, default=2.0, metavar="M", help="edge length of an NDT voxel (default: 2)"
    )


def add_thin_option(parser: Parser, *, default: float) -> None:
    """Add ``--thin``."""
    shown = (
        f"{default:g}; 0: use all points"
        if default
        else "0: use all points, to equal the original programs; 1 is recommended: about 20 times faster,"
        " and more accurate"
    )
    parser.add_argument(
        "--thin",
        type=not_negative,
        default=default,
        metavar="M",
        help=f"replace the scan's points in each cube of M metres by their mean (default: {shown})",
    )


def add_radius_option(parser: Parser) -> None:
    """Add ``--map-radius``."""
    parser.add_argument(
        "--map-radius",
        type=positive,
        default=150.0,
        metavar="M",
        help="how far around the vehicle the map is kept (default: 150)",
    )


def add_backend_option(parser: Parser) -> None:
    """Add ``--backend``."""
    parser.add_argument(
        "--backend",
        default="numba",
        metavar="NAME",
        help="numba, or numpy: same results, slower, no compiler (default: numba)",
    )


def add_threads_option(parser: Parser, *, all_processors: bool = False) -> None:
    """Add ``--threads``; by default one, or the number of processors, but at most four."""
    parser.add_argument(
        "--threads",
        type=int,
        default=min(len(os.sched_getaffinity(0)), 4) if all_processors else 1,
        metavar="N",
        help="threads to compute with; results do not depend on it (default:"
        f" {'as many as there are processors, at most 4' if all_processors else '1'})",
    )


def add_quiet_option(parser: Parser) -> None:
    """Add ``--quiet``."""
    parser.add_argument("--quiet", action="store_true", help="no progress on stderr")


def add_sigma_options(parser: Parser) -> None:
    """Add ``--sigma`` and ``--sigma-yaw``."""
    parser.add_argument(
        "--sigma",
        type=positive,
        default=2.0,
        metavar="M",
        help="how far off the rough x and y may be, standard deviation (default: 2)",
    )
    parser.add_argument(
        "--sigma-yaw",
        type=positive,
        default=0.1745,
        metavar="RAD",
        help="how far off the rough yaw may be, standard deviation; 3.14: the yaw is unknown (default:"
        " 0.1745, 10 degrees)",
    )


def add_height_option(parser: Parser, *, default: float | None, shown: str) -> None:
    """Add ``--height``."""
    parser.add_argument(
        "--height",
        type=finite,
        default=default,
        metavar="M",
        help=f"height of the frame that the points are in above the map's ground (default: {shown})",
    )


def add_scoring_options(parser: Parser, *, all_processors: bool = False) -> None:
    """Add ``--backend``, ``--fallback``, ``--threads`` (see `add_threads_option`), and devices' options."""
    parser.add_argument(
        "--backend",
        default="numba",
        metavar="NAME",
        help="numba; numpy: same results, slower, no compiler; or opencl: same results, on a GPU or any other"
        " device with a driver (default: numba)",
    )
    parser.add_argument(
        "--fallback",
        metavar="NAME",
        help="backend that goes on, and says so, when the device fails in the middle of the work (default:"
        " that is an error)",
    )
    add_device_options(parser)
    add_threads_option(parser, all_processors=all_processors)


def add_device_options(parser: Parser) -> None:
    """Add ``--device``, ``--precision`` and ``--memory``."""
    parser.add_argument(
        "--device",
        metavar="INDEX|NAME",
        help="device for --backend opencl, as `shmmap-ndt devices` lists them (default: SHMMAP_OPENCL_DEVICE,"
        " or the first GPU, else the first device)",
    )
    parser.add_argument(
        "--precision",
        choices=("auto", "double", "float"),
        default="auto",
        help="of a device; auto: double where it has that (default: auto)",
    )
    parser.add_argument(
        "--memory",
        choices=("auto", "svm", "copy"),
        default="auto",
        help="where the map lies for a device: svm reads shared memory in place, copy copies each map;"
        " auto: in place where the device says that it can (default: auto)",
    )


def device_options_from(args: argparse.Namespace) -> DeviceOptions:
    """Return the device options: which device, precision and memory."""
    from shmmap_clients.ndt_scan_matcher import DeviceOptions

    return DeviceOptions(args.device, args.precision, args.memory)


def scoring_settings(args: argparse.Namespace) -> dict[str, Any]:
    """Return the values of these options for `Settings`."""
    return {"backend": args.backend, "device": device_options_from(args), "fallback": args.fallback}


def add_trust_options(parser: argparse.ArgumentParser) -> None:
    """Add the limits beyond which a pose is not trusted."""
    trust = parser.add_argument_group("trust (a result beyond one of these limits is not trusted)")
    trust.add_argument(
        "--trust-nvtl",
        type=not_negative,
        metavar="N",
        help="lowest nearest-voxel transformation likelihood (default by --leaf: 1.22 at 1 m, 2.30 at 2 m,"
        " 2.96 at 3 m; for alignments with true covariances 0.91 at 1 m)",
    )
    trust.add_argument(
        "--trust-tp", type=not_negative, metavar="N", help="lowest transform probability (default: any)"
    )
    trust.add_argument(
        "--trust-oscillations",
        type=at_least(0),
        default=10,
        metavar="N",
        help="most reversals of the step (default: 10)",
    )
    trust.add_argument(
        "--trust-points",
        type=at_least(0),
        default=80,
        metavar="N",
        help="least points of the scan with a voxel of the map near (default: 80)",
    )
    trust.add_argument(
        "--trust-distance",
        type=not_negative,
        default=10.0,
        metavar="M",
        help="20 points of the scan must be at least so far away (default: 10)",
    )
    trust.add_argument(
        "--trust-angle",
        type=not_negative,
        default=35.0,
        metavar="DEG",
        help="least width of the sector that the points of the scan lie in (default: 35)",
    )
    trust.add_argument(
        "--trust-sharpness",
        type=not_negative,
        metavar="N",
        help="lowest curvature of the score per matched point in any direction (default: 2.7; for alignments"
        " with true covariances 3.4)",
    )
    trust.add_argument(
        "--trust-spread",
        type=not_negative,
        default=0.03,
        metavar="N",
        help="lowest ratio of the variances of the position in its most and least certain directions, 0 to 1"
        " (default: 0.03)",
    )


def trust_from(args: argparse.Namespace) -> TrustLimits:
    """Return the limits of trust of the options."""
    from shmmap_clients.ndt_scan_matcher import TrustLimits

    return TrustLimits(
        nvtl=args.trust_nvtl,
        transform_probability=args.trust_tp,
        oscillations=args.trust_oscillations,
        points=args.trust_points,
        distance=args.trust_distance,
        angle=args.trust_angle,
        sharpness=args.trust_sharpness,
        spread=args.trust_spread,
    )


def pose_numbers(text: str) -> tuple[float, ...]:
    """Parse numbers separated by commas; `pose_from` checks their count."""
    try:
        values = tuple(float(word) for word in text.split(","))
    except ValueError:
        values = ()
    if len(values) not in {names.count(",") + 1 for names in _FORMATS.values()} or not all(
        map(math.isfinite, values)
    ):
        raise argparse.ArgumentTypeError(f"expected a pose {_POSE}, not {text!r}")
    return values


def add_pose_format_option(parser: argparse.ArgumentParser | argparse._ArgumentGroup) -> None:
    """Add ``--pose-format``."""
    parser.add_argument(
        "--pose-format",
        choices=tuple(_FORMATS),
        default="rpy",
        help="how poses are written in options, and printed: rpy: X,Y,Z,ROLL,PITCH,YAW in metres and radians,"
        " about fixed axes as in ROS (default); tum: X,Y,Z,QX,QY,QZ,QW; xyyaw: X,Y,YAW",
    )


def pose_from(args: argparse.Namespace, option: str) -> NDArray[np.float64]:
    """Return the pose in the value of an option (``"--init"``), (4, 4) float64, metres, map frame.

    Raises
    ------
    BadRequest
        The count of numbers differs from ``--pose-format``, or the quaternion is invalid.
    """
    from shmmap_clients.scans.trajectory import matrix_of

    numbers: tuple[float, ...] = getattr(args, option.lstrip("-").replace("-", "_"))
    names = _FORMATS[args.pose_format]
    if len(numbers) != names.count(",") + 1:
        fitting = [name for name, other in _FORMATS.items() if other.count(",") + 1 == len(numbers)]
        raise BadRequest(
            f"{option}: expected {names.count(',') + 1} numbers {names}, not {len(numbers)}",
            hint=f"{_FORMATS[fitting[0]]} is --pose-format {fitting[0]}",
        )
    if args.pose_format == "tum":
        return matrix_of(numbers[:3], numbers[3:])
    if args.pose_format == "xyyaw":
        return matrix_of((*numbers[:2], 0.0), _quaternion(0.0, 0.0, numbers[2]))
    return matrix_of(numbers[:3], _quaternion(*numbers[3:]))


def pose_text(T: NDArray[np.float64], pose_format: str) -> str:
    """Return a pose, (4, 4), as text for `pose_from`: numbers separated by commas.

    Parameters
    ----------
    T
        Pose, metres, map frame.
    pose_format
        Value of ``--pose-format``; ``xyyaw`` omits height, roll and pitch.
    """
    from shmmap_clients.scans.trajectory import quaternion_of

    r, (x, y, z) = T[:3, :3], T[:3, 3].tolist()
    yaw = math.atan2(r[1, 0], r[0, 0])
    if pose_format == "tum":
        return _numbers((x, y, z), quaternion_of(r))
    if pose_format == "xyyaw":
        return _numbers((x, y), (yaw,))
    roll, pitch = math.atan2(r[2, 1], r[2, 2]), math.atan2(-r[2, 0], math.hypot(r[0, 0], r[1, 0]))
    return _numbers((x, y, z), (roll, pitch, yaw))


def _numbers(metres: tuple[float, ...], rotation: tuple[float, ...]) -> str:
    """Format metres to the millimetre, and rotations to the microradian, without -0."""
    words = [f"{round(value, 3) + 0.0:.3f}" for value in metres]
    return ",".join(words + [f"{round(value, 6) + 0.0:.6f}" for value in rotation])


def _quaternion(roll: float, pitch: float, yaw: float) -> tuple[float, float, float, float]:
    """Return x, y, z, w of R = Rz(yaw) Ry(pitch) Rx(roll): REP-103, "fixed axis"."""
    (cr, sr), (cp, sp), (cy, sy) = (
        (math.cos(angle / 2), math.sin(angle / 2)) for angle in (roll, pitch, yaw)
    )
    return (
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )


def add_pose_option(
    parser: argparse.ArgumentParser | argparse._ArgumentGroup,
    option: str,
    help: str,  # noqa: A002
    **settings: Any,
) -> None:
    """Add an option whose value is a pose; `pose_from` reads it."""
    parser.add_argument(option, type=pose_numbers, metavar=_POSE, help=help, **settings)
