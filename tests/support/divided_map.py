# SPDX-License-Identifier: Apache-2.0
"""Makes divided maps in Autoware's layout, independent of shmmap's map writer."""

from __future__ import annotations

import functools
import math
import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Box = tuple[float, float, float, float]


@dataclass
class DividedMap:
    """A divided map on disk: ``root/pointcloud_map.pcd/*.pcd`` and the YAML beside that directory."""

    root: Path
    size: float = 20.0
    corners: dict[str, tuple[int, int]] = field(default_factory=dict)

    @property
    def pcd_dir(self) -> Path:
        """Directory of the cell files."""
        return self.root / "pointcloud_map.pcd"

    def id(self, name: str) -> str:
        """Cell id of a file: its absolute path."""
        return str(self.pcd_dir / name)

    def box(self, name: str) -> Box:
        """Box of a cell."""
        x, y = self.corners[name]
        return float(x), float(y), x + self.size, y + self.size

    def points(self, name: str) -> dict[str, NDArray[Any]]:
        """What the file holds now, read independently."""
        return read_pcd(self.pcd_dir / name)

    def write_cell(self, name: str, corner: tuple[int, int], columns: dict[str, NDArray[Any]]) -> None:
        """Write one cell by rename, so that no reader sees half of it."""
        self.corners[name] = corner
        interim = self.root / f"{name}.writing"
        write_pcd(interim, columns)
        interim.rename(self.pcd_dir / name)

    def change(self, name: str, seed: int, count: int = 700) -> None:
        """Give a cell other points."""
        corner = self.corners[name]
        self.write_cell(name, corner, random_points(np.random.default_rng(seed), corner, count, self.size))

    def remove_cell(self, name: str) -> None:
        """Delete a cell's file and entry."""
        del self.corners[name]
        (self.pcd_dir / name).unlink()

    def write_metadata(self) -> None:
        """Write the YAML for the cells as they are."""
        lines = [f"x_resolution: {self.size}", f"y_resolution: {self.size}"]
        lines += [f"{name}: [{x}, {y}]" for name, (x, y) in sorted(self.corners.items())]
        interim = self.root / "metadata.writing"
        interim.write_text("\n".join(lines) + "\n")
        interim.rename(self.root / "pointcloud_map_metadata.yaml")

    def in_circle(self, x: float, y: float, radius: float) -> list[str]:
        """Names of the cells a true circle touches, in id order."""
        found = []
        for name, (x0, y0) in sorted(self.corners.items()):
            dx = max(x0 - x, 0.0, x - (x0 + self.size))
            dy = max(y0 - y, 0.0, y - (y0 + self.size))
            if dx * dx + dy * dy <= radius * radius:
                found.append(name)
        return found

    def in_square(self, x: float, y: float, radius: float) -> list[str]:
        """Names of the cells Autoware's area test finds (centres and corners exact in float32)."""
        return [
            name
            for name, (x0, y0) in sorted(self.corners.items())
            if x0 - radius <= x <= x0 + self.size + radius and y0 - radius <= y <= y0 + self.size + radius
        ]


def random_points(
    rng: np.random.Generator, corner: tuple[int, int], count: int, size: float = 20.0
) -> dict[str, NDArray[Any]]:
    """Points inside one cell: x, y, z, intensity, float32."""
    return {
        "x": (corner[0] + rng.random(count) * size).astype(np.float32),
        "y": (corner[1] + rng.random(count) * size).astype(np.float32),
        "z": (rng.random(count) * 8).astype(np.float32),
        "intensity": rng.integers(0, 256, count).astype(np.float32),
    }


def make_map(
    root: Path, *, columns: int = 6, rows: int = 6, points: int = 500, seed: int = 1, size: int = 20
) -> DividedMap:
    """Make a map of columns x rows cells, its middle at the origin."""
    made = DividedMap(root, float(size))
    made.pcd_dir.mkdir(parents=True)
    for corner, data in _cells(columns, rows, points, seed, size):
        name = f"{corner[0]}_{corner[1]}.pcd"
        made.corners[name] = corner
        with open(f"{made.pcd_dir}/{name}", "wb") as file:
            file.write(data)
    made.write_metadata()
    return made


@functools.lru_cache(4)  # nearly all tests have one of these maps
def _cells(
    columns: int, rows: int, points: int, seed: int, size: int
) -> tuple[tuple[tuple[int, int], bytes], ...]:
    """Return each cell's corner and file."""
    rng = np.random.default_rng(seed)
    corners = [
        ((i - columns // 2) * size, (j - rows // 2) * size) for i in range(columns) for j in range(rows)
    ]
    return tuple((corner, pcd_bytes(random_points(rng, corner, points, size))) for corner in corners)


# A small PCD writer and reader for tests, independent of shmmap's


_KIND = {"f": "F", "i": "I", "u": "U"}


def write_pcd(path: Path, columns: dict[str, NDArray[Any]]) -> None:
    """Write one-dimensional columns, in order, as a binary PCD; in place, without a temporary file."""
    path.write_bytes(pcd_bytes(columns))


def pcd_bytes(columns: dict[str, NDArray[Any]]) -> bytes:
    """Return the file that `write_pcd` writes."""
    names = list(columns)
    rows = len(columns[names[0]])
    record = np.zeros(rows, dtype=[(name, columns[name].dtype) for name in names])
    for name in names:
        record[name] = columns[name]
    lines = [
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        "FIELDS " + " ".join(names),
        "SIZE " + " ".join(str(columns[n].dtype.itemsize) for n in names),
        "TYPE " + " ".join(_KIND[columns[n].dtype.kind] for n in names),
        "COUNT " + " ".join("1" for _ in names),
        f"WIDTH {rows}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {rows}",
        "DATA binary",
    ]
    return "\n".join(lines).encode() + b"\n" + record.tobytes()


def read_pcd(path: Path) -> dict[str, NDArray[Any]]:
    """Read a binary PCD without padding; a field of k > 1 values becomes (N, k)."""
    data = path.read_bytes()
    end = data.index(b"\n", data.index(b"DATA ")) + 1
    keys = {}
    for line in data[:end].decode("ascii", "replace").splitlines():
        if line and not line.startswith("#"):
            key, *values = line.split()
            keys[key.upper()] = values
    assert keys["DATA"] == ["binary"]
    kinds = {"F": "f", "I": "i", "U": "u"}
    described = zip(keys["FIELDS"], keys["TYPE"], keys["SIZE"], keys["COUNT"], strict=True)
    dtype = np.dtype(
        [
            (n, f"<{kinds[t]}{s}", (int(k),)) if k != "1" else (n, f"<{kinds[t]}{s}")
            for n, t, s, k in described
        ]
    )
    record = np.frombuffer(data, dtype, int(keys["POINTS"][0]), end)
    return {name: np.ascontiguousarray(record[name]) for name in keys["FIELDS"]}


def write_ascii(path: Path, points: int) -> Path:
    """Write a file that needs more memory than it is long: "1 2 3" is 6 bytes, three floats are 12."""
    head = f"VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {points}\nHEIGHT 1\n"
    path.write_text(f"{head}POINTS {points}\nDATA ascii\n" + "1 2 3\n" * points)
    return path


# Autoware's test of which cells an area touches, ported from autoware_map_loader's utils.cpp


Rectangle = tuple[float, float, float, float]


def f32(value: float) -> float:
    """Round to float32 without numpy."""
    rounded: float = struct.unpack("<f", struct.pack("<f", value))[0]
    return rounded


def cylinder_and_box_overlap_exists(x: float, y: float, radius: float, box: Rectangle) -> bool:
    """Both clauses; messages carry float32, the arithmetic is double."""
    x, y, radius = f32(x), f32(y), f32(radius)
    min_x, min_y, max_x, max_y = map(f32, box)
    if min_x - radius <= x <= max_x + radius and min_y - radius <= y <= max_y + radius:
        return True
    corners = ((min_x, min_y), (min_x, max_y), (max_x, min_y), (max_x, max_y))
    return any(math.hypot(x - cx, y - cy) <= radius for cx, cy in corners)
