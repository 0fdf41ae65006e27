# SPDX-License-Identifier: Apache-2.0
"""From how far away alignments arrive: a pair of scans, and a scan in the generated city.

    SHMMAP_TEST_DATA=DIR python -m tests.benchmarks.ndt_basin [--starts 100]

Each start lies at the stated distance in a random direction (three dimensions) and is turned by up to the
stated angle about the vertical.  It succeeds within 0.15 m and 0.5 degrees of the result from an undisturbed
start.  Radius search, no line search; limit: at least 95% at 1 m and 3 degrees.
"""

from __future__ import annotations

import argparse
import os

import numpy as np
from numpy.typing import NDArray
from shmmap_clients.ndt_scan_matcher import NdtMatcher, Settings, VoxelMap, matrix_from_pose, voxel_cell

from tests.benchmarks.ndt_accuracy import errors
from tests.benchmarks.ndt_clouds import city, scan_pair

STARTS = ((0.5, 3.0), (1.0, 3.0), (1.5, 3.0), (2.0, 3.0), (1.0, 6.0))


def start(rng: np.random.Generator, metres: float, degrees: float, level: bool) -> NDArray[np.float64]:
    """A disturbance of a pose."""
    step = rng.normal(size=3)
    if level:
        step[2] = 0.0
    step *= metres / np.linalg.norm(step)
    return matrix_from_pose(np.array([*step, 0.0, 0.0, np.radians(rng.uniform(-degrees, degrees))]))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--starts", type=int, default=100)
    args = parser.parse_args()
    pair, town = scan_pair(), city()
    thinned = pair.source[np.random.default_rng(0).choice(len(pair.source), 2000, replace=False)]
    cases = (
        ("pair, leaf 1.0", pair.target, thinned, 1.0, pair.T_guess),
        ("pair, leaf 2.0", pair.target, thinned, 2.0, pair.T_guess),
        ("city, leaf 2.0", town.target, town.source, 2.0, town.T_guess),
    )
    print(
        f"load {os.getloadavg()[0]:.2f}; {args.starts} starts each; per cent that arrive (median iterations)"
    )
    for name, target, source, leaf, T_guess in cases:
        for mode in ("single", "coarse_fine"):
            with NdtMatcher(Settings(mode=mode, neighbors="radius", line_search=False)) as matcher:
                matcher.set_map(VoxelMap({"map": voxel_cell(target, leaf)}))
                truth = matcher.align(source, T_guess).T_map_base
                for level in (True, False):
                    words = []
                    for metres, degrees in STARTS:
                        rng = np.random.default_rng(7)
                        arrived, steps = 0, []
                        for _ in range(args.starts):
                            result = matcher.align(source, truth @ start(rng, metres, degrees, level))
                            m, deg = errors(result.T_map_base, truth)
                            arrived += m <= 0.15 and deg <= 0.5
                            steps.append(result.iterations)
                        share = 100 * arrived / args.starts
                        words.append(f"{metres} m {degrees:.0f} deg {share:5.1f}% ({np.median(steps):.0f})")
                    plane = "level" if level else "any  "
                    print(f"{name}, {mode:11} {plane} {'; '.join(words)}")


if __name__ == "__main__":
    main()
