# SPDX-License-Identifier: Apache-2.0
"""The columns of every kind of layer as a table of texts, generated from their declarations.

``LAYERS.md`` has the table of `column_table`, and a test compares them; other documents can take the rows of
`column_rows`, which are the same texts without markup.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from shmmap.layers.contract import LayerColumn, LayerKind
from shmmap.layers.spec import kinds


class ColumnRow(NamedTuple):
    """One column of one kind of layer, in words; the fields are those of `LayerColumn`."""

    layer: str
    column: str
    dtype: str
    shape: str
    unit: str
    frame: str
    missing: str
    meaning: str


def column_rows(of: Iterable[LayerKind] | None = None) -> tuple[ColumnRow, ...]:
    """Return a row for each column of each kind, in their order; by default of all kinds that are installed.

    The column ``*`` stands for every other column of the source.
    """
    return tuple(
        ColumnRow(
            kind.name,
            column.name,
            _dtype(column),
            column.shape,
            column.unit,
            column.frame,
            column.missing,
            column.meaning,
        )
        for kind in (kinds() if of is None else of)
        for column in kind.columns
    )


def column_table(of: Iterable[LayerKind] | None = None) -> list[str]:
    """Return the rows of `column_rows` as lines of a table in Markdown; layers with equal rows share one."""
    sharing: dict[tuple[str, ...], list[str]] = {}
    for row in column_rows(of):
        sharing.setdefault(row[1:], []).append(f"`{row.layer}`")
    lines = ["| layer | column | dtype, shape | unit, frame | no value | what |", "|---" * 6 + "|"]
    for (column, dtype, shape, unit, frame, *texts), layers in sharing.items():
        kind = dtype if dtype == shape else f"{dtype} {shape}"
        cells = [", ".join(layers), f"`{column}`", kind, ", ".join(filter(None, (unit, frame))), *texts]
        lines.append("|" + "".join(f" {cell} |" if cell else " |" for cell in cells))
    return lines


def _dtype(column: LayerColumn) -> str:
    if column.dtype is not None:
        return str(column.dtype)
    return "float32 or float64" if column.name == "xyz" else "the source's"
