# SPDX-License-Identifier: Apache-2.0
"""What is aligned to compare backends: voxels, scans and guesses; generated, recorded, or from a file.

The file is an .npz that `packed` writes: arrays under ``scene/N/...``, and a JSON index of everything else.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap import BadRequest, MapMissing
from shmmap_clients.ndt_scan_matcher.map.voxel_cell import VoxelCell
from shmmap_clients.ndt_scan_matcher.map.voxel_map import Covariance, VoxelMap

__all__ = ["Case", "Scene", "load_scenes", "pack_scenes", "reference_scenes", "town_scenes"]

_COVARIANCES: Final[tuple[Covariance, ...]] = ("autoware", "pclomp", "pcl")
_CELL: Final = ("origin", "lattice", "lattice_origin", "count", "mean", "scatter", "inverse")
_OFF: Final = ((0.4, -0.3, 0.2, 0.01, 0.02, -0.04), (-0.6, 0.2, -0.1, 0.0, -0.01, 0.03))
_FAR: Final = (89_560.0, 42_300.0)  # Autoware's sample map lies there
_CELL_M: Final = 20.0
_SEARCH: Final = {"KDTREE": "radius", "DIRECT7": "direct7", "DIRECT1": "direct1"}


@dataclass(frozen=True, slots=True)
class Case:
    """One alignment.

    Attributes
    ----------
    name
    variant, neighbors, epsilon, max_iterations, step_size, mode
        As in `Settings`.
    guess
        Pose vector, metres and radians.
    expected
        What the original program gave: ``iterations``, ``T`` (3 x 4), ``transform_probability``; or None.
    """

    name: str
    variant: str
    neighbors: str
    guess: tuple[float, ...]
    epsilon: float | None = None
    max_iterations: int | None = None
    step_size: float = 0.1
    mode: str = "single"
    expected: dict[str, Any] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """A map, a scan in its own frame, (N, 3), metres, and what is aligned there."""

    name: str
    voxel_map: VoxelMap
    scan: NDArray[np.floating]
    cases: tuple[Case, ...]


def town_scenes() -> list[Scene]:
    """Return scenes of the generated town, at the origin and where an Autoware map lies.

    Raises
    ------
    PackageMissing
        What computes voxels is not installed.
    """
    from shmmap import needed_packages
    from shmmap_clients.demo.town_scene import town_scene
    from shmmap_clients.ndt_scan_matcher.map.voxel_cell import voxel_cell
    from shmmap_clients.ndt_scan_matcher.matching.euler_derivatives import pose_from_matrix

    scenes = []
    with needed_packages("generating scenes"):
        for place, origin in (("town", (0.0, 0.0)), ("town far from the origin", _FAR)):
            cloud, scans = town_scene(scans=2, origin=origin)
            square = np.floor(cloud[:, :2] / _CELL_M).astype(np.int64)
            for leaf, points in ((2.0, 1500), (1.0, 15_950)):
                cells = {
                    f"{i}_{j}": voxel_cell(cloud[(square == (i, j)).all(axis=1)], leaf)
                    for i, j in sorted(set(map(tuple, square.tolist())))
                }
                for number, scan in enumerate(scans):
                    chosen = (
                        np.arange(min(points, len(scan.xyz))) * len(scan.xyz) // min(points, len(scan.xyz))
                    )
                    truth = pose_from_matrix(scan.T_map_sensor)
                    guess = tuple((truth + np.array(_OFF[number])).tolist())
                    cases = [
                        Case(f"{variant} {search}", variant, search, guess)
                        for variant in ("autoware", "pclomp", "pcl")
                        for search in ("radius", "direct7", "direct1")
                    ]
                    cases.append(Case("autoware, then fine", "autoware", "radius", guess, mode="coarse_fine"))
                    name = f"{place}, scan {number}, leaf {leaf:g} m, {len(chosen)} points"
                    scenes.append(Scene(name, VoxelMap(cells), scan.xyz[chosen], tuple(cases)))
    return scenes


def reference_scenes(folder: Path) -> list[Scene]:
    """Return the alignments that ndt_omp and Autoware computed, from a directory that has them.

    Parameters
    ----------
    folder
        With ``reference_results.json`` and the clouds that it names.

    Raises
    ------
    MapMissing
        They are not there.
    """
    from shmmap import needed_packages, read_cloud
    from shmmap_clients.ndt_scan_matcher.map.voxel_cell import voxel_cell

    table = folder / "reference_results.json"
    if not table.is_file():
        raise MapMissing(f"{folder} has no reference_results.json")
    groups: dict[tuple[str, float], list[Case]] = {}
    for row in json.loads(table.read_text(encoding="utf-8"))["results"]:
        # DIRECT26 leaves out the voxel of the point itself; Autoware does not use its line search
        if "DIRECT26" in row["name"] or "ls=1" in row["name"]:
            continue
        x, y, z, yaw = row["guess_xyz_yaw"]
        groups.setdefault((row["dataset"], row["leaf"]), []).append(
            Case(
                name=f"{row['name']}, epsilon {row['eps']}",
                variant="autoware" if row["name"].startswith("autoware") else "pclomp",
                neighbors=next(ours for theirs, ours in _SEARCH.items() if theirs in row["name"]),
                guess=(x, y, z, 0.0, 0.0, yaw),
                epsilon=row["eps"],
                max_iterations=row["max_iter"],
                step_size=row["step_size"],
                expected={
                    "iterations": row["iters"],
                    "T": np.array(row["T"])[:3].tolist(),
                    "transform_probability": row["tp"],
                },
            )
        )
    scenes = []
    with needed_packages("reading references"):
        for (dataset, leaf), cases in groups.items():
            if dataset == "synthetic":
                target = read_cloud(folder / "synthetic_map.pcd").xyz
                scan = read_cloud(folder / "synthetic_scan1500.pcd").xyz
            else:
                with np.load(folder / "target_ds0.1_points.npz") as file:
                    target = file["xyz"]
                with np.load(folder / "source_ds0.1_points.npz") as file:
                    scan = file["xyz"]
            voxel_map = VoxelMap({"map": voxel_cell(target, leaf)})
            scenes.append(Scene(f"references, {dataset}, leaf {leaf:g} m", voxel_map, scan, tuple(cases)))
    return scenes


def pack_scenes(scenes: Sequence[Scene], path: Path) -> None:
    """Write scenes to an .npz file, for machines without what computes voxels."""
    arrays: dict[str, NDArray[Any]] = {}
    index = []
    for number, scene in enumerate(scenes):
        arrays[f"scene/{number}/scan"] = np.asarray(scene.scan, np.float32)
        for at, (key, cell) in enumerate(scene.voxel_map.cells.items()):
            place = f"scene/{number}/cell/{at}"
            for name in _CELL:
                arrays[f"{place}/{name}"] = getattr(cell, name)
            for covariance in _COVARIANCES:
                arrays[f"{place}/{covariance}"] = scene.voxel_map.inverses(key, covariance)
        index.append(
            {
                "name": scene.name,
                "leaf": scene.voxel_map.leaf,
                "cells": list(scene.voxel_map.cells),
                "cases": [asdict(case) for case in scene.cases],
            }
        )
    np.savez_compressed(path, index=np.frombuffer(json.dumps(index).encode(), np.uint8), **arrays)  # type: ignore[arg-type]


def load_scenes(path: Path) -> list[Scene]:
    """Read what `pack_scenes` wrote.

    Raises
    ------
    MapMissing, BadRequest
        There is no such file, or it is another kind of file.
    """
    if not path.is_file():
        raise MapMissing(f"there is no file {path}")
    try:
        with np.load(path) as file:
            index = json.loads(file["index"].tobytes())
            return [_loaded(file, number, entry) for number, entry in enumerate(index)]
    except (KeyError, ValueError, OSError) as error:
        raise BadRequest(f"{path} was not written by `device-check --pack`: {error}") from None


def _loaded(file: Any, number: int, entry: dict[str, Any]) -> Scene:
    cells: dict[str, VoxelCell] = {}
    derived: dict[str, dict[Covariance, NDArray[np.float64]]] = {}
    for at, key in enumerate(entry["cells"]):
        place = f"scene/{number}/cell/{at}"
        cells[key] = VoxelCell(leaf=entry["leaf"], **{name: file[f"{place}/{name}"] for name in _CELL})
        derived[key] = {covariance: file[f"{place}/{covariance}"] for covariance in _COVARIANCES}
    cases = tuple(Case(**{**case, "guess": tuple(case["guess"])}) for case in entry["cases"])
    return Scene(entry["name"], VoxelMap(cells, derived=derived), file[f"scene/{number}/scan"], cases)
