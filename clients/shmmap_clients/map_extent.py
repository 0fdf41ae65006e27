# SPDX-License-Identifier: Apache-2.0
"""Where the map is, for messages about places that it does not have."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from shmmap import Client, ShmmapError

__all__ = ["NoMapHere", "extent_text", "map_extent"]


class NoMapHere(ShmmapError):
    """The map has nothing around the place that was asked for."""

    code = "no_map_here"
    exit_code = 1


def extent_text(bounds: Sequence[float] | None, position: Iterable[float] = ()) -> str:
    """Return where a map is, and where a pose is: ``"the map spans x -60 .. 60 m, y -60 .. 60 m"``.

    Parameters
    ----------
    bounds
        min_x, min_y, max_x, max_y, metres, map frame; None for a map of nothing.
    position
        Of the pose, metres, map frame: x, y and perhaps z; by default it is left out.
    """
    pose = ", ".join(f"{value:.3f}" for value in position)
    where = f", the pose is at ({pose})" if pose else ""
    if bounds is None:
        return f"the map is empty{where}"
    min_x, min_y, max_x, max_y = (f"{round(float(value), 3) + 0.0:.12g}" for value in bounds)
    return f"the map spans x {min_x} .. {max_x} m, y {min_y} .. {max_y} m{where}"


def map_extent(client: Client, position: Iterable[float] = ()) -> str:
    """Return where the daemon's map is, as `extent_text`."""
    return extent_text(client.welcome.bounds, position)
