# SPDX-License-Identifier: Apache-2.0
"""Answers: a sequence of cells, and errors by wire code; held cells on the wire, and their removals."""

from __future__ import annotations

import struct
from collections.abc import Callable

import numpy as np
import pytest

from shmmap import errors
from shmmap.client.cell import Cell
from shmmap.client.cell_set import CellSet, HeldCells, PendingLayer, cell_error
from shmmap.protocol.messages import FailedCell, HeldCell, Holder

BOX = (0.0, 0.0, 20.0, 20.0)


def test_it_is_the_sequence_of_its_cells(make_cell: Callable[..., Cell]) -> None:
    cells = tuple(make_cell(f"/{i}", BOX) for i in range(3))
    answer = CellSet(cells)
    assert tuple(answer) == cells
    assert (len(answer), answer[1], answer[-1], answer[:2]) == (3, cells[1], cells[2], cells[:2])
    assert answer.complete
    assert answer.raise_for_failures() is answer


def test_pending_and_failed_make_it_incomplete() -> None:
    assert not CellSet(pending=(PendingLayer("/a", "points"),)).complete
    failed = CellSet(failed=(errors.LoadFailed("broken", cell_id="/a", layer="points"),))
    assert not failed.complete
    with pytest.raises(errors.LoadFailed, match="broken"):
        failed.raise_for_failures()


@pytest.mark.parametrize(
    ("code", "kind"),
    [
        ("unknown_cell", errors.UnknownCell),
        ("load_failed", errors.LoadFailed),
        ("load_timeout", errors.LoadTimeout),
        ("over_budget", errors.OverBudget),
        ("no_space", errors.NoSpace),
        ("offline", errors.Offline),
        ("of_a_later_version", errors.CellError),
    ],
)
def test_errors_have_the_kind_of_their_code(code: str, kind: type[errors.CellError]) -> None:
    error = cell_error(FailedCell("a", "points", code, "why"), "/map/a")
    assert type(error) is kind
    assert (error.cell_id, error.layer) == ("/map/a", "points")
    assert error.message == "/map/a (points): why"
    assert str(error) == error.message + (f" ({error.hint})" if error.hint else "")


def test_what_passes_says_so() -> None:
    """A client that gives up ends as one that met a busy daemon does; the hint says to ask again."""
    error = cell_error(FailedCell("a", "points", "offline", "no answer"), "/map/a")
    assert (error.code, error.exit_code) == ("offline", errors.Busy.exit_code)
    assert "ask again" in error.hint


def test_what_is_not_covered_is_incomplete() -> None:
    assert CellSet().complete
    assert not CellSet(covered=False).complete
    assert "not covered" in repr(CellSet(covered=False))


def test_holders_are_lines_that_name_the_process() -> None:
    holders = (Holder(0xAB, 42, 1000, "ndt", 4096, 3), Holder(0, 0, -1, "", 8192))
    error = cell_error(FailedCell("a", "points", "over_budget", "full", holders), "/a")
    assert error.holders == holders
    assert tuple(map(str, error.holders)) == (
        "session 00000000000000ab, pid 42 (ndt) holds 4096 bytes in 3 cells",
        "unknown (not through the client library) holds 8192 bytes",
    )


# --- held cells -----------------------------------------------------------------------------------


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
    held = HeldCells(["/a", ("/b", 7), ("/c", 8, ("points",))])
    assert held.named == (HeldCell("/a"), HeldCell("/b", 7), HeldCell("/c", 8, ("points",)))


def test_removals_come_back_in_the_order_given(make_cell: Callable[..., Cell]) -> None:
    cells = [make_cell(f"/{name}", BOX, version=i + 1) for i, name in enumerate("dbca")]
    held = HeldCells(["/z", cells[0], cells[1], "/y", cells[2], cells[3]])
    assert held.removed(["/y", "/z"], packed(3, 1)) == ("/z", "/d", "/y", "/c")
    assert held.removed(["/y", "/z"], b"") == ("/y", "/z")
    assert held.removed([], b"") == ()
