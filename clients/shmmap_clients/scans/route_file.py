# SPDX-License-Identifier: Apache-2.0
"""The way that a vehicle will take, out of a file: poses in the TUM format, or a table with commas."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from shmmap import MapDataError, MapMissing
from shmmap_clients.scans.trajectory import read_trajectory

__all__ = ["read_route"]


def read_route(path: str | os.PathLike[str]) -> NDArray[np.float64]:
    """Read a route, (N, 2) float64, metres, map frame.

    Parameters
    ----------
    path
        A name that ends in ``.csv``: a place a line, ``x,y`` and perhaps more; or with a first line that
        names the columns, ``x`` and ``y`` among them.  Empty lines and what follows a ``#`` are skipped.
        Any other name: poses as `read_trajectory` reads them.

    Raises
    ------
    MapMissing
        There is no such file.
    MapDataError
        It cannot be read, a line has no two finite numbers (the message names the line), or there is none.
    """
    name = os.fspath(path)
    if not name.lower().endswith(".csv"):
        return read_trajectory(name).T_map_sensor[:, :2, 3]
    try:
        lines = Path(name).read_text(encoding="utf-8-sig").splitlines()
    except FileNotFoundError:
        raise MapMissing(f"there is no file {name}") from None
    except OSError as error:
        raise MapDataError(f"{name}: cannot be read: {error.strerror}", cause="route") from error
    except UnicodeDecodeError:
        raise MapDataError(f"{name}: not a text file", cause="route") from None
    places: list[tuple[float, float]] = []
    columns: tuple[int, int] | None = None
    for number, line in enumerate(lines, 1):
        words = [word.strip() for word in line.partition("#")[0].split(",")]
        if words == [""]:
            continue
        if columns is None:
            names = [word.strip('"').lower() for word in words]
            columns = (names.index("x"), names.index("y")) if {"x", "y"} <= {*names} else (0, 1)
            if "x" in names:
                continue
        try:
            place = float(words[columns[0]]), float(words[columns[1]])
        except (ValueError, IndexError):
            place = (np.nan, np.nan)
        if not np.isfinite(place).all():
            raise MapDataError(f"{name}, line {number}: not `x,y`", cause="route")
        places.append(place)
    if not places:
        raise MapDataError(f"{name}: no places", cause="route")
    return np.array(places)
