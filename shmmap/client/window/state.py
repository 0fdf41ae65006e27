# SPDX-License-Identifier: Apache-2.0
"""State of a window at one moment, and the difference between two states."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Final, TypeAlias

import msgspec
import numpy as np

import shmmap.geometry as geometry
from shmmap.client.cell import Cell
from shmmap.client.cell_set import PendingLayer
from shmmap.errors import CellError, Offline, OverBudget
from shmmap.protocol.messages import Intent

if TYPE_CHECKING:
    from numpy.typing import NDArray

PASSING: Final = (OverBudget, Offline)
"""Temporary failures, after which the request is repeated."""

LayerKey: TypeAlias = tuple[str, str]
"""Cell id and layer."""
Box: TypeAlias = tuple[float, float, float, float]


class WindowUpdate(msgspec.Struct, frozen=True, eq=False, weakref=True):
    """Changes of a window since the last `MapWindow.move_to`.

    Attributes
    ----------
    added, kept, changed : tuple of Cell
        New cells; cells that stayed; the new versions of cells whose version or bytes changed.
    removed : tuple of str
        Ids that left the window in any layer.
    pending : tuple of PendingLayer
        Cells still being loaded.
    failed : tuple of CellError
        Cells that cannot be loaded at present.
    current : bool
        Whether the window answers the pose just given.  In the background mode it may still answer an
        earlier one.
    covered : bool
        Whether the daemon knows all cells of the map in the window; if not, more may follow.
    """

    added: tuple[Cell, ...] = ()
    kept: tuple[Cell, ...] = ()
    changed: tuple[Cell, ...] = ()
    removed: tuple[str, ...] = ()
    pending: tuple[PendingLayer, ...] = ()
    failed: tuple[CellError, ...] = ()
    current: bool = False
    covered: bool = True

    def __repr__(self) -> str:
        counts = ((name, len(getattr(self, name))) for name in self.__struct_fields__[:6])
        state = "" if self.current else ", of an earlier pose"
        return f"<WindowUpdate: {', '.join(f'{count} {name}' for name, count in counts)}{state}>"

    @property
    def any(self) -> bool:
        """Whether the set of cells changed."""
        return bool(self.added or self.changed or self.removed)

    @property
    def complete(self) -> bool:
        """Whether the window answers the pose just given, and nothing in it is missing."""
        return self.current and self.covered and not self.pending and not self.failed


class WindowState(msgspec.Struct, frozen=True, eq=False, weakref=True):
    """The cells of a window after one answer of the daemon; never changed, only replaced.

    Attributes
    ----------
    cells
        By cell id and layer, in id order.
    versions
        Versions of the same cells; unlike ``cells``, keeping them keeps nothing mapped.
    boxes
        For each layer, the boxes of its cells in the order of ``by_layer``, (N, 4) float64.
    asked
        The pose of the last request; None before the first answer.
    area
        The requested area: if ``covered``, every cell of the map in it is in ``cells``, ``pending`` or
        ``failed``.
    """

    cells: Mapping[LayerKey, Cell] = {}
    versions: Mapping[LayerKey, int] = {}
    by_layer: Mapping[str, tuple[Cell, ...]] = {}
    boxes: Mapping[str, NDArray[np.float64]] = {}
    pending: tuple[PendingLayer, ...] = ()
    failed: tuple[CellError, ...] = ()
    asked: Intent | None = None
    area: geometry.Area | None = None
    epoch: int = 0
    map_version: int = 0
    covered: bool = True

    @property
    def settled(self) -> bool:
        """Whether an immediate repetition of the request would return nothing new."""
        return (
            self.asked is not None
            and self.covered
            and not self.pending
            and not any(isinstance(failure, PASSING) for failure in self.failed)
        )

    def covers(self, x: float, y: float, radius: float, layer: str | None = None) -> bool:
        """Return whether ``cells`` has all cells of the map within a circle, in one layer or in all.

        A cell counts as missing if it is being loaded or has failed, and no older version is attached.  A
        cell whose position is not known counts as lying in the circle.
        """
        if self.area is None or not self.covered or not self.area.contains_circle(x, y, radius):
            return False
        missing: list[tuple[LayerKey, Box | None]] = [((cell.id, cell.layer), None) for cell in self.pending]
        missing += [((failure.cell_id, failure.layer), failure.box) for failure in self.failed]
        return not any(
            key not in self.cells and layer in (None, key[1]) and _may_touch(box, x, y, radius)
            for key, box in missing
        )

    def with_cells(self, cells: Mapping[LayerKey, Cell]) -> WindowState:
        """Return this state with other cells, sorted, and their boxes in arrays for `points_around`."""
        ordered = {key: cells[key] for key in sorted(cells)}
        by_layer: dict[str, list[Cell]] = {}
        for (_, layer), cell in ordered.items():
            by_layer.setdefault(layer, []).append(cell)
        return msgspec.structs.replace(
            self,
            cells=ordered,
            versions={key: cell.version for key, cell in ordered.items()},
            by_layer={layer: tuple(some) for layer, some in by_layer.items()},
            boxes={layer: np.array([cell.box for cell in some]) for layer, some in by_layer.items()},
        )


def _may_touch(box: Box | None, x: float, y: float, radius: float) -> bool:
    if box is None:
        return True
    return math.hypot(max(box[0] - x, x - box[2], 0.0), max(box[1] - y, y - box[3], 0.0)) <= radius


EMPTY: Final = WindowState(covered=False)  # the cells of the area are not known yet


def moved(state: WindowState, pose: Intent, update_distance: float) -> bool:
    """Return whether ``pose`` is so far from the last request's pose that a new request is due.

    That is ``update_distance`` metres or more, or outside the area of the answer.
    """
    if state.asked is None or state.area is None:
        return True
    distance = math.hypot(pose.x - state.asked.x, pose.y - state.asked.y)
    return distance > 0 and (
        distance >= update_distance or not state.area.contains_circle(pose.x, pose.y, 0.0)
    )


def update_between(before: Mapping[LayerKey, int], state: WindowState, *, current: bool) -> WindowUpdate:
    """Compare a state with the versions of an earlier one."""
    if before is state.versions:
        kept_all = tuple(state.cells.values())
        return WindowUpdate(
            kept=kept_all,
            pending=state.pending,
            failed=state.failed,
            current=current,
            covered=state.covered,
        )
    added: list[Cell] = []
    kept: list[Cell] = []
    changed: list[Cell] = []
    for key, cell in state.cells.items():
        version = before.get(key)
        (added if version is None else kept if version == cell.version else changed).append(cell)
    return WindowUpdate(
        tuple(added),
        tuple(kept),
        tuple(changed),
        tuple(dict.fromkeys(cell_id for cell_id, layer in before if (cell_id, layer) not in state.cells)),
        state.pending,
        state.failed,
        current,
        state.covered,
    )
