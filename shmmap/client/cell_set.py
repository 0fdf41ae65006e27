# SPDX-License-Identifier: Apache-2.0
"""What a client holds, as a request for cells says it, and what the request brings back."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias, overload

import numpy as np

from shmmap.client.cell import Cell
from shmmap.errors import BadRequest, CellError
from shmmap.protocol.messages import FailedCell, HeldCell

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["CellSet", "Held", "HeldCells", "PendingLayer", "cell_error", "gather"]

Held: TypeAlias = Cell | str | tuple[str, int | None] | tuple[str, int | None, tuple[str, ...]]
"""An attached cell, or an id (which means its current version), id and version, or these and layers."""


class PendingLayer(NamedTuple):
    """One layer of one cell that is still being loaded."""

    id: str
    layer: str


class CellSet(Sequence[Cell]):
    """The cells that answer a request, in reply order, and what is missing among them.

    It is a sequence of its cells.

    Attributes
    ----------
    cells : tuple of Cell
        Attached cells; of a differential request only the new and changed ones.
    failed : tuple of CellError
        Cells that cannot be loaded; the others are good all the same.
    pending : tuple of PendingLayer
        Cells still being loaded when the wait was over: ask again.
    removed : tuple of str
        Held ids that left the area or the map, in the order they were given.
    epoch : int
        Which run of the daemon answered.
    map_version : int
        Which state of the map.
    layers : tuple of str
        The layers asked for, one for each, by the names that cells have them by.
    covered : bool
        Whether the daemon knows all that the map has of what was asked for.  Where it does not (a map that
        comes in pages), more cells may be there, none of them is in `removed`, and one that is unknown may
        exist: ask again.
    reason : str
        Why what is missing is not being loaded: ``"offline"``, where the list of cells cannot be reached at
        present; empty where it is being fetched, where all is covered, and from a daemon older than protocol
        1.6.
    """

    __slots__ = (
        "cells",
        "covered",
        "epoch",
        "failed",
        "layers",
        "map_version",
        "pending",
        "reason",
        "removed",
    )

    def __init__(
        self,
        cells: tuple[Cell, ...] = (),
        failed: tuple[CellError, ...] = (),
        pending: tuple[PendingLayer, ...] = (),
        removed: tuple[str, ...] = (),
        epoch: int = 0,
        map_version: int = 0,
        layers: tuple[str, ...] = (),
        covered: bool = True,
        reason: str = "",
    ) -> None:
        self.cells = cells
        self.failed = failed
        self.pending = pending
        self.removed = removed
        self.epoch = epoch
        self.map_version = map_version
        self.layers = layers
        self.covered = covered
        self.reason = reason

    def __repr__(self) -> str:
        return (
            f"<CellSet of {len(self.cells)} cells, {len(self.removed)} removed,"
            f" {len(self.pending)} pending, {len(self.failed)} failed"
            f"{'' if self.covered else ', not covered'}{self.reason and f' ({self.reason})'}>"
        )

    @property
    def complete(self) -> bool:
        """Whether nothing that was asked for is missing."""
        return self.covered and not self.failed and not self.pending

    def raise_for_failures(self) -> CellSet:
        """Return the set itself, or raise the first of `failed`."""
        if self.failed:
            raise self.failed[0]
        return self

    @overload
    def gather(self, column: str = "xyz", /) -> NDArray[Any]: ...

    @overload
    def gather(self, column: str, other: str, /, *others: str) -> dict[str, NDArray[Any]]: ...

    def gather(self, column: str = "xyz", /, *others: str) -> NDArray[Any] | dict[str, NDArray[Any]]:
        """Copy columns of all points of the cells, cell after cell; as `PointsAround.gather`.

        ::

            points = cells.gather()  # (N, 3)
            columns = cells.gather("xyz", "intensity")  # {"xyz": (N, 3), "intensity": (N,)}

        Cells that failed or are pending have no points here: see `complete`.

        Raises
        ------
        NoColumn
            A cell has no such column.
        BadRequest
            Coordinates of cells with different origins cannot be put into one array, or the set has several
            layers of a cell.
        """
        if len({cell.layer for cell in self.cells}) > 1:
            raise BadRequest(
                "the cells are of several layers, and do not fit into one array",
                hint="take those of one, [cell for cell in cells if cell.layer == ...]",
            )
        gathered = gather(self.cells, (column, *others), [None] * len(self.cells))
        return gathered if others else gathered[column]

    def __len__(self) -> int:
        return len(self.cells)

    def __iter__(self) -> Iterator[Cell]:
        return iter(self.cells)

    @overload
    def __getitem__(self, index: int) -> Cell: ...

    @overload
    def __getitem__(self, index: slice) -> tuple[Cell, ...]: ...

    def __getitem__(self, index: int | slice) -> Cell | tuple[Cell, ...]:
        return self.cells[index]


def gather(
    cells: Sequence[Cell], columns: Sequence[str], masks: Iterable[NDArray[np.bool_] | None]
) -> dict[str, NDArray[Any]]:
    """Copy columns of cells into one array each, cell after cell; a mask says which rows, None all.

    Raises
    ------
    NoColumn
        A cell has no such column.
    BadRequest
        Coordinates of cells with different origins cannot be put into one array.
    """
    if "xyz" in columns and len({cell.origin for cell in cells}) > 1:
        raise BadRequest(
            "the cells' coordinates have different origins, and do not fit into one array",
            hint="use the columns and the origin of each of its cells",
        )
    parts: dict[str, list[NDArray[Any]]] = {name: [] for name in columns}
    for cell, mask in zip(cells, masks, strict=True):
        for name, found in parts.items():
            found.append(cell[name] if mask is None else cell[name][mask])
    return {
        name: np.concatenate(found) if found else np.empty((0, 3) if name == "xyz" else (0,), np.float32)
        for name, found in parts.items()
    }


def _kinds(root: type[CellError]) -> dict[str, type[CellError]]:
    return {root.code: root, **{kind.code: kind for kind in root.__subclasses__()}}


_KINDS = _kinds(CellError)


def cell_error(failure: FailedCell, cell_id: str) -> CellError:
    """Return the error that a reply describes for one cell."""
    kind = _KINDS.get(failure.code, CellError)
    return kind(
        f"{cell_id} ({failure.layer}): {failure.message}",
        cell_id=cell_id,
        layer=failure.layer,
        holders=failure.holders,
        box=failure.box,
    )


class HeldCells:
    """Held cells in wire form.

    An attached cell is sent as its version, 8 bytes (``packed``).  Other cells are sent by name.  All of
    them are (``by_name``) if the daemon may have forgotten which cell a version belongs to.

    Attributes
    ----------
    packed : bytes
        Versions, 8 bytes little-endian each.
    named : tuple of HeldCell
        The rest.
    """

    def __init__(self, held: Iterable[Held], *, by_name: bool = False) -> None:
        self._packed: dict[str, list[int]] = {}
        self._order: dict[str, None] = {}
        named: list[HeldCell] = []
        for one in held:
            if isinstance(one, Cell):
                self._order[one.id] = None
                if by_name:
                    named.append(HeldCell(one.id, one.version, (one.layer,)))
                else:
                    self._packed.setdefault(one.id, []).append(one.version)
                continue
            if isinstance(one, str):
                said = HeldCell(one)
            elif isinstance(one, tuple) and 2 <= len(one) <= 3:
                said = HeldCell(*one)
            else:
                raise BadRequest(f"held must be cells, ids, or ids with versions, and {one!r} is none")
            self._order[said.id] = None
            named.append(said)
        versions = [version for some in self._packed.values() for version in some]
        self.packed = np.array(versions, "<u8").tobytes() if versions else b""
        self.named = tuple(named)

    def removed(self, ids: Sequence[str], packed: bytes) -> tuple[str, ...]:
        """Ids to drop, in the order they were given, from a reply's two lists.

        Of a cell that is held in several layers, all have to go: where the daemon does not know one
        version any more, that layer comes again, and the others stay.
        """
        if not packed:
            return tuple(ids)
        gone = set(np.frombuffer(packed, "<u8").tolist())
        gone_ids = set(ids)
        gone_ids.update(cell_id for cell_id, versions in self._packed.items() if gone.issuperset(versions))
        return tuple(cell_id for cell_id in self._order if cell_id in gone_ids)
