# SPDX-License-Identifier: Apache-2.0
"""The chunks of a live map from above, for ``shmmap map --live``."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Final

from shmmap.cli.screens.output import counted, format_bytes, format_metres
from shmmap.cli.screens.picture import CellSquare

if TYPE_CHECKING:
    from shmmap.client.live.chunk_reader import ChunkInfo

__all__ = ["LIVE_STATES", "chunk_squares"]

LIVE_STATES: Final = {
    "saved": "on disk",
    "clean": "in memory, saved",
    "loading": "loading",
    "saving": "saving",
    "dirty": "not saved yet",
}
"""States of chunks and what they are called; of chunks above one another that of the last here is drawn."""
_ORDER: Final = list(LIVE_STATES)


def chunk_squares(chunks: Iterable[ChunkInfo], resolution: float) -> list[CellSquare]:
    """Return a square for each column of chunks, with a line of its tooltip for each chunk.

    Parameters
    ----------
    resolution
        Edge of a voxel, metres.
    """
    columns: dict[tuple[int, int], list[ChunkInfo]] = {}
    for chunk in chunks:
        columns.setdefault((chunk.key.x, chunk.key.y), []).append(chunk)
    return [_square(column, resolution) for _, column in sorted(columns.items())]


def _square(column: list[ChunkInfo], resolution: float) -> CellSquare:
    min_x, min_y, _, max_x, max_y, _ = column[0].key.box(resolution)
    lines = []
    for chunk in sorted(column, key=lambda chunk: chunk.key.z):
        known = f", {counted(chunk.active, 'known voxel')}" if chunk.state != "saved" else ""
        low, high = (format_metres(chunk.key.box(resolution)[axis]) for axis in (2, 5))
        what = LIVE_STATES.get(chunk.state, chunk.state)
        lines.append(f"{chunk.key.text}, z {low} to {high} m: {what}, {format_bytes(chunk.bytes)}{known}")
    state = max((chunk.state for chunk in column), key=lambda one: _ORDER.index(one) if one in _ORDER else -1)
    return CellSquare((min_x, min_y, max_x, max_y), state, "\n".join(lines))
