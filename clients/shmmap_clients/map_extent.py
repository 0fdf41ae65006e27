# SPDX-License-Identifier: Apache-2.0
"""Where the map is, for whoever looks for it elsewhere."""

from __future__ import annotations

from collections.abc import Sequence

from shmmap import Client, ShmmapError

__all__ = ["NoMapHere", "extent_text", "map_extent"]


class NoMapHere(ShmmapError):
    """The map has nothing around the place that was asked for."""

    code = "no_map_here"
    exit_code = 1


def extent_text(bounds: Sequence[float] | None) -> str:
    """Return where a map is: ``"the map spans x -60 .. 60 m, y -60 .. 60 m"``.

    Parameters
    ----------
    bounds
        min_x, min_y, max_x, max_y, metres, map frame; None for a map of nothing.
    """
    if bounds is None:
        return "the map is empty"
    min_x, min_y, max_x, max_y = (f"{round(float(value), 3) + 0.0:.12g}" for value in bounds)
    return f"the map spans x {min_x} .. {max_x} m, y {min_y} .. {max_y} m"


def map_extent(client: Client) -> str:
    """Return where the daemon's map is, as `extent_text`."""
    return extent_text(client.welcome.bounds)
