# SPDX-License-Identifier: Apache-2.0
"""Held cells on the wire, and the removals that come back for them."""

from __future__ import annotations

import struct
from collections.abc import Callable

import numpy as np

from shmmap.client.cell import Cell
from shmmap.client.held import HeldCells
from shmmap.protocol.messages import HeldCell

BOX = (0.0, 0.0, 20.0, 20.0)


def packed(*versions: int) -> bytes:
    return struct.pack(f"<{len(versions)}Q", *versions)


def test_attached_cells_travel_as_versions(make_cell: Callable[..., Cell]) -> None:
    cells = [make_cell(f"/{i}", BOX, version=i + 2**63) for i in range(3)]
    cells.append(make_cell("/0", BOX, version=5, layer="voxel"))
    held = HeldCells(cells)
    assert sorted(np.frombuffer(held.packed, "<u8").tolist()) == [5, 2**63, 2**63 + 1, 2**63 + 2]
    assert held.named == ()


def test_by_name_names_each_layer_with_its_version(make_cell: Callable[..., Cell]) -> None:
    cells = [make_cell("/a", BOX, version=5), make_cell("/a", BOX, version=6, layer="voxel")]
    held = HeldCells(cells, by_name=True)
    assert held.packed == b""
    assert held.named == (HeldCell("/a", 5, ("points",)), HeldCell("/a", 6, ("voxel",)))


def test_a_cell_is_removed_with_its_last_layer(make_cell: Callable[..., Cell]) -> None:
    cells = [make_cell("/a", BOX, version=5), make_cell("/a", BOX, version=6, layer="voxel")]
    held = HeldCells(cells)
    assert held.removed([], packed(6)) == ()
    assert held.removed([], packed(6, 5)) == ("/a",)
    assert held.removed(["/a"], packed(6)) == ("/a",)


def test_ids_and_versions_may_be_given_by_hand() -> None:
    held = HeldCells(["/a", ("/b", 7), HeldCell("/c", 8, ("points",))])
    assert held.named == (HeldCell("/a"), HeldCell("/b", 7), HeldCell("/c", 8, ("points",)))


def test_removals_come_back_in_the_order_given(make_cell: Callable[..., Cell]) -> None:
    cells = [make_cell(f"/{name}", BOX, version=i + 1) for i, name in enumerate("dbca")]
    held = HeldCells(["/z", cells[0], cells[1], "/y", cells[2], cells[3]])
    assert held.removed(["/y", "/z"], packed(3, 1)) == ("/z", "/d", "/y", "/c")
    assert held.removed(["/y", "/z"], b"") == ("/y", "/z")
    assert held.removed([], b"") == ()
