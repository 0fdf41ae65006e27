# SPDX-License-Identifier: Apache-2.0
"""Extent of the map, for messages about positions outside it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from shmmap import Client, ShmmapError


class NoMapHere(ShmmapError):
    """The map has no cells around the requested position."""

    code = "no_map_here"
    exit_code = 1


def extent_text(bounds: Sequence[float] | None, position: Iterable[float] = ()) -> str:
    """Return the extent of a map, and a position, as text: ``"the map spans x -60 .. 60 m, y -60 .. 60 m"``.

    Parameters
    ----------
    bounds
        min_x, min_y, max_x, max_y, metres, map frame; None for an empty map.
    position
        Position of a pose, metres, map frame: x, y and optionally z; by default none.
    """
    pose = ", ".join(f"{value:.3f}" for value in position)
    where = f", the pose is at ({pose})" if pose else ""
    if bounds is None:
        return f"the map is empty{where}"
    min_x, min_y, max_x, max_y = (f"{round(float(value), 3) + 0.0:.12g}" for value in bounds)
    return f"the map spans x {min_x} .. {max_x} m, y {min_y} .. {max_y} m{where}"


def map_extent(client: Client, position: Iterable[float] = ()) -> str:
    """Return the extent of the daemon's map, as `extent_text`."""
    return extent_text(client.welcome.bounds, position)
