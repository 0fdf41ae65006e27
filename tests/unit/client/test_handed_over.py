# SPDX-License-Identifier: Apache-2.0
"""Cells that another process has handed over: their own segment, or an error."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from msgspec.structs import replace

from shmmap.client.handed_over import hand_over
from shmmap.errors import StaleHandle

if TYPE_CHECKING:
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
