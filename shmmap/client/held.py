# SPDX-License-Identifier: Apache-2.0
"""What a client says it holds, as a differential request carries it, and the removals that come back."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TypeAlias

import numpy as np

from shmmap.client.cell import Cell
from shmmap.errors import BadRequest
from shmmap.protocol.messages import HeldCell

__all__ = ["Held", "HeldCells"]

Held: TypeAlias = Cell | HeldCell | str | tuple[str, int]
"""An attached cell, or an id (which means its current version), or id and version."""


class HeldCells:
    """Held cells in wire form.

    Attached cells travel as 8 bytes of version each (``packed``), unless the daemon may not know what a
    version means any more (``by_name``); others by name.

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
                one = HeldCell(one)
            elif isinstance(one, tuple) and len(one) == 2:
                one = HeldCell(one[0], one[1])
            elif not isinstance(one, HeldCell):
                raise BadRequest(f"held must be cells, ids, or ids with versions, and {one!r} is none")
            self._order[one.id] = None
            named.append(one)
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
