# SPDX-License-Identifier: Apache-2.0
"""Interface of layer kinds: parameters, columns, and a builder from points to a table.

A new kind needs one module that creates a `LayerKind`, and one registration: a line in
`shmmap.layers.spec` for shmmap's own kinds, an entry point of the group ``shmmap.layers``
(whose object is a `LayerKind`) for others.  `shmmap.testing.layer_conformance` checks any kind.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from shmmap.errors import BadRequest
from shmmap.segment.layout import Lattice

Value: TypeAlias = float | int
Parameters: TypeAlias = Mapping[str, Value]
Columns: TypeAlias = "dict[str, NDArray[Any]]"
Box: TypeAlias = tuple[float, float, float, float]

BUILT_ANYWHERE: Final[Box] = (-math.inf, -math.inf, math.inf, math.inf)


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter of a layer kind.

    Attributes
    ----------
    name, meaning, unit
        For requests, documents and messages; SI units.
    kind
        ``float`` or ``int``.
    default
        Value if a spec does not name the parameter; None: no default, and the kind's ``resolve`` decides
        whether the parameter may be left out.
    required
        Whether every spec must name it.
    minimum, maximum
        Closed bounds; a float must also be finite.
    above
        An open lower bound: the value must be greater.
    """

    name: str
    kind: type[float] | type[int]
    meaning: str
    unit: str = ""
    default: Value | None = None
    required: bool = False
    minimum: float = -math.inf
    maximum: float = math.inf
    above: float = -math.inf

    def checked(self, value: Value, layer: str) -> Value:
        """Return ``value`` as this parameter's type.

        Raises
        ------
        BadRequest
            The value is of another type or out of bounds.
        """
        whole = self.kind is int
        if isinstance(value, bool) or not math.isfinite(value) or (whole and value != int(value)):
            raise BadRequest(
                f"{layer}: {self.name} must be a {'whole' if whole else 'finite'} number, not {value!r}"
            )
        if not (value > self.above and self.minimum <= value <= self.maximum):
            raise BadRequest(f"{layer}: {self.name}={value!r} is out of range", hint=self.describe())
        return self.kind(value)

    def describe(self) -> str:
        """Return one line of text: name, unit, bounds, default, meaning."""
        bounds = [
            *([f"> {self.above:g}"] if self.above > -math.inf else []),
            *([f">= {self.minimum:g}"] if self.minimum > -math.inf else []),
            *([f"<= {self.maximum:g}"] if self.maximum < math.inf else []),
        ]
        notes = [*([self.unit] if self.unit else []), *bounds]
        if self.default is not None:
            notes.append(f"default {self.default:g}")
        return f"{self.name}: {self.meaning}" + (f" ({', '.join(notes)})" if notes else "")


@dataclass(frozen=True, slots=True)
class LayerColumn:
    """One column that a kind's layers have.

    Attributes
    ----------
    name
        ``*`` stands for every other column of the source.
    dtype
        Dtype; None: that of the source's column of the same name.
    shape
        Text for documentation, such as ``(rows, 3)``.
    unit, meaning
        SI unit, empty for none; what a value is.
    frame
        ``map`` where values are coordinates in the map frame, relative to `Cell.origin`; empty where no frame
        matters.
    missing
        What stands where there is no value, such as ``NaN``; empty if every row has a value.
    """

    name: str
    dtype: np.dtype[np.generic] | None
    shape: str
    unit: str
    meaning: str
    frame: str = ""
    missing: str = ""


OTHER_FIELDS: Final = LayerColumn(
    "*",
    None,
    "the source's",
    "the source's",
    "every other field: intensity, ring, ...",
    missing="the source's",
)
"""The other columns of a kind that keeps those of its source."""


@dataclass(slots=True)
class PointTable:
    """The points of one cell, as passed to builders.

    Attributes
    ----------
    columns
        ``xyz`` (N, 3) float32 or float64, map frame, metres, C-contiguous; other columns (N,) or
        (N, components), in the source's dtypes.  Read-only for builders.
    units
        Unit of each column, empty where unknown.
    box
        The cell's (min_x, min_y, max_x, max_y), metres; infinite if the points are not those of a cell.
    halo
        For a kind with a halo: (M, 3) coordinates of the neighbouring cells' points within the halo, dtype
        as ``xyz``; None if there are no neighbours.
    """

    columns: Columns
    units: Mapping[str, str] = field(default_factory=dict)
    box: Box = BUILT_ANYWHERE
    halo: NDArray[Any] | None = None

    @property
    def xyz(self) -> NDArray[Any]:
        """The coordinates, (N, 3) float32 or float64, map frame, metres."""
        return self.columns["xyz"]

    def __len__(self) -> int:
        return len(self.columns["xyz"])

    def finite(self) -> NDArray[np.bool_]:
        """Return a mask of the points with finite coordinates, (N,)."""
        found: NDArray[np.bool_] = np.isfinite(self.xyz).all(axis=1)
        return found

    def selected(self, rows: NDArray[np.bool_] | NDArray[np.int64]) -> LayerTable:
        """Return a table of selected points with every column; ``rows`` is a mask or row numbers."""
        columns = {name: np.ascontiguousarray(column[rows]) for name, column in self.columns.items()}
        return LayerTable(columns, len(columns["xyz"]), {**self.units, "xyz": "m"})


@dataclass(slots=True)
class LayerTable:
    """One layer of one cell: named arrays, their units and lattice.

    Attributes
    ----------
    columns
        Arrays by name, in order; C-contiguous, little-endian, up to four dimensions.
    rows
        Number of rows of the table (points, voxels, columns of ground), given as ``points`` in a handle.
    units
        Unit of each column, empty where unknown.
    lattice
        The lattice of the rows or tables; None if there is none.
    """

    columns: Columns
    rows: int
    units: Mapping[str, str] = field(default_factory=dict)
    lattice: Lattice | None = None

    def __repr__(self) -> str:
        return f"<LayerTable of {self.rows} rows: {', '.join(self.columns)}>"

    def __getitem__(self, name: str) -> NDArray[Any]:
        return self.columns[name]

    @property
    def nbytes(self) -> int:
        """Total bytes of all columns."""
        return sum(column.nbytes for column in self.columns.values())


@dataclass(frozen=True, slots=True)
class LayerKind:
    """A kind of layer.

    Attributes
    ----------
    name
        ASCII identifier, the part of a spec before the parenthesis.
    builder_version
        1 to 255; increase it when the same points would give other bytes, so that caches build again.
    summary, borders
        Texts for users: content of the layer, and its behaviour at the border of two cells.
    parameters, columns
        Parameters of the builder, and columns of its result.
    build
        Function from points and checked parameters to the table.  It must be pure: the same bytes in every
        process.  It leaves out points that are not finite.
    resolve
        Called with the checked parameters that a spec named (defaults filled in); returns the
        canonical parameters, or raises `BadRequest`.
    halo_m
        Distance beyond the cell's box from which the builder uses points, metres; 0: none.
    gives_points
        Whether the result has ``xyz`` and so can be the source of another layer (``of=``).
    takes_layers
        Whether the layer may be built of another layer; kinds with a halo always use the source.
    needs
        Columns of the source that the builder reads; None for all.
    bytes_ratio
        Approximate bytes of the layer per byte of its source.  As much memory is reserved before a build; a
        build that needs more reserves more.
    """

    name: str
    builder_version: int
    summary: str
    borders: str
    parameters: tuple[Parameter, ...]
    columns: tuple[LayerColumn, ...]
    build: Callable[[PointTable, Parameters], LayerTable]
    resolve: Callable[[Parameters], Parameters] = lambda parameters: parameters
    halo_m: Callable[[Parameters], float] = lambda _: 0.0
    gives_points: bool = False
    takes_layers: bool = True
    needs: tuple[str, ...] | None = ("xyz",)
    bytes_ratio: float = 0.1

    def describe(self) -> str:
        """Return the kind's signature, such as ``ndt(leaf,min_points=6)``."""
        words = [p.name if p.default is None else f"{p.name}={p.default:g}" for p in self.parameters]
        return f"{self.name}({','.join(words)})" if words else self.name
