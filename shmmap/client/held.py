# SPDX-License-Identifier: Apache-2.0
"""What a client says it holds, as a differential request carries it, and the removals that come back."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TypeAlias

import numpy as np

from shmmap.client.cell import Cell
from shmmap.protocol.messages import HeldCell

__all__ = ["Held", "HeldCells"]

Held: TypeAlias = Cell | HeldCell | str | tuple[str, int]
"""An attached cell, or an id (which means its current version), or id and version."""


class HeldCells:
    """Held cells in wire form.

    Cells held in every layer asked for travel as 8 bytes of version each (``packed``), unless the
    daemon may not know what a version means any more (``by_name``); others by name.

    Attributes
    ----------
    packed : bytes
        Versions, 8 bytes little-endian each.
    named : tuple of HeldCell
        The rest.
    """

    def __init__(self, held: Iterable[Held], layers: Sequence[str], *, by_name: bool = False) -> None:
        self._order: dict[str, int | None] = {}
        cells: dict[tuple[str, int], list[str]] = {}
        named: list[HeldCell] = []
        for one in held:
            if isinstance(one, Cell):
                cells.setdefault((one.id, one.version), []).append(one.layer)
                self._order.setdefault(one.id, one.version)
                continue
            if isinstance(one, str):
                one = HeldCell(one)
            elif isinstance(one, tuple):
                one = HeldCell(one[0], one[1])
            self._order.setdefault(one.id, one.version)
            named.append(one)
        versions: list[int] = []
        wanted = set(layers)
        for (cell_id, version), held_layers in cells.items():
            if not by_name and wanted.issubset(held_layers):
                versions.append(version)
            else:
                named.append(HeldCell(cell_id, version, tuple(dict.fromkeys(held_layers))))
        self.packed = np.array(versions, "<u8").tobytes() if versions else b""
        self.named = tuple(named)

    def removed(self, ids: Sequence[str], packed: bytes) -> tuple[str, ...]:
        """Ids to drop, in the order they were given, from a reply's two lists."""
        if not packed:
            return tuple(ids)
        gone_versions = set(np.frombuffer(packed, "<u8").tolist())
        gone_ids = set(ids)
        return tuple(
            cell_id
            for cell_id, version in self._order.items()
            if cell_id in gone_ids or version in gone_versions
        )
