# SPDX-License-Identifier: Apache-2.0
"""Makes divided maps in Autoware's layout, independent of shmmap's map writer."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.support.pcd_files import read_pcd, write_pcd

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
        """Write one cell by rename, so that nobody sees half of it."""
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
    rng = np.random.default_rng(seed)
    for i in range(columns):
        for j in range(rows):
            corner = ((i - columns // 2) * size, (j - rows // 2) * size)
            made.write_cell(f"{corner[0]}_{corner[1]}.pcd", corner, random_points(rng, corner, points, size))
    made.write_metadata()
    return made
