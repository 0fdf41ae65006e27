# SPDX-License-Identifier: Apache-2.0
"""Define a layer kind: roughness of the ground, as the standard deviation of z in each square.

A package provides a kind by an entry point in its pyproject.toml:

    [project.entry-points."shmmap.layers"]
    roughness = "roughness_layer:KIND"

Install the package next to shmmap and restart the daemon; clients can then request ``roughness(edge=1.0)``.

    python3 roughness_layer.py                        # checks the kind, without a daemon
"""

from __future__ import annotations

import numpy as np

from shmmap.layers import LayerKind, LayerTable
from shmmap.layers.contract import Columns, LayerColumn, Parameter, Parameters, PointTable


def build(points: PointTable, parameters: Parameters) -> LayerTable:
    """Return the layer of one cell; a pure function, so that every process computes the same bytes."""
    xyz = points.xyz[points.finite()].astype(np.float64)
    index = np.floor(xyz[:, :2] / parameters["edge"]).astype(np.int64)
    squares, member = np.unique(index, axis=0, return_inverse=True)
    member, rows = member.reshape(-1), len(squares)
    count = np.bincount(member, minlength=rows)
    mean = np.bincount(member, xyz[:, 2], rows) / count
    variance = np.bincount(member, (xyz[:, 2] - mean[member]) ** 2, rows) / count
    columns: Columns = {"square": squares.reshape(-1, 2), "roughness": np.sqrt(variance).astype(np.float32)}
    return LayerTable(columns, rows, {"roughness": "m"})


KIND = LayerKind(
    name="roughness",
    builder_version=1,  # increase it when the output changes, so that caches rebuild the layer
    summary="standard deviation of z in each square of the ground",
    borders="a square that the border cuts is in each cell, from that cell's points alone",
    parameters=(Parameter("edge", float, "side of a square", unit="m", above=0.0, required=True),),
    columns=(
        LayerColumn("square", np.dtype("<i8"), "(squares, 2)", "", "floor(x / edge), floor(y / edge)"),
        LayerColumn("roughness", np.dtype("<f4"), "(squares,)", "m", "standard deviation of z"),
    ),
    build=build,
)


def main() -> None:
    """Check the contract of layer kinds on clouds of every sort."""
    from shmmap.layers.spec import register
    from shmmap.testing.layer_conformance import CORNERS, check_layer

    register(KIND)  # in this process; the entry point does it in all processes
    for cloud in CORNERS:
        check_layer(f"{KIND.name}(edge=1.0)", cloud)
    print(f"{KIND.describe()} is a layer kind")


if __name__ == "__main__":
    main()
