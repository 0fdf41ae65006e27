# SPDX-License-Identifier: Apache-2.0
"""The ``[live.NAME]`` section of the daemon's settings that makes a map as a parameter file wants it."""

from __future__ import annotations

import json
import math
import os
import re
from typing import Final

import msgspec

from shmmap import BadRequest, ConfigError, Occupancy

__all__ = ["LiveSettings", "live_section"]

_NAME: Final = re.compile(r"[A-Za-z0-9_-]{1,64}")
_FRAME_BYTES: Final = 40  # in a chunk's header


class LiveSettings(msgspec.Struct, frozen=True):
    """What the daemon has to know of a live map.

    Attributes
    ----------
    resolution
        Edge of a voxel, metres.
    occupancy
        What a hit and a miss are worth.
    frame_id
        Frame of the map.
    radius, hysteresis
        The window: chunks around the vehicle's along each axis, and how far the vehicle has to be in another
        chunk until its window follows, as a part of a chunk.  Rolling-Bonxai keeps the 26 neighbours, and
        follows at once.
    path
        Directory of the map's files; empty: the daemon chooses.

    Raises
    ------
    ConfigError
        The resolution is no positive number, or a text is too long or cannot be printed.
    """

    resolution: float = 0.05
    occupancy: Occupancy = Occupancy()
    frame_id: str = "map"
    radius: int = 1
    hysteresis: float = 0.0
    path: str = ""

    def __post_init__(self) -> None:
        if not 0.0 < self.resolution < math.inf:
            raise ConfigError(
                f"resolution = {self.resolution!r}: need a positive number of metres", key="resolution"
            )
        size = len(self.frame_id.encode("utf-8", "replace"))
        if not self.frame_id or not self.frame_id.isprintable() or size > _FRAME_BYTES:
            raise ConfigError(
                f"frame_id = {self.frame_id!r}: need 1 to {_FRAME_BYTES} bytes of printable text",
                key="frame_id",
            )
        if not self.path.isprintable():
            raise ConfigError(f"path = {self.path!r}: need printable text", key="path")


def live_section(name: str, settings: LiveSettings) -> str:
    """Return the section as TOML; a relative path is made absolute.

    Raises
    ------
    BadRequest
        A map cannot have this name.
    """
    if not _NAME.fullmatch(name):
        raise BadRequest(f"{name!r} is no name of a map", hint="use letters, digits, _ and -")
    occupancy = settings.occupancy
    lines = [
        f"[live.{name}]",
        f"resolution = {settings.resolution!r}  # metres",
        f"frame_id = {_quoted(settings.frame_id)}",
        *(f"{field} = {getattr(occupancy, field)!r}" for field in occupancy.__struct_fields__),
        f"radius = {settings.radius}  # chunks of 64 voxels around the vehicle's",
        f"hysteresis = {settings.hysteresis!r}  # as a part of a chunk",
    ]
    if settings.path:
        lines.append(f"path = {_quoted(os.path.abspath(settings.path))}")
    return "\n".join(lines) + "\n"


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False)
