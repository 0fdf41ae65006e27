# SPDX-License-Identifier: Apache-2.0
"""What a window holds at one moment, and what changed since another."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Final, TypeAlias

import msgspec
import numpy as np

from shmmap.client.cell import Cell
from shmmap.client.cell_set import PendingLayer
from shmmap.errors import CellError, OverBudget
from shmmap.protocol.messages import Intent

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["EMPTY", "LayerKey", "WindowState", "WindowUpdate", "update_between"]

LayerKey: TypeAlias = tuple[str, str]
"""Cell id and layer."""


class WindowUpdate(msgspec.Struct, frozen=True, eq=False, weakref=True):
    """What happened to a window since the last `MapWindow.move_to`.

    Attributes
    ----------
    added, kept, changed : tuple of Cell
        Cells new in the window; cells that stayed; cells whose version or bytes are others now (the
        new ones).
    removed : tuple of str
        Ids that left the window in any layer.
    pending : tuple of PendingLayer
        Cells still being loaded.
    failed : tuple of CellError
        Cells that cannot be had at present.
    """

    added: tuple[Cell, ...] = ()
    kept: tuple[Cell, ...] = ()
    changed: tuple[Cell, ...] = ()
    removed: tuple[str, ...] = ()
    pending: tuple[PendingLayer, ...] = ()
    failed: tuple[CellError, ...] = ()

    @property
    def any(self) -> bool:
        """Whether the set of cells is another one than before."""
        return bool(self.added or self.changed or self.removed)

    @property
    def complete(self) -> bool:
        """Whether nothing in the window is missing."""
        return not self.pending and not self.failed


class WindowState(msgspec.Struct, frozen=True, eq=False, weakref=True):
    """The cells of a window after one answer of the daemon; never changed, only replaced.

    Attributes
    ----------
    cells
        By cell id and layer, in id order.
    versions
        The same, versions alone: remembering them keeps nothing mapped.
    boxes
        By layer, boxes of its cells in the order of ``by_layer``, (N, 4) float64.
    asked
        The pose that was asked about; None before the first answer.
    """

    cells: Mapping[LayerKey, Cell] = {}
    versions: Mapping[LayerKey, int] = {}
    by_layer: Mapping[str, tuple[Cell, ...]] = {}
    boxes: Mapping[str, NDArray[np.float64]] = {}
    pending: tuple[PendingLayer, ...] = ()
    failed: tuple[CellError, ...] = ()
    asked: Intent | None = None
    epoch: int = 0
    map_version: int = 0

    @property
    def settled(self) -> bool:
        """Whether asking again at once cannot bring more."""
        return (
            self.asked is not None
            and not self.pending
            and not any(isinstance(failure, OverBudget) for failure in self.failed)
        )

    @classmethod
    def build(
        cls,
        cells: Mapping[LayerKey, Cell],
        *,
        pending: tuple[PendingLayer, ...],
        failed: tuple[CellError, ...],
        asked: Intent,
        epoch: int,
        map_version: int,
    ) -> WindowState:
        """Sort the cells and lay their boxes out for `points_around`."""
        ordered = {key: cells[key] for key in sorted(cells)}
        by_layer: dict[str, list[Cell]] = {}
        for (_, layer), cell in ordered.items():
            by_layer.setdefault(layer, []).append(cell)
        return cls(
            ordered,
            {key: cell.version for key, cell in ordered.items()},
            {layer: tuple(some) for layer, some in by_layer.items()},
            {layer: np.array([cell.box for cell in some]) for layer, some in by_layer.items()},
            pending,
            failed,
            asked,
            epoch,
            map_version,
        )


EMPTY: Final = WindowState()


def update_between(before: Mapping[LayerKey, int], state: WindowState) -> WindowUpdate:
    """Compare a state with the versions of an earlier one."""
    if before is state.versions:
        return WindowUpdate(kept=tuple(state.cells.values()), pending=state.pending, failed=state.failed)
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
    )
