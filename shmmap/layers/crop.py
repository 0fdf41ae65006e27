# SPDX-License-Identifier: Apache-2.0
"""The ``crop`` layer: the points between two heights."""

from __future__ import annotations

import math
from typing import Final

from shmmap.errors import BadRequest
from shmmap.layers.contract import LayerColumn, LayerKind, LayerTable, Parameter, Parameters, PointTable

__all__ = ["KIND", "build_crop"]


def build_crop(points: PointTable, parameters: Parameters) -> LayerTable:
    """Keep points of ``z_min <= z <= z_max``, with every column."""
    z = points.xyz[:, 2]
    inside = points.finite()
    inside &= z >= float(parameters.get("z_min", -math.inf))
    inside &= z <= float(parameters.get("z_max", math.inf))
    return points.selected(inside)


def _resolve(parameters: Parameters) -> Parameters:
    low, high = parameters.get("z_min", -math.inf), parameters.get("z_max", math.inf)
    if not parameters or low > high:
        raise BadRequest(
            "crop needs z_min, z_max, or both with z_min <= z_max", hint="such as crop(z_min=-2.0,z_max=3.0)"
        )
    return parameters


KIND: Final = LayerKind(
    name="crop",
    builder_version=1,
    summary="the points between two heights, with every column",
    borders="each point is judged alone",
    parameters=(
        Parameter("z_min", float, "lowest z kept", "m"),
        Parameter("z_max", float, "highest z kept", "m"),
    ),
    columns=(
        LayerColumn("xyz", None, "(rows, 3)", "m", "coordinates, map frame, in the source's order"),
        LayerColumn("*", None, "as in the source", "", "every other field"),
    ),
    build=build_crop,
    resolve=_resolve,
    gives_points=True,
    needs=None,
    bytes_ratio=0.7,
)
