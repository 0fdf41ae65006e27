# SPDX-License-Identifier: Apache-2.0
"""The filter: from a rule, cells and a scan, it finds the points that the map does not explain."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shmmap import BadRequest, Cell, MapWindow
from shmmap.layers import LayerTable, canonical_layer
from shmmap_clients.compare_map_filter.rule import CompareRule, explain, to_map
from shmmap_clients.compare_map_filter.search_table import SearchCell, SearchTable

BACKENDS = ("numba", "numpy")


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """Result of the comparison of one scan.

    Attributes
    ----------
    kept
        (N,) bool: points that the map does not explain, including those not finite, as upstream.
    cells
        Number of cells in the comparison.
    no_map
        Whether no cell reaches the scan, so that all points are kept for lack of a map.
    compare_s, update_s
        Seconds for the comparison, and for updating the window's cells before it (0 if the window had not
        changed).
    """

    kept: NDArray[np.bool_]
    cells: int
    no_map: bool
    compare_s: float
    update_s: float

    @property
    def indices(self) -> NDArray[np.int64]:
        """Rows of the kept points, ascending."""
        return np.flatnonzero(self.kept)

    def select(self, columns: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
        """Return the kept rows of all columns of the scan."""
        return {name: values[self.kept] for name, values in columns.items()}


class CompareMapFilter:
    """Filter that finds the points of a scan that the map explains.

    Follow a window of the layer that the rule needs (`CompareRule.layer`)::

        rule = CompareRule("voxel", distance=0.5)
        window = shmmap.MapWindow(radius=150.0, layers=rule.layer, update_distance=10.0)
        compare = CompareMapFilter(rule)
        window.move_to(x, y, wait=5.0)
        moved = compare.follow(window).apply(xyz, T_map_sensor).kept

    The filter neither copies cells nor builds an index over them: an update only makes a table of their
    addresses.

    Parameters
    ----------
    rule
        Rule that defines explained points.
    backend
        ``numba``, or ``numpy``: the same result, slower.

    Raises
    ------
    BadRequest
        The backend is unknown.
    """

    def __init__(self, rule: CompareRule | None = None, *, backend: str = "numba") -> None:
        if backend not in BACKENDS:
            raise BadRequest(f"backend {backend!r} is unknown", hint=f"use one of {', '.join(BACKENDS)}")
        self.rule = rule if rule is not None else CompareRule()
        self.backend = backend
        self._layer = canonical_layer(self.rule.layer)
        self._table = SearchTable.of_cells(())
        self._known: dict[int, SearchCell] = {}
        self._update_s = 0.0
        if backend == "numba":
            from shmmap_clients.compare_map_filter import kernel

            self._explain = kernel.explain

    def follow(self, window: MapWindow) -> CompareMapFilter:
        """Use the present cells of a window; do nothing if it has not changed.

        Raises
        ------
        BadRequest
            The window has `search` layers, but not the rule's.
        """
        cells = [cell for cell in window.cells if cell.layer.startswith("search(")]
        mine = [cell for cell in cells if cell.layer == self._layer]
        if cells and not mine:
            raise BadRequest(f"the window has {cells[0].layer}", hint=f"this rule needs {self._layer}")
        return self.use_cells(mine)

    def use_cells(self, cells: Iterable[Cell]) -> CompareMapFilter:
        """Compare with these cells of a ``search`` layer from now on.

        Raises
        ------
        BadRequest
            The layer's leaf is not the rule's distance.
        """
        begin = time.perf_counter()
        wanted = {id(cell): cell for cell in cells}
        if wanted.keys() != self._known.keys():
            self._use({key: self._known.get(key) or _wrapped(cell) for key, cell in wanted.items()})
            self._update_s += time.perf_counter() - begin
        return self

    def use_tables(self, tables: Iterable[LayerTable]) -> CompareMapFilter:
        """Compare with tables of `shmmap.layers.build_layer`, without a daemon; errors as in `use_cells`."""
        self._use({id(one): SearchCell.of_layer(one) for one in tables if one.lattice is not None})
        return self

    def _use(self, cells: dict[int, SearchCell]) -> None:
        leaves = {cell.leaf for cell in cells.values()} - {self.rule.distance}
        if leaves:  # else its columns would not contain the neighbours
            raise BadRequest(
                f"a search layer of {leaves.pop():g} m cannot answer a distance of {self.rule.distance:g} m",
                hint=f"this rule needs {self._layer}",
            )
        self._table = SearchTable.of_cells(list(cells.values()))
        self._known = cells

    def apply(self, points: NDArray[Any], T_map_sensor: NDArray[np.float64] | None = None) -> Comparison:
        """Compare one scan.

        Parameters
        ----------
        points
            (N, 3) float32 or float64, metres, sensor frame.
        T_map_sensor
            (4, 4) float64; None: the points are in the map frame.

        Raises
        ------
        BadRequest
            An array has a wrong shape.
        """
        pose = np.eye(4) if T_map_sensor is None else np.ascontiguousarray(T_map_sensor, np.float64)
        if pose.shape != (4, 4):
            raise BadRequest(f"a pose is a 4 x 4 matrix, not {pose.shape}")
        if points.ndim != 2 or points.shape[1] != 3:
            raise BadRequest(f"points must have shape (N, 3), not {points.shape}")
        wide = points.dtype.kind != "f" or points.dtype.itemsize > 4
        scan = np.ascontiguousarray(points, np.float64 if wide else np.float32)
        begin = time.perf_counter()
        if self.backend == "numba":
            explained = self._compiled(scan, pose)
        else:
            explained = explain(scan, pose, self.rule, self._table)
        no_map = not explained.any() and not self._reached(scan, pose)
        compare_s = time.perf_counter() - begin
        update_s, self._update_s = self._update_s, 0.0
        return Comparison(~explained, len(self._table.cells), no_map, compare_s, update_s)

    @property
    def bounds(self) -> tuple[float, float, float, float] | None:
        """Bounds of the cells: min_x, min_y, max_x, max_y, metres, map frame; None without cells."""
        return self._table.bounds

    def _reached(self, scan: NDArray[Any], pose: NDArray[np.float64]) -> bool:
        """Return whether a cell has columns within the scan's extent; True for an empty scan."""
        places = to_map(scan, pose)[:, :2]
        places = places[np.isfinite(places).all(axis=1)]
        if not len(places):
            return bool(self._table.cells)
        reach = self.rule.distance
        return self._table.touches(places.min(axis=0) - reach, places.max(axis=0) + reach)

    def _compiled(self, scan: NDArray[Any], pose: NDArray[np.float64]) -> NDArray[np.bool_]:
        explained = np.empty(len(scan), np.bool_)
        table = self._table
        self._explain(
            scan,
            pose,
            self.rule.code,
            self.rule.distance,
            self.rule.distance_z,
            table.leaf,
            table.rows,
            table.bin_columns,
            *table.bin_first,
            *table.bin_shape,
            table.bin_start,
            table.bin_cells,
            explained,
        )
        return explained


def _wrapped(cell: Cell) -> SearchCell:
    if cell.lattice is None:
        raise BadRequest(f"{cell.id}: layer {cell.layer} has no lattice: it is no search layer")
    return SearchCell.of_layer(cell)
