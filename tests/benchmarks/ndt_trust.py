# SPDX-License-Identifier: Apache-2.0
"""Which scores right and wrong poses have, by leaf size: where the default limits of trust come from.

    SHMMAP_TEST_DATA=DIR python -m tests.benchmarks.ndt_trust [--seeds 12]

Scans of a street, thinned to one point per 1 m and per 3 m (Autoware's sampling), are started 0.3 m
to 16 m from the true pose, in steady steps.  Right is a result within 0.3 m, wrong one beyond 1 m.  Shares
are of the highest NVTL that a leaf size allows.  Limits: at
most 0.5 % of the wrong results are trusted, at most 2 % of the right ones refused for their NVTL.
"""

from __future__ import annotations

import argparse

import numpy as np
from numpy.typing import NDArray
from shmmap_clients.ndt_scan_matcher import NdtMatcher, Settings, VoxelMap, matrix_from_pose, voxel_cell
from shmmap_clients.ndt_scan_matcher.drive.trajectory_error import pose_errors
from shmmap_clients.ndt_scan_matcher.matching.evaluation import gauss_for
from shmmap_clients.ndt_scan_matcher.matching.trust import default_nvtl
from shmmap_clients.scans.scan_file import read_scan
from shmmap_clients.scans.thinning import thinned

from tests.benchmarks.street_data import street

AWAY_M = (0.3, 1.0, 2.0, 4.0, 8.0, 16.0)


def start(T: NDArray[np.float64], index: int, seed: int) -> NDArray[np.float64]:
    """Return a pose beside the true one, turned the more the farther it is."""
    rng = np.random.default_rng([index, seed])
    way, away = rng.uniform(0, 2 * np.pi), AWAY_M[seed % len(AWAY_M)]
    turn = rng.normal(0.0, 0.05 * (1 + away / 4))
    off = matrix_from_pose(np.array([away * np.cos(way), away * np.sin(way), 0, 0, 0, turn]))
    return np.asarray(T @ off, np.float64)


def spread(values: NDArray[np.float64]) -> str:
    """Return lowest, first and 99th percentile, and highest."""
    return " ".join(f"{v:.2f}" for v in np.percentile(values, (0, 1, 99, 100))) if len(values) else "-"


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=12)
    args = parser.parse_args()
    way = street()
    cloud, truth = read_scan(way.thinned_map_file), way.T_map_scans
    print("shares of NVTL are the lowest, those of 1 % and 99 %, and the highest")
    print("leaf thin mode         limit share   right: refused of, shares   wrong: trusted of, shares")
    for leaf in (1.0, 2.0, 3.0):
        voxel_map = VoxelMap({"map": voxel_cell(cloud, leaf)})
        highest = -gauss_for(leaf).d1
        for thin in (1.0, 3.0):
            scans = [thinned(read_scan(path), thin) for path in way.scans]
            for mode in ("single", "coarse_fine"):
                limit = default_nvtl(leaf, fine=mode == "coarse_fine")
                rows = []
                with NdtMatcher(Settings(mode=mode, steady=True)) as matcher:
                    matcher.set_map(matcher.prepare(voxel_map))
                    for index, (scan, T) in enumerate(zip(scans, truth, strict=True)):
                        for seed in range(args.seeds):
                            result = matcher.align(scan, start(T, index, seed))
                            metres, _ = pose_errors(result.T_map_base[None], T[None])
                            low = "nvtl" in result.failed_limits
                            rows.append((metres[0], result.nvtl / highest, result.trustworthy, low))
                found = np.array(rows, np.float64)
                right, wrong = found[found[:, 0] < 0.3], found[found[:, 0] > 1.0]
                print(
                    f"{leaf:4g} {thin:4g} {mode:12} {limit:5.2f} {limit / highest:5.2f}  "
                    f" {right[:, 3].sum():3.0f} of {len(right):3}, {spread(right[:, 1])}  "
                    f" {wrong[:, 2].sum():3.0f} of {len(wrong):3}, {spread(wrong[:, 1])}"
                )


if __name__ == "__main__":
    main()
