# SPDX-License-Identifier: Apache-2.0
"""The elevation map: how near to known ground, how fast, and in how much memory.

Accuracy: the surface rule at 0.3 m on rolling terrain with exact points, on the same with points off by
15 mm (one standard deviation), and on a generated town, whose points are off by as much.  Errors are against
the known ground at the middle of each column, away from edges: in the town, in columns with nothing but
ground in them (no car, wall or leaf) and no curb.  A column is its points' mean, so it is wrong by the mean
of their errors, whatever the rule; what is left when that is taken out is the rule's own part, which comes
from where in the column the points lie, on a slope.

Memory: rolling terrain in 20 m cells, some 1500 points each, in maps of more and more cells.  The program
runs twice in a process of its own, first to build, then to write NPZ, GeoTIFF, PNG and hillshade from
what it built; its anonymous memory (RssAnon, interpreter and libraries included) is sampled all the time.

    python -m tests.benchmarks.elevation_map [--sides 10,32,100] [--density 400] [--json]

Measured: heights of 0.3 m columns of 36 exact points are off by 0.5 mm (median) and 3.8 mm (largest), with
noise of 15 mm by 1.8 and 12.4 mm; peak private memory 68 MiB for 100 cells, 70 MiB for 10 000.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from shmmap_clients.elevation_map import ElevationGrid, ElevationRule, build_elevation_map

import shmmap
from shmmap.simulation.town import Town
from tests.support.daemon_process import DaemonProcess
from tests.support.divided_map import write_pcd

CELL_METRES = 20
CELL_POINTS = 1500
SCATTER_METRES = 0.015  # of the town's ground points, too
Ground = Callable[[NDArray[Any], NDArray[Any]], NDArray[np.float64]]
MIB = 1 << 20


def terrain(x: NDArray[Any], y: NDArray[Any]) -> NDArray[np.float64]:
    """Height of the rolling terrain, metres."""
    return np.asarray(8.0 * np.sin(x / 170.0) * np.cos(y / 210.0) + 0.01 * x)


def write_terrain(root: Path, side: int, points: int = CELL_POINTS, scatter: float = 0.0) -> None:
    """Write ``side`` x ``side`` cells of ``points`` points, off by ``scatter`` metres, as a divided map."""
    cells = root / "pointcloud_map.pcd"
    cells.mkdir(parents=True)
    rng = np.random.default_rng(1)
    lines = [f"x_resolution: {CELL_METRES}", f"y_resolution: {CELL_METRES}"]
    for row in range(side):
        for column in range(side):
            x0, y0 = column * CELL_METRES, row * CELL_METRES
            x, y = (rng.random((2, points)) * CELL_METRES + [[x0], [y0]]).astype(np.float32)
            x, y = np.minimum(x, x0 + 19.999), np.minimum(y, y0 + 19.999)
            z = terrain(x.astype(float), y.astype(float)) + scatter * rng.standard_normal(points)
            name = f"terrain_{x0}_{y0}.pcd"
            write_pcd(cells / name, {"x": x, "y": y, "z": z.astype(np.float32)})
            lines.append(f"{name}: [{x0}, {y0}]")
    (root / "pointcloud_map_metadata.yaml").write_text("\n".join(lines) + "\n")


def anonymous_bytes(pid: int) -> int:
    """RssAnon of a process, 0 once it has ended."""
    try:
        for line in Path(f"/proc/{pid}/status").read_text().splitlines():
            if line.startswith("RssAnon:"):
                return int(line.split()[1]) << 10
    except OSError:
        pass
    return 0


def run_program(one: DaemonProcess, directory: Path, *words: str) -> dict[str, Any]:
    """Run the program; its document, seconds, CPU seconds and the most anonymous memory."""
    command = [
        sys.executable, "-m", "shmmap_clients.elevation_map", "build", "--endpoint", one.endpoint, "--json",
        "--cache", str(directory / "cache"), "--resolution", "0.7", "--tolerance", "1.0", *words,
    ]  # fmt: skip
    begin = time.perf_counter()
    before = os.times()
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    peak = 0
    while process.poll() is None:
        peak = max(peak, anonymous_bytes(process.pid))
        time.sleep(0.005)
    assert process.stdout is not None
    document: dict[str, Any] = json.loads(process.stdout.read())
    after = os.times()
    cpu = after.children_user + after.children_system - before.children_user - before.children_system
    return {**document, "seconds": time.perf_counter() - begin, "cpu_s": cpu, "peak_bytes": peak}


def errors(map_dir: Path, clouds: Iterable[NDArray[Any]], ground: Ground, curbs: bool) -> dict[str, Any]:
    """Errors of a map's columns, metres: all, and the rule's own part."""
    one = DaemonProcess(map_dir).start()
    try:
        with shmmap.connect(one.endpoint) as client:
            grid = build_elevation_map(client, ElevationRule(), map_dir / "cache").grid
    finally:
        one.stop()
        one.dispose()
    heights, kind = grid.filled(0, grid.shape[0], 0.0)
    x, y = (
        start + (np.arange(count) + 0.5) * grid.resolution
        for start, count in zip(grid.origin, grid.shape[::-1], strict=True)
    )
    clear = kind == 1
    clear[[0, -1]] = clear[:, [0, -1]] = False  # the map's rim cuts these
    if curbs:
        street = np.minimum(np.abs((x + 40) % 80 - 40)[None, :], np.abs((y + 40) % 80 - 40)[:, None])
        clear &= np.abs(street - 4.0) > grid.resolution
    off, above = scatter(grid, clouds, ground)
    clear &= ~above
    error = (heights - ground(*np.meshgrid(x, y)))[clear]
    return {"columns": len(error), "all": spread(error), "rule": spread(error - off[clear])}


def scatter(
    grid: ElevationGrid, clouds: Iterable[NDArray[Any]], ground: Ground
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """How far each column's points are above the ground on average; which have points not of the ground."""
    total, count, above = (np.zeros(grid.shape[0] * grid.shape[1]) for _ in range(3))
    for cloud in clouds:
        x, y, z = cloud.astype(np.float64).T
        i, j = (np.floor(v * (1 / grid.resolution)).astype(int) for v in (x, y))
        place = (j - grid.first[1]) * grid.shape[1] + i - grid.first[0]
        off = z - ground(x, y)
        total += np.bincount(place, off, len(total))
        count += np.bincount(place, minlength=len(count))
        above += np.bincount(place, np.abs(off) > 0.1, len(above))
    return (total / np.maximum(count, 1)).reshape(grid.shape), (above > 0).reshape(grid.shape)


def spread(error: NDArray[np.float64]) -> dict[str, float]:
    """Percentiles of the size of errors, and the share below a centimetre."""
    size = np.abs(error)
    names = ("p50", "p99", "p99.9", "max")
    found = dict(zip(names, np.percentile(size, [50, 99, 99.9, 100]).tolist(), strict=True))
    return {**found, "below_1_cm": float((size < 0.01).mean())}


def accuracy(directory: Path, density: float) -> dict[str, Any]:
    """Errors on terrain with exact points, with points that scatter, and on the town."""
    result = {}
    for name, off in (("terrain, exact points", 0.0), ("terrain, points off by 15 mm", SCATTER_METRES)):
        root = directory / name.replace(" ", "-")
        write_terrain(root, 5, int(density * CELL_METRES**2), off)
        clouds = (shmmap.read_cloud(path).xyz for path in sorted(root.glob("*/*.pcd")))
        result[name] = errors(root, clouds, terrain, curbs=False)
    town = Town(seed=3, blocks=(2, 2), density=density)
    town.write(directory / "town")
    tiles = (tile["xyz"] for tile in town.tiles())
    result["town, points off by 15 mm"] = errors(directory / "town", tiles, town.ground_height, curbs=True)
    return result


def memory(directory: Path, side: int) -> dict[str, Any]:
    """Build a map of ``side`` x ``side`` cells, then write it in all formats."""
    root = directory / f"terrain{side}"
    write_terrain(root, side)
    one = DaemonProcess(root).start()
    try:
        built = run_program(one, root)
        outputs = [word for suffix in ("npz", "tif", "png") for word in ("--out", f"{root}/map.{suffix}")]
        written = run_program(one, root, *outputs, "--hillshade", f"{root}/shade.png")
    finally:
        one.stop()
        one.dispose()
    assert written["loaded"] == 0, "the second run had to build again"
    return {**built, "write_s": written["seconds"], "write_peak_bytes": written["peak_bytes"]}


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sides", default="10,32,100", help="cells along a side, of each map")
    parser.add_argument("--density", type=float, default=400.0, help="for the accuracy, points per m²")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        exact = accuracy(Path(name), args.density)
        rows = [memory(Path(name), side) for side in map(int, args.sides.split(","))]
    if args.json:
        print(json.dumps({"points_per_m2": args.density, "accuracy": exact, "memory": rows}, indent=1))
        return
    print(f"errors in mm, columns of 0.3 m, {args.density:g} points/m²")
    print(f"{'':30}{'columns':>9}{'p50':>8}{'p99':>8}{'p99.9':>8}{'max':>8}{'below 10 mm':>14}")
    for case, found in exact.items():
        for title, errors_of in ((case, "all"), ("  the rule's own part", "rule")):
            e = found[errors_of]
            numbers = "".join(f"{e[key] * 1e3:8.1f}" for key in ("p50", "p99", "p99.9", "max"))
            print(f"{title:30}{found['columns']:9}{numbers}{100 * e['below_1_cm']:12.3f} %")
    print("\n   cells     columns   build  ms a cell     peak   write     peak")
    for row in rows:
        columns = row["rows"] * row["columns"]
        each_ms = 1e3 * row["seconds"] / row["cells"]
        print(
            f"{row['cells']:8}{columns:12}{row['seconds']:6.1f} s{each_ms:11.2f}"
            f"{row['peak_bytes'] / MIB:5.1f} MiB"
            f"{row['write_s']:6.1f} s{row['write_peak_bytes'] / MIB:5.1f} MiB"
        )


if __name__ == "__main__":
    main()
