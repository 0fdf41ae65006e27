# SPDX-License-Identifier: Apache-2.0
"""Send a window's differential requests, and compute the window's state from each answer."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Final, TypeAlias

import msgspec
import numpy as np

import shmmap.geometry as geometry
from shmmap.client.arguments import names
from shmmap.client.cell import Cell
from shmmap.client.cell_set import CellSet, HeldCells
from shmmap.client.session import Steps
from shmmap.client.session_state import SessionState
from shmmap.client.window.retention import Retention, RetentionCandidate, RetentionPolicy
from shmmap.client.window.state import LayerKey, WindowState
from shmmap.errors import BadRequest, OverBudget
from shmmap.geometry import checked_heights, distance_to_boxes
from shmmap.protocol.messages import MAX_NAMED, Intent

_Shape: TypeAlias = type[geometry.Circle] | type[geometry.AutowareSquare]

_SHAPES: Final[dict[str, _Shape]] = {"circle": geometry.Circle, "square": geometry.AutowareSquare}


class WindowRefresher:
    """Turns the daemon's answers into states; used by one thread at a time.

    Parameters
    ----------
    client
        Client that sends the requests.
    radius
        Radius of the window, metres.
    layers
        Layers to attach of each cell.
    shape
        ``"circle"`` or ``"square"`` (Autoware's).
    z
        (lowest, highest) heights of interest, metres, or None.
    retention
        Policy for keeping cells that leave the window; None: keep none.
    populate
        Map every page while attaching, not at first access.
    timeout_s
        Seconds that a reply may take beyond the request's wait; None: the client's timeout.

    Attributes
    ----------
    layers : tuple of str
        The layers, as they were requested.
    retained : dict
        Cells outside the window that are kept attached, with the time since when.

    Raises
    ------
    BadRequest
        The shape is unknown, or another of these is invalid.
    """

    def __init__(
        self,
        client: SessionState,
        radius: float,
        *,
        layers: str | Sequence[str],
        shape: str,
        z: tuple[float, float] | None,
        retention: RetentionPolicy | None,
        populate: bool,
        timeout_s: float | None = None,
    ) -> None:
        if not isinstance(shape, str) or shape not in _SHAPES:
            raise BadRequest(f"window shape {shape!r} is unknown", hint="use 'circle' or 'square'")
        self._make_area = _SHAPES[shape]
        self._client = client
        self._radius = radius
        self.layers = names("layers", layers)
        self._z = checked_heights(z)
        self._make_area(0.0, 0.0, radius, self._z)
        self._retention = retention if retention is not None else Retention()
        self._populate = populate
        self._timeout_s = timeout_s
        self.retained: dict[LayerKey, tuple[Cell, float]] = {}

    @property
    def lost(self) -> bool:
        """Whether the connection to the daemon is broken at present."""
        return self._client.disconnected_since is not None

    def refresh(self, state: WindowState, pose: Intent, wait_s: float | None) -> tuple[WindowState, bool]:
        """Send one request to the daemon, as `steps`."""
        return self._client.session.run(self.steps(state, pose, wait_s))

    def steps(
        self, state: WindowState, pose: Intent, wait_s: float | None
    ) -> Steps[tuple[WindowState, bool]]:
        """Send one request to the daemon.

        Returns
        -------
        state : WindowState
            The new state; it shares the old state's unchanged mappings.
        progress : bool
            Whether cells were added or removed.

        Raises
        ------
        ShmmapError
            As `Client.differential`; the old state stays valid.
        """
        area = self._make_area(pose.x, pose.y, self._radius, self._z)
        answer = yield from self._ask(state, area, pose, wait_s, by_name=False)
        if answer.epoch != state.epoch and state.cells:
            # A new run of the daemon cannot know which cells the versions of a previous run belonged to, and
            # does not recognise versions that are not current.  Attached cells stay attached during the new
            # request.
            first = answer
            answer = yield from self._ask(state, area, pose, wait_s, by_name=True)
            del first
        now_s = time.monotonic()
        if answer.map_version != state.map_version or any(isinstance(f, OverBudget) for f in answer.failed):
            # cells retained outside the window may be outdated, or use memory that cells in the window need
            self.retained.clear()
        after = msgspec.structs.replace(
            state,
            pending=answer.pending,
            failed=answer.failed,
            asked=pose,
            area=area,
            epoch=answer.epoch,
            map_version=answer.map_version,
            covered=answer.covered,
        )
        progress = bool(answer.cells or answer.removed)
        if progress:
            after = after.with_cells(self._cells_after(state, answer, now_s))
        self._retain(pose, now_s)
        return after, progress

    def _ask(
        self, state: WindowState, area: geometry.Area, pose: Intent, wait_s: float | None, *, by_name: bool
    ) -> Steps[CellSet]:
        held = HeldCells(state.cells.values(), by_name=by_name and len(state.cells) <= MAX_NAMED)
        return self._client.session.differential(
            area, held, self.layers, wait_s, pose, populate=self._populate, timeout_s=self._timeout_s
        )

    def _cells_after(self, state: WindowState, answer: CellSet, now_s: float) -> dict[LayerKey, Cell]:
        """Return the cells that an answer leaves in the window; retain those that it removes."""
        removed = set(answer.removed)
        cells = {key: cell for key, cell in state.cells.items() if key[0] not in removed}
        if removed:
            left = {key: (cell, now_s) for key, cell in state.cells.items() if key[0] in removed}
            self.retained.update(left)
        for cell in answer.cells:
            key = (cell.id, cell.layer)
            cells[key] = cell
            self.retained.pop(key, None)
        return cells

    def _retain(self, pose: Intent, now_s: float) -> None:
        if not self.retained:
            return
        boxes = np.array([cell.box for cell, _ in self.retained.values()])
        distances = distance_to_boxes(pose.x, pose.y, boxes).tolist()
        departed = [
            RetentionCandidate(distance, cell.nbytes, now_s - since_s)
            for distance, (cell, since_s) in zip(distances, self.retained.values(), strict=True)
        ]
        keep = self._retention.keep(departed)
        self.retained = {
            key: value for (key, value), kept in zip(self.retained.items(), keep, strict=True) if kept
        }

    def forget(self) -> None:
        """Drop the retained cells."""
        self.retained.clear()
