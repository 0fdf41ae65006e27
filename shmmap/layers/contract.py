# SPDX-License-Identifier: Apache-2.0
"""What a layer kind is: parameters, columns, and a builder from points to a table.

A new kind is one module that makes a `LayerKind`, and one registration: a line in
`shmmap.layers.spec` for a kind of shmmap's own, an entry point of the group ``shmmap.layers``
(its object a `LayerKind`) for any other.  `shmmap.testing.layer_conformance` checks any kind.
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

__all__ = [
    "BUILT_ANYWHERE",
    "Box",
    "Columns",
    "Lattice",
    "LayerColumn",
    "LayerKind",
    "LayerTable",
    "Parameter",
    "Parameters",
    "PointTable",
    "Value",
]

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
        Value where a spec does not name it; None: it has none, and the kind's ``resolve`` decides
        whether it may be left out.
    required
        Whether every spec must name it.
    minimum, maximum
        Closed bounds; a float must be finite besides.
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
            If it is no such number or lies outside the bounds.
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
        """One line for people: name, unit, bounds, default, meaning."""
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
    """One column that a kind promises.

    Attributes
    ----------
    name
        ``*`` stands for every other column of the source.
    dtype
        None: that of the source's column of the same name.
    shape
        In words, such as ``(rows, 3)``; documentation.
    """

    name: str
    dtype: np.dtype[np.generic] | None
    shape: str
    unit: str
    meaning: str


@dataclass(slots=True)
class PointTable:
    """The points of one cell, as builders get them.

    Attributes
    ----------
    columns
        ``xyz`` (N, 3) float32 or float64, map frame, metres, C-contiguous; other columns (N,) or
        (N, components), in the source's dtypes.  Read-only for builders.
    units
        Unit of each column, empty where unknown.
    box
        The cell's (min_x, min_y, max_x, max_y), metres; infinite where the points are no cell's.
    halo
        For a kind with a halo: (M, 3) coordinates of the neighbouring cells' points within it, dtype
        as ``xyz``; None where there are no neighbours.
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
        """Which points have finite coordinates, (N,)."""
        found: NDArray[np.bool_] = np.isfinite(self.xyz).all(axis=1)
        return found

    def selected(self, rows: NDArray[np.bool_] | NDArray[np.int64]) -> LayerTable:
        """Return the table of some points, every column of them; a mask or row numbers."""
        columns = {name: np.ascontiguousarray(column[rows]) for name, column in self.columns.items()}
        return LayerTable(columns, len(columns["xyz"]), {**self.units, "xyz": "m"})


@dataclass(slots=True)
class LayerTable:
    """One layer of one cell: named arrays and what belongs to them.

    Attributes
    ----------
    columns
        In order; C-contiguous, little-endian, up to four dimensions.
    rows
        What a handle's ``points`` counts: rows of the table (points, voxels, columns of ground).
    units
        Unit of each column, empty where unknown.
    lattice
        The lattice that the rows or tables lie on; None where there is none.
    """

    columns: Columns
    rows: int
    units: Mapping[str, str] = field(default_factory=dict)
    lattice: Lattice | None = None

    def __getitem__(self, name: str) -> NDArray[Any]:
        return self.columns[name]

    @property
    def nbytes(self) -> int:
        """Bytes of all columns together."""
        return sum(column.nbytes for column in self.columns.values())


def _as_given(values: Parameters) -> Parameters:
    return values


def _no_halo(values: Parameters) -> float:
    del values
    return 0.0


@dataclass(frozen=True, slots=True)
class LayerKind:
    """A kind of layer.

    Attributes
    ----------
    name
        ASCII identifier; what specs say before the parenthesis.
    builder_version
        1 to 255; raise it when the same points would give other bytes: caches then build again.
    summary, borders
        For people: what it holds, and what happens where two cells meet.
    parameters, columns
        What it takes, what it gives.
    build
        From points and checked parameters to the table.  Must be a pure function of them: the same
        bytes in every process.  Points that are not finite are left out.
    resolve
        Called with the checked parameters that a spec named (defaults filled in); returns the
        canonical ones, or raises `BadRequest`.
    halo_m
        How far beyond the cell's box the builder looks, metres; 0: not at all.
    gives_points
        The result has ``xyz`` and can be the source of another layer (``of=``).
    takes_layers
        May be built of another layer; kinds with a halo always take the source.
    needs
        Columns of the source that it reads, None for all of them.
    bytes_ratio
        About how many bytes it has per byte of source: what is reserved before a build; a build
        that needs more asks.
    """

    name: str
    builder_version: int
    summary: str
    borders: str
    parameters: tuple[Parameter, ...]
    columns: tuple[LayerColumn, ...]
    build: Callable[[PointTable, Parameters], LayerTable]
    resolve: Callable[[Parameters], Parameters] = _as_given
    halo_m: Callable[[Parameters], float] = _no_halo
    gives_points: bool = False
    takes_layers: bool = True
    needs: tuple[str, ...] | None = ("xyz",)
    bytes_ratio: float = 0.1

    def describe(self) -> str:
        """Return the kind's signature, such as ``ndt(leaf,min_points=6)``."""
        words = [p.name if p.default is None else f"{p.name}={p.default:g}" for p in self.parameters]
        return f"{self.name}({','.join(words)})" if words else self.name
