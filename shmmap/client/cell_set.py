# SPDX-License-Identifier: Apache-2.0
"""Encode the cells that a client holds for a request, and hold the cells that the reply contains."""

from __future__ import annotations

from collections.abc import Container, Iterable, Iterator, Sequence
from itertools import chain
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias, overload

import numpy as np

from shmmap.client.cell import Cell
from shmmap.errors import BadRequest, CellError, ShmmapError, UnknownCell
from shmmap.protocol.messages import FailedCell, HeldCell

if TYPE_CHECKING:
    from numpy.typing import NDArray

Held: TypeAlias = Cell | str | tuple[str, int | None] | tuple[str, int | None, tuple[str, ...]]
"""A held cell: an attached `Cell`, an id (its current version), (id, version), or (id, version, layers)."""


class PendingLayer(NamedTuple):
    """One layer of one cell that is still being loaded."""

    id: str
    layer: str


class CellSet(Sequence[Cell]):
    """The cells that answer a request, in reply order, and the cells that are missing.

    It is a sequence of its cells.

    Attributes
    ----------
    cells : tuple of Cell
        Attached cells; of a differential request only the new and changed ones.
    failed : tuple of CellError
        Cells that cannot be loaded; the other cells are not affected.
    pending : tuple of PendingLayer
        Cells still being loaded when the wait was over: ask again.
    removed : tuple of str
        Held ids that left the area or the map, in the order they were given.
    epoch : int
        Identifier of the daemon run that answered.
    map_version : int
        State of the map that the reply describes; of several replies to one request the first one's.
    layers : tuple of str
        The requested layers, in order, under the names that `Cell.layer` uses.
    covered : bool
        Whether the daemon knows every cell of the map that the request covers.  If it does not (the list of a
        remote map arrives in pages), more cells may exist, `removed` lists none of them, and an unknown id
        may still turn out to exist: ask again.
    reason : str
        Why missing cells are not being loaded: ``"offline"`` if the list of cells cannot be reached at
        present.  Empty if the list is being fetched, or if everything is covered.
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

    def _repr_html_(self) -> str | None:
        """Return a table and a picture for a notebook; None where they cannot be made."""
        try:
            from shmmap.client import notebook  # few programs are notebooks
        except ShmmapError:  # the package was replaced
            return None
        return notebook.cell_set_html(self)

    @property
    def complete(self) -> bool:
        """Whether no requested cell is missing."""
        return self.covered and not self.failed and not self.pending

    def raise_for_failures(self) -> CellSet:
        """Return this set, or raise the first error of `failed`."""
        if self.failed:
            raise self.failed[0]
        return self

    @overload
    def gather(self, column: str = "xyz", /) -> NDArray[Any]: ...

    @overload
    def gather(self, column: str, other: str, /, *others: str) -> dict[str, NDArray[Any]]: ...

    def gather(self, column: str = "xyz", /, *others: str) -> NDArray[Any] | dict[str, NDArray[Any]]:
        """Copy columns of all points into arrays, cell after cell; like `PointsAround.gather`.

        ::

            points = cells.gather()  # (N, 3)
            columns = cells.gather("xyz", "intensity")  # {"xyz": (N, 3), "intensity": (N,)}

        Cells that failed or are pending have no points here: see `complete`.

        Raises
        ------
        NoColumn
            A cell has no such column.
        BadRequest
            Coordinates of cells with different origins cannot be put into one array, the set has several
            layers of a cell, or the column is a table over a lattice.
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


def joined(parts: Sequence[CellSet]) -> CellSet:
    """Join the answers to the parts of one request; removals are those of the last part that has any.

    The map may change between two of them: the state named is the first, after which all that changed is new.
    """
    return CellSet(
        tuple(chain.from_iterable(part.cells for part in parts)),
        tuple(chain.from_iterable(part.failed for part in parts)),
        tuple(chain.from_iterable(part.pending for part in parts)),
        next((part.removed for part in reversed(parts) if part.removed), ()),
        parts[-1].epoch,
        parts[0].map_version,
        parts[-1].layers,
        all(part.covered for part in parts),
        next((part.reason for part in parts if part.reason), ""),
    )


def with_late(parts: Sequence[CellSet], again: CellSet, late: Container[tuple[str, str]]) -> CellSet:
    """Join the answers to the parts of a request by area, and what became of the cells that were pending.

    ``again`` is the answer for the ids of the ``late`` ones, which were pending in all parts but the last.
    Cells that have left the map since then are left out.
    """
    whole = joined(parts)
    order = {layer: place for place, layer in enumerate(whole.layers)}
    cells = {(cell.id, order[cell.layer]): cell for cell in whole.cells}
    cells.update({(cell.id, order[cell.layer]): cell for cell in again if (cell.id, cell.layer) in late})
    whole.cells = tuple(cells[key] for key in sorted(cells))
    whole.pending = (
        *(cell for cell in again.pending if (cell.id, cell.layer) in late),
        *parts[-1].pending,
    )
    whole.failed += tuple(
        error
        for error in again.failed
        if (error.cell_id, error.layer) in late and not isinstance(error, UnknownCell)
    )
    return whole


def gather(
    cells: Sequence[Cell], columns: Sequence[str], masks: Iterable[NDArray[np.bool_] | None]
) -> dict[str, NDArray[Any]]:
    """Copy each column of the cells into one array, cell after cell; a mask selects rows, None selects all.

    Raises
    ------
    NoColumn
        A cell has no such column.
    BadRequest
        Coordinates of cells with different origins cannot be put into one array, or the column is a table
        over a lattice.
    """
    if "xyz" in columns and len({cell.origin for cell in cells}) > 1:
        raise BadRequest(
            "the cells' coordinates have different origins, and do not fit into one array",
            hint="use the columns and the origin of each of its cells",
        )
    parts: dict[str, list[NDArray[Any]]] = {name: [] for name in columns}
    for cell, mask in zip(cells, masks, strict=True):
        for name, found in parts.items():
            column = cell[name]
            if len(column) != cell.points:
                raise BadRequest(
                    f"{name} of layer {cell.layer} is a table over a lattice, and has no row for each point",
                    hint="take it of each cell, with cell.lattice",
                )
            found.append(column if mask is None else column[mask])
    return {
        name: np.concatenate(found) if found else np.empty((0, 3) if name == "xyz" else (0,), np.float32)
        for name, found in parts.items()
    }


def _kinds(root: type[CellError]) -> dict[str, type[CellError]]:
    return {root.code: root, **{kind.code: kind for kind in root.__subclasses__()}}


_KINDS = _kinds(CellError)


def cell_error(failure: FailedCell, cell_id: str) -> CellError:
    """Return the exception for a cell that a reply reports as failed."""
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

    An attached cell is sent as its version, 8 bytes (``packed``).  Other cells are sent by name.  With
    ``by_name`` every cell is sent by name: the daemon may have forgotten which cell a version belongs to.

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
        """Return the ids to drop, in the order they were given, from a reply's two lists.

        A cell held in several layers is dropped only if all its layers are.  If the daemon no longer knows
        the version of one layer, it sends that layer again, and the other layers stay.
        """
        if not packed:
            return tuple(ids)
        gone = set(np.frombuffer(packed, "<u8").tolist())
        gone_ids = set(ids)
        gone_ids.update(cell_id for cell_id, versions in self._packed.items() if gone.issuperset(versions))
        return tuple(cell_id for cell_id in self._order if cell_id in gone_ids)
