# SPDX-License-Identifier: Apache-2.0
"""The ``sample`` layer: fewer points, every n-th or a random choice that is the same everywhere."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from shmmap.errors import BadRequest
from shmmap.layers.contract import LayerColumn, LayerKind, LayerTable, Parameter, Parameters, PointTable

__all__ = ["KIND", "build_sample"]


def _mixed(rows: int, seed: int) -> NDArray[np.uint64]:
    """Return a random number for each row: SplitMix64 (Steele, Lea, Flood 2014) of seed and row.

    numpy's generators may give other streams in other versions of numpy; this gives the same
    choice for ever.
    """
    with np.errstate(over="ignore"):
        state = np.arange(1, rows + 1, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)
        state += np.uint64(seed) * np.uint64(0xD1342543DE82EF95)
        state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        mixed: NDArray[np.uint64] = state ^ (state >> np.uint64(31))
    return mixed


def build_sample(points: PointTable, parameters: Parameters) -> LayerTable:
    """Choose points; they stay in the source's order, with every column."""
    rows = np.flatnonzero(points.finite())
    if "every" in parameters:
        return points.selected(rows[:: int(parameters["every"])])
    count = int(parameters["count"])
    if count < len(rows):
        chosen = np.argsort(_mixed(len(rows), int(parameters["seed"])), kind="stable")[:count]
        rows = rows[np.sort(chosen)]
    return points.selected(rows)


def _resolve(parameters: Parameters) -> Parameters:
    if ("every" in parameters) == ("count" in parameters):
        raise BadRequest(
            "sample needs either every or count", hint="such as sample(every=10) or sample(count=5000,seed=1)"
        )
    if "every" in parameters:
        if parameters["seed"] != 0:
            raise BadRequest("sample: seed belongs to count")
        return {"every": parameters["every"]}
    return parameters


KIND: Final = LayerKind(
    name="sample",
    builder_version=1,
    summary="some of the points, with every column: every n-th, or a random choice",
    borders="each cell is sampled alone: count is a cell's, and every starts anew in each cell",
    parameters=(
        Parameter("every", int, "keep the first of each so many points", minimum=1, maximum=1 << 40),
        Parameter("count", int, "keep so many points, chosen at random", minimum=1, maximum=1 << 40),
        Parameter("seed", int, "which random choice", default=0, minimum=0, maximum=(1 << 32) - 1),
    ),
    columns=(
        LayerColumn("xyz", None, "(rows, 3)", "m", "coordinates, map frame, in the source's order"),
        LayerColumn("*", None, "as in the source", "", "every other field"),
    ),
    build=build_sample,
    resolve=_resolve,
    gives_points=True,
    needs=None,
    bytes_ratio=0.5,
)
