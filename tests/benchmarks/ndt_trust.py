# SPDX-License-Identifier: Apache-2.0
"""Which right and wrong poses are trusted, of whole scans and of parts: where the limits of trust come from.

    SHMMAP_TEST_DATA=DIR python -m tests.benchmarks.ndt_trust [--seeds 24] [--scene street town]

Scans of a street and of a generated town with traffic, thinned to one point per 1 m and per 3 m (Autoware's
sampling), are started 0.3 m to 16 m from the true pose, in steady steps, with leaves of 1, 2 and 3 m, as
Autoware aligns and with true covariances: whole, or cut to

- points: 1 to 100 of them,
- sector: 10 to 90 degrees, or half the scan,
- radius: what is within 3 to 15 m,
- ground: what is at most 0.35 m above the road.

Wrong is a result more than 0.2 m or 1 degree off.  Limits: at most 0.2 % of the wrong ones of whole scans
are trusted and 1 % of each kind of part; of right ones of whole scans at most 0.5 % are refused for another
reason than that they did not converge, of those of sectors of 60 degrees and more at most 10 % for any.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from shmmap_clients.ndt_scan_matcher import NdtMatcher, Settings, VoxelMap, matrix_from_pose, voxel_cell
from shmmap_clients.ndt_scan_matcher.drive.drive_summary import pose_errors
from shmmap_clients.scans.scan_file import read_scan, thinned

from shmmap.simulation.lidar import LidarDrive
from shmmap.simulation.town import Town
from tests.benchmarks.street_data import SENSOR_HEIGHT_M, street

Points = NDArray[np.floating]
Poses = NDArray[np.float64]

AWAY_M = (0.3, 1.0, 2.0, 4.0, 8.0, 16.0)
KINDS = ("whole", "points", "sector", "radius", "ground")
SECTORS_DEG = (10, 20, 30, 45, 60, 75, 90, 120, 180)
WIDE_DEG = 60
WRONG_M, WRONG_DEG = 0.2, 1.0
ROAD_M = 0.35
TOWN_SENSOR_M = 1.8


@dataclass(frozen=True, eq=False)
class Scene:
    """A map, scans of it in their sensor's frame, their poses, and the sensor's height; metres."""

    cloud: Points
    scans: Sequence[Points]
    poses: Poses
    height: float


def street_scene() -> Scene:
    """Return the street in the data directory."""
    drive = street()
    scans = [read_scan(path) for path in drive.scans]
    return Scene(read_scan(drive.thinned_map_file), scans, drive.T_map_scans, SENSOR_HEIGHT_M)


def town_scene() -> Scene:
    """Return nine blocks of a town, sparser than the street's map, and scans among traffic."""
    town = Town(seed=8, blocks=(3, 3), density=15.0)
    scans = list(LidarDrive(town, length=600.0, step=25.0).scans())
    return Scene(
        np.concatenate([tile["xyz"] for tile in town.tiles()]),
        [scan.xyz for scan in scans],
        np.array([scan.T_map_sensor for scan in scans]),
        TOWN_SENSOR_M,
    )


SCENES = {"street": street_scene, "town": town_scene}


def start(T: Poses, index: int, seed: int) -> Poses:
    """Return a pose beside the true one, turned the more the farther it is."""
    rng = np.random.default_rng([index, seed])
    direction, away_m = rng.uniform(0, 2 * np.pi), AWAY_M[seed % len(AWAY_M)]
    turn = rng.normal(0.0, 0.05 * (1 + away_m / 4))
    off = matrix_from_pose(np.array([away_m * np.cos(direction), away_m * np.sin(direction), 0, 0, 0, turn]))
    return np.asarray(T @ off, np.float64)


def cut(scan: Points, kind: str, height: float, rng: np.random.Generator) -> tuple[Points, float]:
    """Return a part of a scan, and how wide it is, degrees."""
    if kind == "points":
        count = rng.integers(1, 101) if rng.integers(2) else round(100 ** rng.uniform())
        return scan[rng.choice(len(scan), min(int(count), len(scan)), replace=False)], 360.0
    if kind == "sector":
        width = float(rng.choice(SECTORS_DEG))
        heading = np.degrees(np.arctan2(scan[:, 1], scan[:, 0]))
        return scan[(heading - rng.uniform(0, 360)) % 360.0 < width], width
    if kind == "radius":
        return scan[np.linalg.norm(scan, axis=1) < rng.uniform(3, 15)], 360.0
    if kind == "ground":
        return scan[scan[:, 2] < ROAD_M - height], 360.0
    return scan, 360.0


@dataclass(slots=True)
class Tally:
    """Counts of one kind of scan."""

    wrong: int = 0
    trusted: int = 0
    far_trusted: int = 0
    right: int = 0
    not_converged: int = 0
    refused: Counter[str] = field(default_factory=Counter)
    wide: int = 0
    wide_refused: Counter[str] = field(default_factory=Counter)

    def add(self, metres: float, degrees: float, failed: tuple[str, ...], width: float) -> None:
        """Count one result."""
        if metres > WRONG_M or degrees > WRONG_DEG:
            self.wrong += 1
            self.trusted += not failed
            self.far_trusted += not failed and (metres > 1.5 * WRONG_M or degrees > 1.5 * WRONG_DEG)
            return
        self.right += 1
        if "converged" in failed:
            self.not_converged += 1
        else:
            self.refused.update(["any"] if failed else [])
            self.refused.update(failed)
        if WIDE_DEG <= width < 360.0:
            self.wide += 1
            self.wide_refused.update(["any"] if failed else [])
            self.wide_refused.update(failed)

    def describe(self) -> str:
        """Return the counts in a line."""
        words = [
            f"wrong {self.wrong:5}: trusted {self.trusted:3}",
            f"({100 * self.trusted / max(self.wrong, 1):.2f} %),",
            f"of these half as much again off {self.far_trusted:3};",
            f"right {self.right:5}: not converged {self.not_converged:3},",
            f"else refused {100 * self.refused['any'] / max(self.right, 1):.2f} % ({_limits(self.refused)})",
        ]
        if self.wide:
            words.append(
                f"; of {self.wide} right ones of {WIDE_DEG} degrees and more"
                f" {100 * self.wide_refused['any'] / self.wide:.1f} % refused ({_limits(self.wide_refused)})"
            )
        return " ".join(words)


def _limits(refused: Counter[str]) -> str:
    return ", ".join(f"{name} {count}" for name, count in refused.items() if name != "any")


def measure(scene: Scene, seeds: range, kinds: Sequence[str]) -> dict[str, Tally]:
    """Align all parts of all scans from all starts."""
    tallies = {kind: Tally() for kind in kinds}
    for leaf in (1.0, 2.0, 3.0):
        voxel_map = VoxelMap({"map": voxel_cell(scene.cloud, leaf)})
        for thin in (1.0, 3.0):
            scans = [thinned(scan, thin) for scan in scene.scans]
            for mode in ("single", "coarse_fine"):
                with NdtMatcher(Settings(mode=mode, steady=True)) as matcher:
                    matcher.set_map(matcher.prepare(voxel_map))
                    for index, (scan, T) in enumerate(zip(scans, scene.poses, strict=True)):
                        for kind, seed in ((kind, seed) for kind in kinds for seed in seeds):
                            rng = np.random.default_rng([index, seed, KINDS.index(kind)])
                            part, width = cut(scan, kind, scene.height, rng)
                            result = matcher.align(part, start(T, index, seed))
                            metres, degrees = pose_errors(result.T_map_base[None], T[None])
                            tallies[kind].add(metres[0], degrees[0], result.failed_limits, width)
    return tallies


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=24)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--scene", nargs="+", choices=SCENES, default=tuple(SCENES))
    parser.add_argument("--kind", nargs="+", choices=KINDS, default=KINDS)
    args = parser.parse_args()
    for name in args.scene:
        seeds = range(args.first_seed, args.first_seed + args.seeds)
        for kind, tally in measure(SCENES[name](), seeds, args.kind).items():
            print(f"{name:6} {kind:6} {tally.describe()}", flush=True)


if __name__ == "__main__":
    main()
