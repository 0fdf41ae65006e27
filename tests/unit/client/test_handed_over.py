# SPDX-License-Identifier: Apache-2.0
"""Cells that another process has handed over: their own segment, or an error."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from msgspec.structs import replace

from shmmap.client import handed_over
from shmmap.client.handed_over import hand_over
from shmmap.errors import StaleHandle
from tests.support.interleaving import interleaved

if TYPE_CHECKING:
    from shmmap.client.cell import Cell
    from tests.unit.client.conftest import Segments

XYZ = {"xyz": np.arange(15, dtype=np.float32).reshape(5, 3)}


def test_a_name_that_another_segment_has_now_is_not_the_cell(segments: Segments) -> None:
    """One of another run of the daemon, or of another version of the cell."""
    name, handle = segments.publish("/a", XYZ, version=5)
    take, (*place, epoch, cell_id, handle) = hand_over(segments.attach(name, handle))
    assert take(*place, epoch, cell_id, handle).xyz.tolist() == XYZ["xyz"].tolist()
    later, _ = segments.publish("/a", XYZ, version=6)
    for other_epoch, other in ((epoch + 1, handle), (epoch, replace(handle, segment=later))):
        with pytest.raises(StaleHandle, match="is gone since it was pickled"):
            take(*place, other_epoch, cell_id, other)


def test_two_threads_that_take_a_cell_at_the_same_time_map_it_once(
    segments: Segments, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(handed_over, "_lock", handed_over._lock)  # it is put back
    take, given = hand_over(segments.cell("/a", XYZ))
    cells: list[Cell] = []

    def take_it(_module: object) -> None:
        cells.append(take(*given))

    for _ in interleaved(lambda: handed_over, take_it, take_it):
        assert cells.pop() is cells.pop()
