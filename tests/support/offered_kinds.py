# SPDX-License-Identifier: Apache-2.0
"""A package that offers layer kinds by entry point, made on the spot, as somebody else would install it."""

from __future__ import annotations

from pathlib import Path

MODULE = '''
import os
import numpy as np
from shmmap.layers.contract import LayerColumn, LayerKind, LayerTable, Parameter


def around(points, parameters):
    """Per cell: how many points it has, and how many its neighbours have within the radius."""
    halo = points.halo if points.halo is not None else np.empty((0, 3))
    counts = np.array([len(points), len(halo)], np.int64)
    return LayerTable({"counts": counts}, rows=2, units={"counts": ""})


def broken(points, parameters):
    if parameters["how"] == 1:
        os.abort()
    raise RuntimeError("the builder has a defect")


AROUND = LayerKind(
    name="around", builder_version=1, summary="counts points", borders="looks radius beyond",
    parameters=(Parameter("radius", float, "how far", "m", required=True, above=0.0, maximum=100.0),),
    columns=(LayerColumn("counts", np.dtype("<i8"), "(2,)", "", "own and around"),),
    build=around, halo_m=lambda parameters: float(parameters["radius"]), takes_layers=False,
)
BROKEN = LayerKind(
    name="broken", builder_version=1, summary="fails", borders="none",
    parameters=(Parameter("how", int, "0 raises, 1 aborts", default=0, minimum=0, maximum=1),),
    columns=(), build=broken,
)
'''

ENTRY_POINTS = """
[shmmap.layers]
around = offered_kinds:AROUND
broken = offered_kinds:BROKEN
absent = offered_kinds_that_do_not_exist:KIND
"""


def install(directory: Path) -> str:
    """Make the package in ``directory``; returns what to put on the module path."""
    information = directory / "offered_kinds-1.0.dist-info"
    information.mkdir(parents=True)
    (information / "METADATA").write_text("Metadata-Version: 2.1\nName: offered-kinds\nVersion: 1.0\n")
    (information / "entry_points.txt").write_text(ENTRY_POINTS)
    (directory / "offered_kinds.py").write_text(MODULE)
    return str(directory)
