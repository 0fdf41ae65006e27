# SPDX-License-Identifier: Apache-2.0
"""Elevation maps as files: NPZ, GeoTIFF, PNG with a world file; written block by block."""

from __future__ import annotations

import contextlib
import importlib.util
import json
import math
import secrets
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap import BadRequest
from shmmap.formats.npz_writer import npz_archive
from shmmap.formats.png import PngWriter
from shmmap_clients.elevation_map.grid import ElevationGrid

_GEOTIFF: Final = (".tif", ".tiff")
_SUFFIXES: Final = (".npz", ".png", *_GEOTIFF)
_USER_DEFINED: Final = 32767  # GeoTIFF 1.1: the highest code, a user-defined system
_TILE: Final = 256
_FINEST_STEP: Final = 0.001  # metres: the finest step of a PNG
_AZIMUTH: Final = math.radians(315.0)
_ALTITUDE: Final = math.radians(45.0)
_EXAGGERATION: Final = 2.0


def check_output(path: Path, epsg: int | None = None) -> None:
    """Check before the work begins that a file can be written in the format of its suffix.

    Raises
    ------
    BadRequest
        The suffix is unknown; or for a GeoTIFF, its package is not installed, or the coordinate system does
        not exist.
    """
    suffix = path.suffix.lower()
    if suffix not in _SUFFIXES:
        raise BadRequest(f"{path}: elevation is written as {', '.join(_SUFFIXES)}")
    if suffix in _GEOTIFF:
        if importlib.util.find_spec("tifffile") is None:
            raise BadRequest("GeoTIFF needs the package tifffile", hint="pip install tifffile, or write .npz")
        if epsg is not None and not 1024 <= epsg <= _USER_DEFINED:
            raise BadRequest(f"EPSG codes of GeoTIFF are 1024 to {_USER_DEFINED}, not {epsg}")


def write_elevation(
    path: Path, grid: ElevationGrid, fill_radius: float, document: dict[str, Any], *, epsg: int | None = None
) -> None:
    """Write a grid to a file that appears only when complete.

    ``.npz``: ``height`` (rows, columns) float32 metres, row 0 the southernmost, NaN for no height;
    ``kind`` uint8 (0 nothing, 1 measured, 2 filled); ``resolution`` and ``origin`` (south-west corner
    of [0, 0], metres); ``document``, JSON.  ``.tif``: float32, NaN as no data, tiled.  ``.png``: 16
    bits, 0 for no height, else ``z = z_min + (value - 1) * step`` with both in ``PATH.json``,
    and a world file.  This format alone is lossy, with a step of at least a millimetre.

    Parameters
    ----------
    fill_radius
        See `fill_holes`, metres.
    document
        Description of the contents, for users and programs.
    epsg
        Coordinate system for a GeoTIFF.

    Raises
    ------
    BadRequest
        As `check_output`.
    """
    check_output(path, epsg)
    suffix = path.suffix.lower()
    if suffix == ".npz":
        with _replacing(path) as file:
            _npz(file, grid, fill_radius, document)
    elif suffix in _GEOTIFF:
        _geotiff(path, grid, fill_radius, document, epsg)
    else:
        _png(path, grid, fill_radius, document)


def write_hillshade(path: Path, grid: ElevationGrid, fill_radius: float) -> None:
    """Write a shaded picture as PNG, north up, and its world file."""
    with _replacing(path) as file:
        writer = PngWriter(file, grid.shape[1], grid.shape[0], channels=2)
        for _, heights, _ in grid.blocks(fill_radius, from_north=True, margin=1):
            writer.add(hillshade(heights[::-1], grid.resolution)[::-1])
        writer.finish()
    _world_file(path, grid)


@contextlib.contextmanager
def _interim(path: Path) -> Iterator[Path]:
    """Yield a temporary name to write to; at the end, rename that file to ``path``."""
    interim = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
    try:
        yield interim
        interim.replace(path)
    finally:
        interim.unlink(missing_ok=True)


@contextlib.contextmanager
def _replacing(path: Path) -> Iterator[IO[bytes]]:
    with _interim(path) as interim, open(interim, "xb") as file:
        yield file


def _npz(file: IO[bytes], grid: ElevationGrid, fill_radius: float, document: dict[str, Any]) -> None:
    small = {
        "resolution": np.array(grid.resolution),
        "origin": np.array(grid.origin),
        "document": np.array(json.dumps(document)),
    }
    with npz_archive(file, zipfile.ZIP_DEFLATED) as archive:
        for name, array in small.items():
            with archive.open(f"{name}.npy", "w") as member:
                np.lib.format.write_array(member, array, allow_pickle=False)
        for name, dtype, place in (("height", "<f4", 1), ("kind", "|u1", 2)):
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                header = {"descr": dtype, "fortran_order": False, "shape": grid.shape}
                np.lib.format.write_array_header_1_0(member, header)
                for block in grid.blocks(fill_radius):
                    member.write(np.ascontiguousarray(block[place]).tobytes())


def _geotiff(
    path: Path, grid: ElevationGrid, fill_radius: float, document: dict[str, Any], epsg: int | None
) -> None:
    import tifffile

    west, south = grid.origin
    north = south + grid.shape[0] * grid.resolution
    # GeoTIFF 1.1 (OGC 19-008r4): projected, pixels are areas
    keys = [1, 1, 0, 3, 1024, 0, 1, 1, 1025, 0, 1, 1, 3072, 0, 1, epsg or _USER_DEFINED]
    tags = [
        (33550, "d", 3, (grid.resolution, grid.resolution, 0.0), True),
        (33922, "d", 6, (0.0, 0.0, 0.0, west, north, 0.0), True),
        (34735, "H", len(keys), tuple(keys), True),
        (42113, "s", 4, "nan", True),
    ]
    with _interim(path) as interim:
        tifffile.imwrite(
            interim,
            _tiles(grid, fill_radius),
            shape=grid.shape,
            dtype=np.float32,
            tile=(_TILE, _TILE),
            photometric="minisblack",
            compression="zlib",
            metadata=None,
            description=json.dumps(document),
            extratags=tags,
            bigtiff=math.prod(grid.shape) > 1 << 29,
            maxworkers=1,  # several workers would queue a quarter of a gigabyte of tiles
        )


def _tiles(grid: ElevationGrid, fill_radius: float) -> Iterator[NDArray[np.float32]]:
    """Yield tiles from the north-west, row by row; tiles at the edges also have the full size."""
    rows, columns = grid.shape
    for top in range(0, rows, _TILE):
        for left in range(0, columns, _TILE):
            tile, _ = grid.filled(rows - top - _TILE, rows - top, fill_radius, left=left, right=left + _TILE)
            yield np.ascontiguousarray(tile[::-1])


def _png(path: Path, grid: ElevationGrid, fill_radius: float, document: dict[str, Any]) -> None:
    low, high = math.inf, -math.inf
    for _, heights, kind in grid.blocks(fill_radius):
        if kind.any():
            low, high = min(low, float(np.nanmin(heights))), max(high, float(np.nanmax(heights)))
    z_min = low if low <= high else 0.0
    step = max(_FINEST_STEP, (high - low) / 65534) if low <= high else _FINEST_STEP
    with _replacing(path) as file:
        writer = PngWriter(file, grid.shape[1], grid.shape[0], bits=16)
        for _, heights, kind in grid.blocks(fill_radius, from_north=True):
            levels = np.where(kind > 0, np.rint((heights.astype(np.float64) - z_min) / step) + 1, 0)
            writer.add(levels.astype(np.uint16))
        writer.finish()
    _world_file(path, grid)
    with _replacing(path.with_name(path.name + ".json")) as file:
        file.write(json.dumps({**document, "z_min": z_min, "step": step}).encode())


def _world_file(path: Path, grid: ElevationGrid) -> None:
    """Write the six lines of a world file: pixel sizes and centre of the upper left pixel."""
    west, south = grid.origin
    north = south + grid.shape[0] * grid.resolution
    half = grid.resolution / 2
    numbers = (grid.resolution, 0.0, 0.0, -grid.resolution, west + half, north - half)
    with _replacing(path.with_suffix(".pgw")) as file:
        file.write("".join(f"{number:.12g}\n" for number in numbers).encode())


def hillshade(heights: NDArray[np.float32], resolution: float) -> NDArray[np.uint8]:
    """Return shaded rows, without the first and the last, which only serve as neighbours.

    Slopes are by Horn (1981), where a missing neighbour counts as level.

    Parameters
    ----------
    heights
        (n + 2, columns) float32, metres, row 0 the southernmost; NaN for no height.
    resolution
        Edge of a column, metres.

    Returns
    -------
    (n, columns, 2) uint8: grey, and alpha: 255 for a height, 0 for none.
    """
    middle = heights[1:-1].astype(np.float64)
    known = ~np.isnan(middle)
    wide = np.pad(heights, ((0, 0), (1, 1)), constant_values=np.nan).astype(np.float64)
    rows, columns = middle.shape

    def at(dy: int, dx: int) -> NDArray[np.float64]:
        near = wide[1 + dy : 1 + dy + rows, 1 + dx : 1 + dx + columns]
        return np.where(np.isnan(near), middle, near)

    span = 8 * resolution / _EXAGGERATION
    east = (at(-1, 1) + 2 * at(0, 1) + at(1, 1) - at(-1, -1) - 2 * at(0, -1) - at(1, -1)) / span
    north = (at(1, -1) + 2 * at(1, 0) + at(1, 1) - at(-1, -1) - 2 * at(-1, 0) - at(-1, 1)) / span
    light = np.array(
        [
            math.cos(_ALTITUDE) * math.sin(_AZIMUTH),
            math.cos(_ALTITUDE) * math.cos(_AZIMUTH),
            math.sin(_ALTITUDE),
        ]
    )
    shade = (light[2] - east * light[0] - north * light[1]) / np.sqrt(1 + east * east + north * north)
    grey = np.where(known, np.clip(shade, 0.0, 1.0) * 254 + 1, 0)
    return np.stack([grey.astype(np.uint8), np.where(known, 255, 0).astype(np.uint8)], axis=2)
