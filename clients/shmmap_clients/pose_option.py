# SPDX-License-Identifier: Apache-2.0
"""Poses on command lines: ``X,Y,Z,ROLL,PITCH,YAW`` in metres and radians, or as ``--pose-format`` says."""

from __future__ import annotations

import argparse
import math
from typing import TYPE_CHECKING, Any, Final

from shmmap import BadRequest

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

__all__ = ["add_pose_format_option", "add_pose_option", "pose_from", "pose_text"]

_POSE: Final = "X,Y,Z,ROLL,PITCH,YAW"
"""Metavar of options whose values are poses."""

_FORMATS: Final = {"rpy": _POSE, "tum": "X,Y,Z,QX,QY,QZ,QW", "xyyaw": "X,Y,YAW"}


def pose_numbers(text: str) -> tuple[float, ...]:
    """Read numbers with commas between them; `pose_from` knows how many there should be."""
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
    """Return the pose that an option (``"--init"``) was given, (4, 4) float64, metres, map frame.

    Raises
    ------
    BadRequest
        It has not as many numbers as ``--pose-format`` wants, or its quaternion is none.
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
    """Return a pose, (4, 4), as `pose_from` reads it: numbers with commas between them.

    Parameters
    ----------
    T
        Metres, map frame.
    pose_format
        As ``--pose-format`` names it; ``xyyaw`` leaves out height, roll and pitch.
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
    """Write metres to the millimetre, and rotations to the microradian; no number is -0."""
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
