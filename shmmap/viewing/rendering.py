# SPDX-License-Identifier: Apache-2.0
"""Render points into a z-buffer, from above or obliquely, and colour and shade what is seen.

The projection is parallel, so that one scale holds everywhere and a pixel's depth gives its point back.
Memory is that of the picture and of one block of points, however large the map is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap.geometry import Box

Vector = tuple[float, float, float]
Image = NDArray[np.float32]

_BLOCK: Final = 1 << 17  # points at a time: their temporaries fit a processor's cache
_STRIP: Final = 64  # rows of pixels at a time
_SPARSE: Final = 25.0  # percentile of the density that decides how far points grow
_MAX_SPLAT: Final = 4  # pixels that a point of a sparse cloud may grow to each side
_HIDING: Final = 5  # of 8 neighbours that are nearer: what is seen between them lies behind a surface
_SURROUNDED: Final = 4  # of 8 neighbours that are filled: a gap in a surface


@dataclass(frozen=True)
class Camera:
    """A parallel projection of the map frame onto a picture.

    Attributes
    ----------
    width, height
        Size of the picture, pixels.
    centre
        Point of the map frame, metres, in the middle of the picture.
    right, up, toward
        Unit vectors in the map frame: the picture's axes, and the direction towards the viewer.
    scale
        Pixels per metre.
    """

    width: int
    height: int
    centre: Vector
    right: Vector
    up: Vector
    toward: Vector
    scale: float

    @classmethod
    def looking(
        cls, low: Vector, high: Vector, width: int, height: int, azimuth: float | None, elevation: float
    ) -> Camera:
        """Return the camera that shows a box as large as possible.

        Parameters
        ----------
        low, high
            Corners of the box, metres.
        azimuth
            Direction in which one looks, radians from x to y; None: from above, y upwards.
        elevation
            Angle of the line of sight below the horizon, radians, unless it is from above.
        """
        azimuth, elevation = (math.pi / 2, math.pi / 2) if azimuth is None else (azimuth, elevation)
        cos_a, sin_a = _clean(math.cos(azimuth)), _clean(math.sin(azimuth))
        cos_e, sin_e = _clean(math.cos(elevation)), math.sin(elevation)
        right = (sin_a, -cos_a, 0.0)
        up = (cos_a * sin_e, sin_a * sin_e, cos_e)
        toward = (-cos_a * cos_e, -sin_a * cos_e, sin_e)
        half = [(b - a) / 2 for a, b in zip(low, high, strict=True)]
        spans = [2 * sum(abs(part) * h for part, h in zip(axis, half, strict=True)) for axis in (right, up)]
        scale = min(width / max(spans[0], 1e-3), height / max(spans[1], 1e-3))
        centre = tuple((a + b) / 2 for a, b in zip(low, high, strict=True))
        return cls(width, height, (centre[0], centre[1], centre[2]), right, up, toward, scale)

    def place(self, x: float, y: float, z: float) -> tuple[float, float]:
        """Return the position of a point in the picture, pixels: to the right, and downwards."""
        apart = (x - self.centre[0], y - self.centre[1], z - self.centre[2])
        along = [sum(a * b for a, b in zip(axis, apart, strict=True)) for axis in (self.right, self.up)]
        return self.width / 2 + along[0] * self.scale, self.height / 2 - along[1] * self.scale


def _clean(value: float) -> float:
    """Return a cosine without its rounding error at right angles, which would cost a term for each point."""
    return 0.0 if abs(value) < 1e-12 else value


class PointImage:
    """The nearest point of each pixel.

    Parameters
    ----------
    camera
        The projection.
    crop
        Points outside are left out, also where the picture would show them.

    Attributes
    ----------
    points
        Number of points added that lie in the picture.
    depth
        Metres towards the viewer from the camera's centre, (rows, columns); minus infinity: no point.
    values
        The value of each pixel's point, where values were added.
    ground
        Lowest points of the ground, if ``with_ground``.
    """

    def __init__(self, camera: Camera, crop: Box | None = None, *, with_ground: bool = False) -> None:
        self.camera = camera
        self.points = 0
        self.depth = np.full((camera.height, camera.width), -np.inf, np.float32)
        self.values = np.full((camera.height, camera.width), np.nan, np.float32)
        self.has_values = False
        self._crop = crop
        self.ground: GroundGrid | None = None
        if with_ground:
            self.ground = GroundGrid(_ground_box(camera) if crop is None else crop.bounds)

    def add(
        self, xyz: NDArray[Any], origin: Vector = (0.0, 0.0, 0.0), values: NDArray[Any] | None = None
    ) -> None:
        """Add points: (N, 3), metres, relative to ``origin`` in the map frame; and (N,) values."""
        for start in range(0, len(xyz), _BLOCK):
            rows = slice(start, start + _BLOCK)
            self._add(xyz[rows], origin, None if values is None else values[rows])

    def _add(self, xyz: NDArray[Any], origin: Vector, values: NDArray[Any] | None) -> None:
        camera = self.camera
        kind = np.float64 if xyz.dtype == np.float64 else np.float32
        # whole metres are subtracted in the points' own type without a rounding error, the rest is a constant
        near = [float(np.round(c - o)) for c, o in zip(camera.centre, origin, strict=True)]
        rest = [n + o - c for n, o, c in zip(near, origin, camera.centre, strict=True)]
        axes = [xyz[:, axis].astype(kind, copy=False) - kind(near[axis]) for axis in range(3)]
        column = _along(camera.right, axes, rest, camera.scale, camera.width / 2)
        row = _along(camera.up, axes, rest, -camera.scale, camera.height / 2)
        depth = _along(camera.toward, axes, rest, 1.0, 0.0).astype(np.float32, copy=False)
        if not self._all_inside(column, row, depth, axes, rest):
            inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
            inside &= np.isfinite(depth)
            if self._crop is not None:
                for axis, low, high in self._cropped(rest):
                    inside &= (axes[axis] >= low) & (axes[axis] <= high)
            column, row, depth = column[inside], row[inside], depth[inside]
            axes = [part[inside] for part in axes]
            values = values[inside] if values is not None else None
        if not len(depth):
            return
        self.points += len(depth)
        pixel = row.astype(np.int32)
        pixel *= camera.width
        pixel += column.astype(np.int32)
        nearest = self.depth.reshape(-1)
        np.maximum.at(nearest, pixel, depth)
        if values is not None:
            self.has_values = True
            seen = depth == nearest[pixel]
            self.values.reshape(-1)[pixel[seen]] = values[seen]
        if self.ground is not None:
            self.ground.add(
                *(part + kind(r + c) for part, r, c in zip(axes, rest, camera.centre, strict=True))
            )

    def _cropped(self, rest: list[float]) -> list[tuple[int, float, float]]:
        """Return the crop as axis, lowest and highest value, relative as the points are."""
        crop, centre = self._crop, self.camera.centre
        assert crop is not None  # noqa: S101
        found = [(0, crop.min_x, crop.max_x), (1, crop.min_y, crop.max_y)]
        if crop.z is not None:
            found.append((2, *crop.z))
        return [
            (axis, low - centre[axis] - rest[axis], high - centre[axis] - rest[axis])
            for axis, low, high in found
        ]

    def _all_inside(
        self,
        column: NDArray[Any],
        row: NDArray[Any],
        depth: Image,
        axes: list[NDArray[Any]],
        rest: list[float],
    ) -> bool:
        """Whether no point has to be left out."""
        within = [(column, 0.0, float(self.camera.width)), (row, 0.0, float(self.camera.height))]
        if self._crop is not None:
            within += [(axes[axis], low, high) for axis, low, high in self._cropped(rest)]
        with np.errstate(invalid="ignore"):
            return all(len(v) and v.min() >= low and v.max() < high for v, low, high in within) and bool(
                np.isfinite(depth.max()) and np.isfinite(depth.min())
            )

    # --- after the last point -------------------------------------------------------------------

    def fill_gaps(self) -> None:
        """Let points grow where they lie farther apart than pixels, and hide what is seen between them."""
        filled = np.isfinite(self.depth)
        if not filled.any():
            return
        spacing = _spacing(filled)
        for _ in range(min(_MAX_SPLAT, int(spacing / 2.0 + 0.3))):
            self._grow(2.0 * spacing, 1)
        for _ in range(4):  # gaps in what is dense, without thicker edges
            self._grow(2.0 * spacing, _SURROUNDED)

    def _grow(self, step: float, beside: int) -> None:
        """Fill pixels that `_HIDING` neighbours hide, and empty ones with ``beside`` filled neighbours.

        A neighbour hides a pixel if it is nearer by more than ``step`` pixels.
        """
        before, behind = self.depth, self.depth + np.float32(step / self.camera.scale)
        shifted = _neighbours(before, fill=-np.inf)
        hiding = np.zeros(before.shape, np.uint8)
        for part in shifted:
            hiding += part > behind
        chosen = np.flatnonzero((hiding >= _HIDING) | ((hiding >= beside) & ~np.isfinite(before)))
        parts = np.stack([part.reshape(-1)[chosen] for part in shifted])
        best = parts.argmax(axis=0)
        if self.has_values:
            values = np.stack([part.reshape(-1)[chosen] for part in _neighbours(self.values, fill=np.nan)])
            self.values.reshape(-1)[chosen] = values[best, np.arange(len(chosen))]
        self.depth = before.copy()
        self.depth.reshape(-1)[chosen] = parts[best, np.arange(len(chosen))]

    def heights(self) -> Image:
        """Return z of each pixel's point, metres; above the ground if there is one; NaN without a point."""
        camera, ground = self.camera, self.ground.surface() if self.ground is not None else None
        found = np.empty(self.depth.shape, np.float32)
        u = (np.arange(camera.width) + 0.5 - camera.width / 2)[None, :] / camera.scale
        for first in range(0, camera.height, _STRIP):
            rows = slice(first, first + _STRIP)
            v = (camera.height / 2 - np.arange(camera.height)[rows] - 0.5)[:, None] / camera.scale
            depth = np.where(np.isfinite(self.depth[rows]), self.depth[rows], np.nan).astype(np.float64)
            x, y, z = (
                c + u * r + v * up + depth * t
                for c, r, up, t in zip(camera.centre, camera.right, camera.up, camera.toward, strict=True)
            )
            found[rows] = z if ground is None else z - ground.at(x, y)
        return found

    def level(self) -> float:
        """Return the height of the ground on the whole, metres: a low z of what is seen."""
        camera = self.camera
        if self.ground is not None:
            return float(np.median(self.ground.surface().heights))
        v = (camera.height / 2 - np.arange(camera.height) - 0.5)[:, None] / camera.scale
        z = camera.centre[2] + v * camera.up[2] + self.depth * camera.toward[2]
        return float(np.percentile(z[np.isfinite(z)], 5.0))

    def shade(self) -> Image:
        """Return the brightness of each pixel, 0 to 1: less where a neighbour is nearer to the viewer."""
        hidden = np.zeros(self.depth.shape, np.float32)
        for reach, weight in ((1, 0.6), (3, 0.4)):
            tolerance = np.float32(reach / self.camera.scale)
            for part in _neighbours(self.depth, fill=-np.inf, reach=reach):
                with np.errstate(invalid="ignore"):  # no point here, and none there
                    nearer = (part - self.depth) / tolerance - np.float32(0.5)
                hidden += np.float32(weight) * np.fmin(np.fmax(nearer, 0.0), 4.0)  # 0 where that is no number
        brightness: Image = np.exp(hidden * np.float32(-1 / 14))
        return brightness


def _spacing(filled: NDArray[np.bool_]) -> float:
    """Return the pixels between neighbouring points where these are rather far apart."""
    side = 2 * _MAX_SPLAT + 3
    sums = np.pad(filled, (side // 2 + 1, side // 2)).astype(np.int32).cumsum(axis=0).cumsum(axis=1)
    counts = sums[side:, side:] - sums[:-side, side:] - sums[side:, :-side] + sums[:-side, :-side]
    return side / math.sqrt(float(np.percentile(counts[filled], _SPARSE)))


def _ground_box(camera: Camera) -> tuple[float, float, float, float]:
    half_x, half_y = camera.width / 2 / camera.scale, camera.height / 2 / camera.scale
    x, y, _ = camera.centre
    return x - half_x, y - half_y, x + half_x, y + half_y


def _along(
    axis: Vector, axes: list[NDArray[Any]], rest: list[float], scale: float, offset: float
) -> NDArray[Any]:
    """Return the position of points along an axis of the picture."""
    kind = axes[0].dtype.type
    constant = kind(offset + scale * sum(part * r for part, r in zip(axis, rest, strict=True)))
    found: NDArray[Any] | None = None
    for part, values in zip(axis, axes, strict=True):
        if part:
            term = values * kind(part * scale)
            found = term if found is None else np.add(found, term, out=found)
    assert found is not None  # noqa: S101  an axis is a unit vector
    found += constant
    return found


def _neighbours(image: NDArray[Any], *, fill: float | bool, reach: int = 1) -> list[NDArray[Any]]:
    """Return the image eight times, each shifted so that a pixel has the value of a neighbour."""
    rows, columns = image.shape
    padded = np.pad(image, reach, constant_values=fill)
    steps = [(i, j) for i in (0, reach, 2 * reach) for j in (0, reach, 2 * reach) if (i, j) != (reach, reach)]
    return [padded[i : i + rows, j : j + columns] for i, j in steps]


class GroundGrid:
    """Heights of the ground, from what is seen from above.

    The surface is *opened*, in the language of image processing: what is narrower than a building, is cut
    off, and slopes stay as they are.  It is the uppermost points that count, since maps have points below the
    street, reflections in wet asphalt and glass.

    Parameters
    ----------
    box
        Area, metres, map frame.
    """

    _COLUMN_M: Final = 1.0
    _WIDEST_M: Final = 60.0  # of buildings
    _MAX_COLUMNS: Final = 1000  # along the longer side
    _EVERY: Final = 3  # each third point is looked at

    def __init__(self, box: tuple[float, float, float, float]) -> None:
        self._box = box
        span = max(box[2] - box[0], box[3] - box[1])
        self._edge = max(self._COLUMN_M, span / self._MAX_COLUMNS)
        rows, columns = (math.ceil((box[i + 2] - box[i]) / self._edge) + 1 for i in (1, 0))
        self._shape = rows + rows % 2, columns + columns % 2
        self._top = np.full(self._shape, -np.inf, np.float32)

    def add(self, x: NDArray[Any], y: NDArray[Any], z: NDArray[Any]) -> None:
        """Add points inside the box, metres, map frame."""
        every = self._EVERY if len(x) > 10_000 else 1
        x, y, z = x[::every], y[::every], z[::every]
        column = ((x - x.dtype.type(self._box[0])) / x.dtype.type(self._edge)).astype(np.int32)
        row = ((y - y.dtype.type(self._box[1])) / y.dtype.type(self._edge)).astype(np.int32)
        np.clip(column, 0, self._shape[1] - 1, out=column)
        np.clip(row, 0, self._shape[0] - 1, out=row)
        np.maximum.at(self._top.reshape(-1), row * self._shape[1] + column, z.astype(np.float32, copy=False))

    def surface(self) -> Surface:
        """Return the ground, in squares of 2 x 2 columns."""
        return Surface(self._squares(), self._box[0], self._box[1], 2 * self._edge)

    def _squares(self) -> NDArray[np.float64]:
        rows, columns = self._shape
        top = self._top.astype(np.float64)
        known = np.isfinite(top)
        if not known.any():
            return np.zeros((rows // 2, columns // 2))
        # single columns far below the street are gullies and reflections beside it
        nine = np.stack([top, *_neighbours(top, fill=-np.inf)])
        nine[~np.isfinite(nine)] = np.inf
        nine.sort(axis=0)
        low = np.where(known & np.isfinite(nine[2]), nine[2], np.inf)
        low = low.reshape(rows // 2, 2, columns // 2, 2).min(axis=(1, 3))
        slope = _slope(low)
        low -= slope  # at the border, where there is nothing beyond, a slope would be cut off
        radius = math.ceil(self._WIDEST_M / 4 / self._edge)
        eroded = _extreme(low, radius, np.minimum, np.inf)
        opened = _extreme(np.where(np.isfinite(eroded), eroded, -np.inf), radius, np.maximum, -np.inf)
        is_found = np.isfinite(opened)
        opened[~is_found] = np.median(opened[is_found]) if is_found.any() else 0.0
        return opened + slope


def _slope(low: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the plane through the lower half of heights, the infinite ones ignored."""
    y, x = np.indices(low.shape)
    sides = np.stack([np.ones(low.size), x.ravel(), y.ravel()], axis=1)
    heights = low.ravel()
    chosen = np.isfinite(heights)
    plane = np.zeros(low.size)
    for _ in range(4):
        if np.count_nonzero(chosen) < 3:
            break
        plane = sides @ np.linalg.lstsq(sides[chosen], heights[chosen], rcond=None)[0]
        above = heights - plane
        chosen = above <= np.median(above[np.isfinite(above)])
    return plane.reshape(low.shape)


@dataclass(frozen=True)
class Surface:
    """Heights, metres, of the middles of squares of ``edge`` metres, from a corner on."""

    heights: NDArray[np.float64]
    min_x: float
    min_y: float
    edge: float

    def at(self, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return heights at places, interpolated."""
        rows, columns = self.heights.shape
        at_x = np.nan_to_num((x - self.min_x) / self.edge - 0.5).clip(0.0, columns - 1.0)
        at_y = np.nan_to_num((y - self.min_y) / self.edge - 0.5).clip(0.0, rows - 1.0)
        column, row = at_x.astype(np.int32), at_y.astype(np.int32)
        right, above = np.minimum(column + 1, columns - 1), np.minimum(row + 1, rows - 1)
        at_x, at_y = at_x - column, at_y - row
        first = self.heights[row, column] * (1 - at_x) + self.heights[row, right] * at_x
        second = self.heights[above, column] * (1 - at_x) + self.heights[above, right] * at_x
        found: NDArray[np.float64] = first * (1 - at_y) + second * at_y
        return found


def _extreme(image: NDArray[np.float64], radius: int, extreme: np.ufunc, fill: float) -> NDArray[np.float64]:
    """Return the extreme of the square of ``radius`` around each pixel."""
    for axis in (0, 1):
        size = image.shape[axis]
        padding = [(radius, radius) if axis == i else (0, 0) for i in (0, 1)]
        padded = np.moveaxis(np.pad(image, padding, constant_values=fill), axis, 0)
        found = padded[:size].copy()
        for shift in range(1, 2 * radius + 1):
            extreme(found, padded[shift : shift + size], out=found)
        image = np.moveaxis(found, 0, axis)
    return np.ascontiguousarray(image)


# --- colours --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Ramp:
    """A scale of colours: RGB at equally spaced places between the lowest and the highest value."""

    stops: tuple[tuple[int, int, int], ...]

    def colours(self, share: NDArray[Any]) -> NDArray[np.float32]:
        """Return colours, (..., 3) float32, of places on the scale, 0 to 1."""
        table = np.array(self.stops, np.float32)
        at = np.linspace(0.0, 1.0, 256) * (len(table) - 1)
        first = np.minimum(at.astype(np.intp), len(table) - 2)
        part = (at - first)[:, None]
        fine = (table[first] * (1 - part) + table[first + 1] * part).astype(np.float32)
        found: NDArray[np.float32] = fine[(np.clip(np.nan_to_num(share), 0.0, 1.0) * 255.0).astype(np.uint8)]
        return found


def coloured(
    image: PointImage, shown: NDArray[Any], low: float, high: float, ramp: Ramp
) -> NDArray[np.uint8]:
    """Return the picture, (rows, columns, 4) RGBA: shaded, transparent where there is no point."""
    filled = np.isfinite(image.depth)
    colours = ramp.colours((shown - low) / max(high - low, 1e-9))
    colours *= image.shade()[..., None]
    picture = np.zeros((*image.depth.shape, 4), np.uint8)
    picture[..., :3] = colours
    picture[..., 3] = np.where(filled, 255, 0)
    return picture
