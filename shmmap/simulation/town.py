# SPDX-License-Identifier: Apache-2.0
"""A seeded town of any size as a point-cloud map: hills, streets, buildings, trees, lamps and walls.

Each tile (one block of 80 m) is generated independently, and is always the same for a seed.  So a map of any
size needs the memory of one tile, and its tiles can be made in any order.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shmmap.dividing.map_writer import MapWriter, WrittenMap
from shmmap.errors import BadRequest
from shmmap.simulation.town_blocks import build_block
from shmmap.simulation.town_surfaces import BLOCK_METRES, ROAD_HALF_METRES, Ground, Surfaces, street_distance

_GROUND_NOISE_METRES = 0.015
_FOOTPRINT_METRES = 0.25  # cells of the raster in which buildings hide the ground
_ASPHALT, _PAINT, _PAVING, _GRASS = 22.0, 130.0, 48.0, 72.0
_LANE_METRES = 1.5  # offset to the right of the centre line
_TURN_METRES = 6.0  # radius of a corner, on the centre line
_HEADINGS = ((1, 0), (0, 1), (-1, 0), (0, -1))


class Town:
    """A generated town; the same arguments (and numpy version) give the same town.

    Parameters
    ----------
    seed
        Random seed of the town.
    blocks
        Number of 80 m blocks in x and in y.
    origin
        Map coordinates of the town's lower left corner, metres, multiples of 20: blocks then consist
        of whole 20 m cells.
    density
        Points per square metre of ground; one block has about ``16 000 * density`` points.

    Raises
    ------
    BadRequest
        An argument is invalid.
    """

    def __init__(
        self,
        *,
        seed: int = 0,
        blocks: tuple[int, int] = (4, 4),
        origin: tuple[float, float] = (0.0, 0.0),
        density: float = 20.0,
    ) -> None:
        if min(blocks) < 1:
            raise BadRequest(f"a town needs at least one block each way, not {blocks}")
        if any(value % 20.0 for value in origin):
            raise BadRequest(f"the town's origin must be multiples of 20 m, not {origin}")
        if not (math.isfinite(density) and density > 0):
            raise BadRequest(f"the density must be a positive number of points per m², not {density}")
        if seed < 0:
            raise BadRequest(f"the seed must not be negative, it is {seed}")
        self.seed = seed
        self.blocks = blocks
        self.origin = origin
        self.density = density
        self._ground = Ground(seed)

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """``min_x, min_y, max_x, max_y`` in metres, map frame."""
        x, y = self.origin
        return x, y, x + self.blocks[0] * BLOCK_METRES, y + self.blocks[1] * BLOCK_METRES

    def ground_height(self, x: Any, y: Any) -> NDArray[np.float64]:
        """Return the height of the ground at map coordinates (metres, any equal shapes), metres, float64.

        Ground points scatter about this height with a standard deviation of 15 mm, plus the effect of
        rounding x and y to float32.
        """
        x, y = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
        return self._ground.height(x - self.origin[0], y - self.origin[1])

    def route(self, *, length: float = 1000.0, step: float = 1.0) -> NDArray[np.float64]:
        """Return poses of a drive through the streets, every ``step`` metres, (N, 3) float64.

        x and y in metres, map frame; heading in radians counter-clockwise from +x, not wrapped.
        """
        if not (math.isfinite(length) and length > 0 and math.isfinite(step) and step > 0):
            raise BadRequest(f"length and step must be positive, not {length} and {step}")
        poses = drive(self.seed, self.blocks, length, step)
        poses[:, :2] += self.origin
        return poses

    def tiles(self) -> Iterator[dict[str, NDArray[np.float32]]]:
        """Yield the columns of every tile, see `tile`."""
        for by in range(self.blocks[1]):
            for bx in range(self.blocks[0]):
                yield self.tile(bx, by)

    def tile(self, bx: int, by: int) -> dict[str, NDArray[np.float32]]:
        """Return one block: ``xyz`` (N, 3) float32, metres, map frame; ``intensity`` (N,) float32, 0..255.

        All points lie in the block's half-open square.
        """
        if not (0 <= bx < self.blocks[0] and 0 <= by < self.blocks[1]):
            raise BadRequest(f"the town has no block {bx}, {by}")
        rng = np.random.Generator(np.random.SFC64([self.seed, 3, bx, by]))
        corner = np.array((bx * BLOCK_METRES, by * BLOCK_METRES))

        def ground(x: float, y: float) -> float:
            return float(self._ground.height(np.array(corner[0] + x), np.array(corner[1] + y)))

        surfaces = build_block(rng, ground)
        ground_xyz, ground_intensity = self._sample_ground(rng, surfaces, corner)
        above_xyz, above_intensity = surfaces.sample(rng, self.density)
        seen = self._above_ground(above_xyz, corner)
        xyz = np.concatenate((ground_xyz, above_xyz[seen]))
        intensity = np.concatenate((ground_intensity, above_intensity[seen]))
        return {"xyz": self._placed(xyz, corner), "intensity": np.clip(intensity, 0.0, 255.0, out=intensity)}

    def write(self, out_dir: str | os.PathLike[str], *, prefix: str = "town") -> WrittenMap:
        """Write the town as a divided map of 20 m cells.

        Raises
        ------
        BadRequest
            ``out_dir`` exists and is not empty.
        """
        with MapWriter(out_dir, prefix=prefix, durable=False) as writer:
            for columns in self.tiles():
                writer.add(columns)
            return writer.finish()

    def _sample_ground(
        self, rng: np.random.Generator, surfaces: Surfaces, corner: NDArray[np.float64]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        side = max(1, round(BLOCK_METRES * math.sqrt(self.density)))
        pitch = BLOCK_METRES / side
        # one point at a random place in each square of a fine grid: even, like a filtered map
        x, y = rng.random((2, side, side), dtype=np.float32)
        x += np.arange(side, dtype=np.float32)
        y += np.arange(side, dtype=np.float32)[:, None]
        x, y = x.ravel() * np.float32(pitch), y.ravel() * np.float32(pitch)
        hidden = _footprints(surfaces)
        last = len(hidden) - 1
        column = np.minimum((x / _FOOTPRINT_METRES).astype(np.int32), last)
        row = np.minimum((y / _FOOTPRINT_METRES).astype(np.int32), last)
        seen = ~hidden[row, column]
        x, y = x[seen], y[seen]
        # the height at the point's place after rounding to float32
        map_x, map_y = (self._rounded(local, corner, axis) for axis, local in enumerate((x, y)))
        z = self._ground.height(map_x, map_y)
        z += _GROUND_NOISE_METRES * rng.standard_normal(len(z), dtype=np.float32)
        away = street_distance(map_x, map_y)
        along = np.maximum(np.abs(x - BLOCK_METRES / 2), np.abs(y - BLOCK_METRES / 2))
        dashed = (away < 0.08) & (((x + y) % 6.0) < 3.0) & (along > BLOCK_METRES / 2 - 0.2)
        intensity = np.select(
            [dashed, away < ROAD_HALF_METRES, away < ROAD_HALF_METRES + 2.5],
            [_PAINT, _ASPHALT, _PAVING],
            _GRASS,
        ).astype(np.float32)
        intensity += 4.0 * rng.standard_normal(len(z), dtype=np.float32)
        return np.column_stack((x, y, z)).astype(np.float32), intensity

    def _rounded(
        self, local: NDArray[np.float32], corner: NDArray[np.float64], axis: int
    ) -> NDArray[np.float64]:
        """Return town coordinates of tile coordinates, rounded as in `_placed`."""
        start = float(corner[axis]) + self.origin[axis]
        town: NDArray[np.float64] = (local + start).astype(np.float32).astype(np.float64) - self.origin[axis]
        return town

    def _above_ground(self, xyz: NDArray[np.float32], corner: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return a mask of the points above ground (walls reach below the ground of a slope)."""
        xs = np.linspace(0.0, BLOCK_METRES, 9)
        highest = float(self._ground.terrain(corner[0] + xs, corner[1] + xs[:, None]).max()) + 1.0
        seen = np.ones(len(xyz), dtype=np.bool_)
        low = np.flatnonzero(xyz[:, 2] < highest)
        x, y, z = xyz[low].T
        seen[low] = z >= self._ground.height(corner[0] + x, corner[1] + y)
        return seen

    def _placed(self, xyz: NDArray[np.float32], corner: NDArray[np.float64]) -> NDArray[np.float32]:
        """Return map coordinates, kept inside the tile despite rounding at its far sides."""
        placed: NDArray[np.float32] = xyz.copy()
        for axis in range(2):
            start = float(corner[axis]) + self.origin[axis]
            last = np.nextafter(np.float32(start + BLOCK_METRES), np.float32(-np.inf))
            placed[:, axis] = np.clip((xyz[:, axis] + start).astype(np.float32), np.float32(start), last)
        return placed


def _footprints(surfaces: Surfaces) -> NDArray[np.bool_]:
    """Return a raster of the tile, row by row, True where a building hides the ground."""
    side = round(BLOCK_METRES / _FOOTPRINT_METRES)
    hidden = np.zeros((side, side), dtype=np.bool_)
    for x, y, half_x, half_y, yaw in surfaces.footprints:
        reach = math.hypot(half_x, half_y)
        rows, columns = (
            slice(
                max(0, math.floor((middle - reach) / _FOOTPRINT_METRES)),
                max(0, math.ceil((middle + reach) / _FOOTPRINT_METRES)),
            )
            for middle in (y, x)
        )
        dx = (np.arange(side)[columns] + 0.5) * _FOOTPRINT_METRES - x
        dy = (np.arange(side)[rows, None] + 0.5) * _FOOTPRINT_METRES - y
        along, across = dx * math.cos(yaw) + dy * math.sin(yaw), dy * math.cos(yaw) - dx * math.sin(yaw)
        hidden[rows, columns] |= (np.abs(along) <= half_x) & (np.abs(across) <= half_y)
    return hidden


def drive(seed: int, blocks: tuple[int, int], length: float, step: float) -> NDArray[np.float64]:
    """Return a drive on the right of the streets, with arcs at corners; at least ``length`` metres.

    The poses are ``step`` metres apart, (N, 3) float64: x, y in town coordinates, metres; heading in radians
    counter-clockwise from +x, continuous (not wrapped).
    """
    crossings = _walk(seed, blocks, max(2, math.ceil(length / BLOCK_METRES) + 2))
    poses = _follow(crossings)
    gaps = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    travelled = np.concatenate(([0.0], np.cumsum(gaps)))
    at = np.arange(0.0, min(length, float(travelled[-1])) + step / 2, step)
    return np.column_stack([np.interp(at, travelled, poses[:, i]) for i in range(3)])


def _walk(seed: int, blocks: tuple[int, int], steps: int) -> list[tuple[int, int]]:
    """Return the crossings visited, without turning round and preferring streets not driven yet."""
    rng = np.random.Generator(np.random.PCG64([seed, 2]))
    # the outermost streets lie half outside the town
    inner = min(blocks) >= 3
    low = 1 if inner else 0
    high = (blocks[0] - 1, blocks[1] - 1) if inner else blocks
    here = ((low + high[0]) // 2, (low + high[1]) // 2)
    visits: dict[frozenset[tuple[int, int]], int] = {}
    path, heading = [here], int(rng.integers(4))
    while len(path) <= steps:
        options = []
        for turn in (0, 1, 3, 2):
            dx, dy = _HEADINGS[(heading + turn) % 4]
            there = (here[0] + dx, here[1] + dy)
            if low <= there[0] <= high[0] and low <= there[1] <= high[1]:
                # turn round only if there is no other choice
                cost = visits.get(frozenset((here, there)), 0) + (1e6 if turn == 2 and len(path) > 1 else 0)
                options.append((cost + float(rng.random()) * 0.5, turn, there))
        _, turn, there = min(options)
        visits[frozenset((here, there))] = visits.get(frozenset((here, there)), 0) + 1
        heading, here = (heading + turn) % 4, there
        path.append(here)
    return path


def _follow(crossings: list[tuple[int, int]]) -> NDArray[np.float64]:
    """Return poses in the right lane along the crossings, densest at the corners."""
    nodes = np.array(crossings, dtype=np.float64) * BLOCK_METRES
    directions = np.diff(nodes, axis=0) / BLOCK_METRES
    heading = math.atan2(directions[0, 1], directions[0, 0])
    poses: list[tuple[float, float, float]] = [(*nodes[0], heading)]
    for node, ahead, onward in zip(nodes[1:-1], directions[:-1], directions[1:], strict=True):
        turn = math.atan2(ahead[0] * onward[1] - ahead[1] * onward[0], float(ahead @ onward))
        if abs(turn) < 1e-9:
            poses.append((*node, heading))
            continue
        left = np.array([-ahead[1], ahead[0]]) * math.copysign(1.0, turn)
        start = node - ahead * _TURN_METRES
        center = start + left * _TURN_METRES
        for part in np.linspace(0.0, 1.0, 25):
            angle = part * abs(turn)
            spot = center + _TURN_METRES * (ahead * math.sin(angle) - left * math.cos(angle))
            poses.append((*spot, heading + part * turn))
        heading += turn
    poses.append((*nodes[-1], heading))
    path = np.array(poses)
    path[:, 0] += _LANE_METRES * np.sin(path[:, 2])
    path[:, 1] -= _LANE_METRES * np.cos(path[:, 2])
    return path
