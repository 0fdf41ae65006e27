# SPDX-License-Identifier: Apache-2.0
"""The program of the live demonstration that maps: it is killed on the way, and started again.

``python -m shmmap.demo.live_mapper ENDPOINT NAME SCANS`` first prints the number of the scan that the live
map NAME needs next.  For each line of stdin, the number of a scan, it adds ``SCANS/<number>.npz`` to the map
and prints how many scans are in it.  It ends after stdin, when all are in the map.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Final

import numpy as np

from shmmap.chunks.occupancy import ScanFilter
from shmmap.errors import InternalError

__all__ = ["FILTER", "main"]

FILTER: Final = ScanFilter(min_range=1.0, max_range=20.0, min_z=-8.0, max_z=12.0)
"""Which points of the demonstration's scans count."""


def main(argv: list[str]) -> int:
    """Map until stdin ends."""
    import shmmap

    endpoint, name, scans = argv
    with (
        shmmap.connect(endpoint, name="demo mapper") as client,
        client.live(name).mapper("demo", FILTER) as mapper,
    ):
        _print(mapper.applied + 1)
        for line in sys.stdin:
            number = int(line)
            with np.load(Path(scans, f"{number}.npz")) as scan:
                sent = mapper.add(scan["xyz"], scan["pose"])
            if sent != number:
                raise InternalError(f"scan {number} was sent as {sent}")
            _print(mapper.applied)
        mapper.wait_applied()
    return 0


def _print(number: int) -> None:
    sys.stdout.write(f"{number}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
