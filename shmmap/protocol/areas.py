# SPDX-License-Identifier: Apache-2.0
"""Common parts of messages: the request's id, areas, the client's intent, and the cells it holds already."""

from __future__ import annotations

from typing import Annotated, Final, TypeAlias

import msgspec

import shmmap.geometry as geometry
from shmmap.errors import BadRequest

FURTHEST_M: Final = 1e150
"""Bound of a sphere's centre and radius, metres, so that their squares stay finite."""
MAX_VERTICES: Final = 4096
"""Most vertices of a route in a message; the daemon uses only the first ones."""


class Message(msgspec.Struct, array_like=True):
    """A request or a reply; ``request`` is the id that the client chose for the request."""

    request: int


class _Round(msgspec.Struct, array_like=True, frozen=True):
    """Fields of areas around a place; without a z range if its bounds are nil."""

    x: float
    y: float
    radius: float
    z_min: float | None = None
    z_max: float | None = None


class CircleMessage(_Round, tag="circle", frozen=True):
    """True circle."""


class SquareMessage(_Round, tag="square", frozen=True):
    """Autoware's square of half-side ``radius``."""


class BoxMessage(msgspec.Struct, array_like=True, tag="box", frozen=True):
    """Axis-aligned rectangle."""

    min_x: float
    min_y: float
    max_x: float
    max_y: float
    z_min: float | None = None
    z_max: float | None = None


class SphereMessage(msgspec.Struct, array_like=True, tag="sphere", frozen=True):
    """Voxels whose centres are within ``radius`` of a place; metres."""

    x: float
    y: float
    z: float
    radius: float


AreaMessage: TypeAlias = CircleMessage | SquareMessage | BoxMessage
LiveArea: TypeAlias = BoxMessage | SphereMessage
"""An area of a live map."""


def area_from_message(message: AreaMessage) -> geometry.Area:
    """Return the area that a message describes; raise `BadRequest` if it is invalid."""
    z = None
    if (message.z_min is None) != (message.z_max is None):
        raise BadRequest("a z range needs both bounds", hint="give z_min and z_max, or neither")
    if message.z_min is not None and message.z_max is not None:
        z = (message.z_min, message.z_max)
    if isinstance(message, CircleMessage):
        return geometry.Circle(message.x, message.y, message.radius, z)
    if isinstance(message, SquareMessage):
        return geometry.AutowareSquare(message.x, message.y, message.radius, z)
    return geometry.Box(message.min_x, message.min_y, message.max_x, message.max_y, z)


def area_to_message(area: geometry.Area) -> AreaMessage:
    """Return the message that describes an area."""
    if not isinstance(area, (geometry.Circle, geometry.AutowareSquare, geometry.Box)):
        raise TypeError(f"an area is a Circle, a Box or an AutowareSquare, not {area!r}")
    z = area.z if area.z is not None else (None, None)
    if isinstance(area, geometry.Circle):
        return CircleMessage(area.x, area.y, area.radius, *z)
    if isinstance(area, geometry.AutowareSquare):
        return SquareMessage(area.x, area.y, area.radius, *z)
    return BoxMessage(area.min_x, area.min_y, area.max_x, area.max_y, *z)


class Intent(msgspec.Struct, array_like=True, frozen=True):
    """Pose, velocity and route of a client: metres and metres per second, map frame.

    ``route`` is the polyline ahead, a sequence of (x, y).
    """

    x: float
    y: float
    vx: float = 0.0
    vy: float = 0.0
    heading: float | None = None
    route: Annotated[tuple[tuple[float, float], ...], msgspec.Meta(max_length=MAX_VERTICES)] = ()


class HeldCell(msgspec.Struct, array_like=True, frozen=True, gc=False):
    """A cell that the client holds: version nil means the current one, layers nil all requested ones.

    A version identifies the layer that has it, among the named or requested layers.
    """

    id: str
    version: int | None = None
    layers: tuple[str, ...] | None = None
