# SPDX-License-Identifier: Apache-2.0
"""``shmmap-ndt device-check``: compare a device's results with numpy's, repeatedly, and measure its speed.

Only numpy generates the scenes and their Gaussians, so that the check also runs where numba has no wheel.
The bounds allow for rounding, in double precision and in floats; see `BOUNDS`.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from typing import Any, Final, get_args

import numpy as np
from numpy.typing import NDArray

import shmmap
from shmmap_clients.command_line import complain, print_line, write_text
from shmmap_clients.ndt_scan_matcher.backends.backend import Backend, DeviceError, DeviceOptions
from shmmap_clients.ndt_scan_matcher.backends.opencl.devices import NO_DRIVER_HINT, DeviceInfo, list_devices
from shmmap_clients.ndt_scan_matcher.backends.registry import backend_named
from shmmap_clients.ndt_scan_matcher.map.voxel_map import Covariance, VoxelCell, VoxelMap
from shmmap_clients.ndt_scan_matcher.matching.evaluation import (
    Evaluation,
    Neighbors,
    Scoring,
    matrix_from_pose,
)
from shmmap_clients.ndt_scan_matcher.matching.matcher import NdtMatcher
from shmmap_clients.ndt_scan_matcher.matching.result import Result
from shmmap_clients.ndt_scan_matcher.matching.settings import Limits, Settings

__all__ = ["BOUNDS", "SCENES", "run"]

_NAME: Final = "shmmap-ndt"
_UNEQUAL, _NO_DEVICE = 1, 3
_REPEATS: Final = 100
_BATCH: Final = 12
_TIMED: Final = 200  # evaluations, and poses of a batch
_TIMED_BATCHES: Final = 20

_FAR: Final = (89_560.0, 42_300.0)  # position of Autoware's sample map
SCENES: Final = (  # origin, metres; leaf, metres; points of the scan
    ((0.0, 0.0), 2.0, 1500),
    ((0.0, 0.0), 1.0, 16_000),
    (_FAR, 2.0, 1500),
    (_FAR, 1.0, 16_000),
)
_TRUTH: Final = np.array([1.3, 0.4, 1.8, 0.02, -0.03, 0.4])
_OFF: Final = np.array([0.4, -0.3, 0.2, 0.01, 0.02, -0.04])
_CELL_M: Final = 20.0
_LEAST_POINTS: Final = 6  # least points of a voxel
_RADIUS: Final = Scoring("radius", "autoware")


@dataclass(frozen=True, slots=True)
class Bounds:
    """Largest allowed differences between two results.

    Attributes
    ----------
    evaluation
        Score, gradient and Hessian of one pose, relative to the largest element.
    t_m, R, transform_probability
        Differences of an alignment: metres, elements of the rotation, score per point.
    """

    evaluation: float
    t_m: float
    R: float
    transform_probability: float


# floats: 2^-24 of 100 m is 6 micrometres for a point, and thousands of points average the error of a pose
BOUNDS: Final = {
    "double": Bounds(1e-12, 1e-9, 1e-9, 1e-9),
    "float": Bounds(2e-4, 1e-4, 2e-5, 2e-3),
}


@dataclass(frozen=True, slots=True, eq=False)
class _Scene:
    """A map, a scan in its own frame, (N, 3), metres, and numpy's results from one pose vector."""

    name: str
    voxel_map: VoxelMap
    scan: NDArray[np.float32]
    guess: NDArray[np.float64]
    wanted: list[tuple[Settings, Result]]

    @property
    def limits(self) -> Limits:
        return Limits(source_points=len(self.scan))


@dataclass(frozen=True, slots=True)
class _Check:
    """One comparison: its name, the largest difference of each kind, and the bounds that were exceeded."""

    what: str
    equal: bool
    worst: dict[str, float]
    failures: list[str]


def run(args: argparse.Namespace) -> int:
    """Compare, print, write the report; return the exit code."""
    chosen = [
        info
        for info in list_devices()
        if (args.require != "gpu" or info.kind == "GPU")
        and (
            args.device is None or args.device == str(info.index) or args.device.lower() in info.name.lower()
        )
    ]
    if not chosen:
        what = "GPU" if args.require == "gpu" else "device"
        complain(_NAME, f"there is no such OpenCL {what} here: {NO_DRIVER_HINT}")
        return _NO_DEVICE
    scenes = [_scene(*one) for one in SCENES]
    entries = [entry for info in chosen for entry in _checked(info, scenes)]
    equal = all(not entry["error"] and all(one["equal"] for one in entry["checks"]) for entry in entries)
    if args.json:
        document = {
            "shmmap": shmmap.__version__,
            "numpy": np.__version__,
            "pyopencl": version("pyopencl"),
            "equal": equal,
            "devices": entries,
        }
        write_text(args.json, json.dumps(document, indent=1) + "\n")
    print_line("all is equal" if equal else "NOT all is equal")
    return 0 if equal else _UNEQUAL


def _checked(info: DeviceInfo, scenes: list[_Scene]) -> Iterator[dict[str, Any]]:
    """Check a device in each precision and each kind of map memory that it supports."""
    print_line(info.describe())
    options = [DeviceOptions(str(info.index), "float", "copy")]
    if info.fp64:
        options.insert(0, DeviceOptions(str(info.index), "double", "copy"))
        if info.svm_system:
            options.insert(1, DeviceOptions(str(info.index), "double", "svm"))
    for device in options:
        how = f"{device.precision}, {device.memory}"
        checks: list[_Check] = []
        latencies: dict[str, dict[str, Any]] = {}
        error = None
        try:
            for scene in scenes:
                found = [_check_alignments(scene, device), _check_repeats(scene, device)]
                found += [_check_evaluations(scene, device, most) for most in (32, 2)]
                for check in found:
                    _print(how, check)
                checks += found
                latencies[scene.name] = _latencies(scene, device)
        except DeviceError as failure:
            error = str(failure)
            complain(_NAME, error)
        for name, times in latencies.items():
            one, many = times["evaluation_ms"], times["batch_ms"]
            print_line(
                f"  {how}: {name}: evaluation {one['p50']:.3f} ms (p99 {one['p99']:.3f}), {_TIMED} poses"
                f" {many['p50']:.2f} ms, map {times['map_ms']:.1f} ms"
            )
        yield {
            "device": asdict(info),
            "error": error,
            "precision": device.precision,
            "memory": device.memory,
            "checks": [asdict(check) for check in checks],
            "latencies": latencies,
        }


def _print(how: str, check: _Check) -> None:
    worst = ", ".join(f"{kind} {value:.1e}" for kind, value in check.worst.items())
    print_line(
        f"  {how}: {'equal' if check.equal else 'UNEQUAL'}: {check.what}{f' ({worst})' if worst else ''}"
    )
    for line in check.failures[:10]:
        print_line(f"    {line}")


# --- equality -------------------------------------------------------------------------------------


def _aligned(scene: _Scene, settings: Settings, backend: str, device: DeviceOptions) -> Result:
    settings = replace(settings, backend=backend, device=device)
    with NdtMatcher(settings, limits=scene.limits) as matcher:
        matcher.set_map(matcher.prepare(scene.voxel_map))
        return matcher.align(scene.scan, matrix_from_pose(scene.guess))


def _check_alignments(scene: _Scene, device: DeviceOptions) -> _Check:
    bounds = BOUNDS[device.precision]
    worst = {"t_m": 0.0, "R": 0.0, "transform_probability": 0.0}
    failures = []
    for settings, wanted in scene.wanted:
        name = f"{settings.variant} {settings.neighbors} {settings.mode}"
        found = _aligned(scene, settings, "opencl", device)
        apart = np.abs(found.T_map_base - wanted.T_map_base)
        off = {
            "t_m": float(apart[:3, 3].max()),
            "R": float(apart[:3, :3].max()),
            "transform_probability": abs(found.transform_probability - wanted.transform_probability),
        }
        for kind, value in off.items():
            worst[kind] = max(worst[kind], value)
            if not value <= getattr(bounds, kind):
                failures.append(f"{name}: {kind} is {value:.3g} off, {getattr(bounds, kind):g} is allowed")
        if found.iterations != wanted.iterations:
            failures.append(f"{name}: {found.iterations} iterations, not {wanted.iterations}")
        if found.cut != wanted.cut:
            failures.append(f"{name}: limits left out {found.cut}, not {wanted.cut}")
    return _Check(f"alignments, {scene.name}", not failures, worst, failures)


def _ready(scene: _Scene, backend: str, limits: Limits, device: DeviceOptions) -> Backend:
    made = backend_named(backend, limits, options=device)
    made.set_map(scene.voxel_map)
    made.set_source(scene.scan)
    return made


def _check_evaluations(scene: _Scene, device: DeviceOptions, most: int) -> _Check:
    """Compare score, gradient, Hessian and counts for each search and covariance."""
    limits = replace(scene.limits, neighbors=most)
    here, there = (_ready(scene, backend, limits, device) for backend in ("numpy", "opencl"))
    worst, failures = 0.0, []
    for neighbors in get_args(Neighbors):
        for covariance in get_args(Covariance):
            scoring = Scoring(neighbors, covariance)
            (wanted,) = here.evaluate(scene.guess[None], scoring)
            (found,) = there.evaluate(scene.guess[None], scoring)
            off = max(
                float(np.abs(a - b).max() / max(np.abs(b).max(), 1e-300))
                for a, b in zip(_numbers(found), _numbers(wanted), strict=True)
            )
            worst = max(worst, off)
            if not off <= BOUNDS[device.precision].evaluation:
                failures.append(f"{neighbors}, {covariance}: {off:.3g} off")
            # where coordinates are floats, a point on a voxel's border may fall into the next one
            if device.precision == "double" and _counts(found) != _counts(wanted):
                failures.append(f"{neighbors}, {covariance}: counts {_counts(found)}, not {_counts(wanted)}")
    here.close()
    there.close()
    what = f"evaluations, at most {most} neighbours, {scene.name}"
    return _Check(what, not failures, {"relative": worst}, failures)


def _check_repeats(scene: _Scene, device: DeviceOptions) -> _Check:
    """Compare repeated runs, and a batch of poses with single poses, bit for bit."""
    there = _ready(scene, "opencl", scene.limits, device)
    first, *repeats = [there.evaluate(scene.guess[None], _RADIUS)[0] for _ in range(_REPEATS + 1)]
    unlike = sum(not _same(again, first) for again in repeats)
    poses = scene.guess + np.linspace(-1.0, 1.0, _BATCH)[:, None] * np.array([0.5, 0.4, 0.1, 0.01, 0.01, 0.1])
    alone = [there.evaluate(pose[None], _RADIUS)[0] for pose in poses]
    apart = sum(not _same(a, b) for a, b in zip(there.evaluate(poses, _RADIUS), alone, strict=True))
    there.close()
    failures = []
    if unlike:
        failures.append(f"{unlike} of {_REPEATS} repeats have other bits")
    if apart:
        failures.append(f"{apart} of {_BATCH} poses have other bits in a batch")
    return _Check(f"repeats and a batch, {scene.name}", not failures, {}, failures)


def _numbers(at: Evaluation) -> tuple[NDArray[np.float64], ...]:
    return np.array([at.score]), np.array([at.nearest]), at.gradient, at.hessian


def _counts(at: Evaluation) -> tuple[int, int, int, int]:
    return at.found, at.neighbours, at.cut_points, at.cut_neighbours


def _same(a: Evaluation, b: Evaluation) -> bool:
    pairs = zip(_numbers(a), _numbers(b), strict=True)
    return _counts(a) == _counts(b) and all((one == other).all() for one, other in pairs)


# --- latency --------------------------------------------------------------------------------------


def _latencies(scene: _Scene, device: DeviceOptions) -> dict[str, Any]:
    """Return the latencies of a device, milliseconds, as the help describes them."""
    pose = scene.guess[None]
    backend = backend_named("opencl", scene.limits, options=device)
    backend.set_source(scene.scan)
    poses = pose + np.linspace(-1.0, 1.0, _TIMED)[:, None] * np.array([2.0, 2.0, 0.0, 0.0, 0.0, 0.2])
    found = {
        "points": len(scene.scan),
        "voxels": scene.voxel_map.voxels,
        "program_ms": _took_ms(lambda: backend.evaluate(pose, _RADIUS)),
        "map_ms": _took_ms(lambda: backend.prepare(scene.voxel_map, _RADIUS)),
        "set_map_ms": _took_ms(lambda: backend.set_map(scene.voxel_map)),
        "evaluation_ms": _spread(lambda: backend.evaluate(pose, _RADIUS), _TIMED),
        "batch_ms": _spread(lambda: backend.evaluate(poses, _RADIUS), _TIMED_BATCHES),
    }
    backend.close()
    return found


def _took_ms(work: Callable[[], object]) -> float:
    begin = time.perf_counter()
    work()
    return (time.perf_counter() - begin) * 1e3


def _spread(work: Callable[[], object], repeats: int) -> dict[str, float]:
    work()
    took = [_took_ms(work) for _ in range(repeats)]
    p50, p99 = np.percentile(took, [50, 99]).tolist()
    return {"min": min(took), "p50": p50, "p99": p99, "max": max(took)}


# --- scenes ---------------------------------------------------------------------------------------


def _scene(origin: tuple[float, float], leaf: float, points: int) -> _Scene:
    """Return a scan of a street with the numpy backend's alignment in each variant and search."""
    moved = np.array([*origin, 0.0])
    target = _street(np.random.default_rng(1)) + moved
    # another sampling of the same street: a scan never holds the map's own points
    rng = np.random.default_rng(2)
    seen = rng.permutation(_street(rng))
    seen = seen[np.linalg.norm(seen - _TRUTH[:3], axis=1) < 25.0][:points]
    T = np.linalg.inv(matrix_from_pose(_TRUTH))
    scan = (seen @ T[:3, :3].T + T[:3, 3]).astype(np.float32)
    guess = _TRUTH + _OFF
    guess[:3] += moved
    place = "street far from the origin" if any(origin) else "street"
    scene = _Scene(f"{place}, leaf {leaf:g} m, {len(scan)} points", _voxels(target, leaf), scan, guess, [])
    every = [Settings(variant, search) for variant in get_args(Covariance) for search in get_args(Neighbors)]
    for settings in [*every, Settings("autoware", "radius", mode="coarse_fine")]:
        scene.wanted.append((settings, _aligned(scene, settings, "numpy", DeviceOptions())))
    return scene


def _street(rng: np.random.Generator) -> NDArray[np.float64]:
    """Return points of a street of 60 m x 24 m about the origin, 1 cm of noise, (N, 3), metres."""

    def filled(count: int, *sides: tuple[float, float]) -> NDArray[np.float64]:
        return np.stack([rng.uniform(*side, count) for side in sides], axis=1)

    ground = filled(24_000, (-30.0, 30.0), (-12.0, 12.0), (0.0, 0.0))
    left = filled(12_000, (-30.0, 30.0), (9.0, 9.0), (0.0, 6.0))
    right = filled(12_000, (-30.0, 30.0), (-8.0, -8.0), (0.0, 5.0))
    parts = [ground, left, right]
    # protruding house fronts: without them nothing fixes a scan along the street
    for x in range(-28, 29, 7):
        parts.append(filled(900, (x, x), (6.5, 9.0), (0.0, 6.0)))
        parts.append(filled(900, (x + 2.5, x + 2.5), (-8.0, -5.5), (0.0, 5.0)))
    points = np.concatenate(parts)
    return points + rng.normal(0.0, 0.01, points.shape)


def _voxels(points: NDArray[np.float64], leaf: float) -> VoxelMap:
    """Return the Gaussians of a cloud in cells of 20 m, with each kind of covariance."""
    square = np.floor(points[:, :2] / _CELL_M).astype(np.int64)
    cells: dict[str, VoxelCell] = {}
    derived: dict[str, dict[Covariance, NDArray[np.float64]]] = {}
    for i, j in np.unique(square, axis=0).tolist():
        part = points[(square == (i, j)).all(axis=1)]
        index, row, count = np.unique(
            np.floor(part / leaf).astype(np.int64), axis=0, return_inverse=True, return_counts=True
        )
        row, first, voxels = row.reshape(-1), index.min(axis=0), len(index)
        near = part - first * leaf
        mean = np.stack([np.bincount(row, axis, voxels) for axis in near.T], axis=1) / count[:, None]
        off = near - mean[row]
        products = [off[:, a] * off[:, b] for a, b in zip(*np.triu_indices(3), strict=True)]
        sums = [np.bincount(row, product, voxels) for product in products]
        scatter = np.asarray(np.stack(sums, axis=1), np.float64)
        used = count >= _LEAST_POINTS
        lattice = np.full(index.max(axis=0) - first + 1, -1, np.int32)
        lattice[tuple((index[used] - first).T)] = np.arange(used.sum())
        inverse = {kind: _inverse(scatter[used], count[used], kind) for kind in get_args(Covariance)}
        derived[f"{i}_{j}"] = inverse
        cells[f"{i}_{j}"] = VoxelCell(
            leaf=leaf,
            origin=np.zeros(3),
            lattice=lattice,
            lattice_origin=first,
            count=count[used].astype(np.uint32),
            mean=mean[used] + first * leaf,
            scatter=scatter[used],
            inverse=inverse["autoware"],
        )
    return VoxelMap(cells, derived=derived)


def _inverse(scatter: NDArray[np.float64], count: NDArray[np.int64], kind: Covariance) -> NDArray[np.float64]:
    """Return (V, 6) inverse covariances of a kind; `shmmap.layers.voxel_covariances` needs numba."""
    full = scatter[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    n = count[:, None, None]
    covariance = full / (n - 1) if kind == "pcl" else (full + np.eye(3)) / (n - 1)
    if kind == "pclomp":
        covariance *= ((n - 1) / n) ** 2
    values, vectors = np.linalg.eigh(covariance)
    values = np.maximum(values, 0.01 * values[:, -1:])
    inverse = (vectors / values[:, None, :]) @ vectors.transpose(0, 2, 1)
    return np.ascontiguousarray(inverse[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]])
