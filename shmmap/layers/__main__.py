# SPDX-License-Identifier: Apache-2.0
"""``python -m shmmap.layers SPEC CLOUD OUT.npz``: compute a layer of a cloud file, without a daemon.

OUT contains the layer's columns by name and, if the layer has a lattice, ``lattice_leaf``, ``lattice_first``
and ``lattice_shape`` (x, y, z).
"""

from __future__ import annotations

import argparse
import sys
from typing import Any

import numpy as np

from shmmap.errors import ShmmapError
from shmmap.formats.cloud import read_cloud
from shmmap.formats.durable_file import appearing_file, writing_errors
from shmmap.layers.build import build_layer
from shmmap.layers.spec import kinds


def main(arguments: list[str] | None = None) -> int:
    """Build the layer, write it, and return the exit code."""
    known = "\n".join(f"  {kind.describe()}: {kind.summary}" for kind in kinds())
    parser = argparse.ArgumentParser(
        prog="python -m shmmap.layers",
        description="Build a layer of a cloud file into an NPZ file.",
        epilog=f"layers:\n{known}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("spec", metavar="SPEC", help="a layer, such as 'ndt(leaf=2.0)'")
    parser.add_argument("cloud", metavar="CLOUD", help="PCD, PLY, PTS or XYZ file")
    parser.add_argument("out", metavar="OUT", help="file to write, .npz")
    args = parser.parse_args(arguments)
    try:
        table = build_layer(args.spec, read_cloud(args.cloud).columns)
        columns: dict[str, Any] = dict(table.columns)
        if table.lattice is not None:
            columns |= {f"lattice_{key}": np.array(v) for key, v in table.lattice._asdict().items()}
        with writing_errors(args.out), appearing_file(args.out) as file:
            np.savez(file, **columns)
    except ShmmapError as error:
        sys.stderr.write(f"{parser.prog}: {error}\n")
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main())
