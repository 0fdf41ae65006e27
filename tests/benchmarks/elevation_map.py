# SPDX-License-Identifier: Apache-2.0
"""The elevation map: how near to known ground, how fast, and in how much memory.

Accuracy: a generated town of known ground, the surface rule at 0.3 m; away from edges means columns
with nothing but ground in them (no car, wall or leaf) and no curb.

Memory: rolling terrain of known height in 20 m cells, some 1500 points each, built by the program in
a process of its own whose anonymous memory (RssAnon) is sampled all the time: the peak over that before the
first cell, for maps of more and more cells.

    python -m tests.benchmarks.elevation_map [--sides 10,32,100] [--density 400] [--json]
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from shmmap_clients.elevation_map import ElevationRule, build_elevation_map

import shmmap
from shmmap.testing.town import Town
from tests.support.daemon_process import DaemonProcess
from tests.support.pcd_files import write_pcd

__all__ = ["main"]

CELL_METRES = 20
CELL_POINTS = 1500
MIB = 1 << 20


def terrain(x: NDArray[Any], y: NDArray[Any]) -> NDArray[np.float64]:
    """Height of the rolling terrain, metres."""
    return np.asarray(8.0 * np.sin(x / 170.0) * np.cos(y / 210.0) + 0.01 * x)


def write_terrain(root: Path, side: int) -> None:
    """Write ``side`` x ``side`` cells of terrain as a divided map."""
    cells = root / "pointcloud_map.pcd"
    cells.mkdir(parents=True)
    rng = np.random.default_rng(1)
    lines = [f"x_resolution: {CELL_METRES}", f"y_resolution: {CELL_METRES}"]
    for row in range(side):
        for column in range(side):
            x0, y0 = column * CELL_METRES, row * CELL_METRES
            x, y = (rng.random((2, CELL_POINTS)) * CELL_METRES + [[x0], [y0]]).astype(np.float32)
            x, y = np.minimum(x, x0 + 19.999), np.minimum(y, y0 + 19.999)
            z = terrain(x.astype(float), y.astype(float)).astype(np.float32)
            name = f"terrain_{x0}_{y0}.pcd"
            write_pcd(cells / name, {"x": x.astype(np.float32), "y": y.astype(np.float32), "z": z})
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
        "--cache", str(directory / "cache"), "--out", str(directory / "map.npz"),
        "--hillshade", str(directory / "shade.png"), *words,
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


def accuracy(directory: Path, density: float) -> dict[str, Any]:
    """Errors against the town's ground away from edges, metres."""
    town = Town(seed=3, blocks=(2, 2), density=density)
    town.write(directory / "town")
    one = DaemonProcess(directory / "town").start()
    try:
        with shmmap.connect(one.endpoint) as client:
            built = build_elevation_map(client, ElevationRule(), directory / "cache")
    finally:
        one.stop()
        one.dispose()
    grid = built.grid
    heights, kind = grid.filled(0, grid.shape[0], 1.0)
    x = grid.origin[0] + (np.arange(grid.shape[1]) + 0.5) * grid.resolution
    y = grid.origin[1] + (np.arange(grid.shape[0]) + 0.5) * grid.resolution
    truth = town.ground_height(*np.meshgrid(x, y))
    clear = kind == 1
    for tile in town.tiles():
        cloud = tile["xyz"]
        above = np.abs(cloud[:, 2] - town.ground_height(cloud[:, 0], cloud[:, 1])) > 0.1
        index = np.floor(cloud[above, :2].astype(np.float64) / grid.resolution).astype(int) - grid.first
        clear[index[:, 1], index[:, 0]] = False
    away = np.minimum(np.abs((x + 40) % 80 - 40)[None, :], np.abs((y + 40) % 80 - 40)[:, None])
    clear &= np.abs(away - 4.0) > grid.resolution
    error = np.abs(heights - truth)[clear]
    names = ("p50", "p99", "p99.9", "max")
    return {
        "points_per_m2": density,
        "columns": int(clear.sum()),
        "error_m": dict(zip(names, np.percentile(error, [50, 99, 99.9, 100]).tolist(), strict=True)),
        "below_1_cm": float((error < 0.01).mean()),
    }


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sides", default="10,32,100", help="cells along a side, of each map")
    parser.add_argument("--density", type=float, default=400.0, help="of the town, points per m²")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        directory = Path(name)
        exact = accuracy(directory, args.density)
        rows = []
        for side in map(int, args.sides.split(",")):
            root = directory / f"terrain{side}"
            write_terrain(root, side)
            one = DaemonProcess(root).start()
            try:
                row = run_program(one, root, "--resolution", "0.7", "--tolerance", "1.0")
                again = run_program(one, root, "--resolution", "0.7", "--tolerance", "1.0")
            finally:
                one.stop()
                one.dispose()
            row["again_s"], row["again_loaded"] = again["seconds"], again["loaded"]
            with np.load(root / "map.npz") as read:
                height, kind = read["height"], read["kind"]
                origin, step = read["origin"], float(read["resolution"])
            j, i = np.nonzero(kind == 1)
            truth = terrain(origin[0] + (i + 0.5) * step, origin[1] + (j + 0.5) * step)
            row["error_p99_m"] = float(np.percentile(np.abs(height[j, i] - truth), 99))
            rows.append(row)
    if args.json:
        print(json.dumps({"accuracy": exact, "memory": rows}, indent=1))
        return
    e = exact["error_m"]
    print(
        f"town, {exact['points_per_m2']:g} points/m², {exact['columns']} columns away from edges:"
        f" error p50 {e['p50'] * 1e3:.1f} mm, p99 {e['p99'] * 1e3:.1f}, p99.9 {e['p99.9'] * 1e3:.1f},"
        f" max {e['max'] * 1e3:.1f}; {100 * exact['below_1_cm']:.2f} % below 10 mm"
    )
    print("\n   cells     columns   seconds  ms a cell  peak anonymous    again  p99 error")
    for row in rows:
        columns = row["rows"] * row["columns"]
        print(
            f"{row['cells']:8}{columns:12}{row['seconds']:10.1f}{1e3 * row['seconds'] / row['cells']:11.2f}"
            f"{row['peak_bytes'] / MIB:12.1f} MiB{row['again_s']:7.1f} s{row['error_p99_m'] * 1e3:8.1f} mm"
        )


if __name__ == "__main__":
    main()
