# SPDX-License-Identifier: Apache-2.0
"""Held cells on the wire, and the removals that come back for them."""

from __future__ import annotations

import struct
from collections.abc import Callable

from shmmap.client.cell import Cell
from shmmap.client.held import HeldCells
from shmmap.protocol.messages import HeldCell

BOX = (0.0, 0.0, 20.0, 20.0)


def packed(*versions: int) -> bytes:
    return struct.pack(f"<{len(versions)}Q", *versions)


def test_cells_held_in_every_layer_travel_as_versions(make_cell: Callable[..., Cell]) -> None:
    cells = [make_cell(f"/{i}", BOX, version=i + 2**63) for i in range(3)]
    held = HeldCells(cells, ("points",))
    assert held.packed == packed(2**63, 2**63 + 1, 2**63 + 2)
    assert held.named == ()


def test_a_cell_that_misses_a_layer_is_named_with_those_it_has(make_cell: Callable[..., Cell]) -> None:
    points = make_cell("/a", BOX, version=5)
    voxel = make_cell("/a", BOX, version=5, layer="voxel")
    assert HeldCells([points, voxel], ("points", "voxel")).packed == packed(5)
    partial = HeldCells([points], ("points", "voxel"))
    assert partial.packed == b""
    assert partial.named == (HeldCell("/a", 5, ("points",)),)


def test_by_name_names_everything(make_cell: Callable[..., Cell]) -> None:
    held = HeldCells([make_cell("/a", BOX, version=5)], ("points",), by_name=True)
    assert (held.packed, held.named) == (b"", (HeldCell("/a", 5, ("points",)),))


def test_ids_and_versions_may_be_given_by_hand() -> None:
    held = HeldCells(["/a", ("/b", 7), HeldCell("/c", 8, ("points",))], ("points",))
    assert held.named == (HeldCell("/a"), HeldCell("/b", 7), HeldCell("/c", 8, ("points",)))


def test_removals_come_back_in_the_order_given(make_cell: Callable[..., Cell]) -> None:
    cells = [make_cell(f"/{name}", BOX, version=i + 1) for i, name in enumerate("dbca")]
    held = HeldCells(["/z", cells[0], cells[1], "/y", cells[2], cells[3]], ("points",))
    assert held.removed(["/y", "/z"], packed(3, 1)) == ("/z", "/d", "/y", "/c")
    assert held.removed(["/y", "/z"], b"") == ("/y", "/z")
    assert held.removed([], b"") == ()
