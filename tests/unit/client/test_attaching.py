# SPDX-License-Identifier: Apache-2.0
"""One mapping for each version and layer, and where mappings go."""

from __future__ import annotations

import sys
import threading
from queue import SimpleQueue
from typing import TYPE_CHECKING

import numpy as np
import pytest

from shmmap.client.cell import Cell
from shmmap.segment.attach import Owned
from tests.support.process_costs import mappings_under

if TYPE_CHECKING:
    from tests.unit.client.conftest import Segments

XYZ = {"xyz": np.ones((5, 3), np.float32)}


def test_the_same_version_and_layer_is_mapped_once(segments: Segments) -> None:
    name, handle = segments.publish("/a", XYZ, version=5)
    first = segments.attach(name, handle)
    assert segments.attach(name, handle) is first
    other, handle_of_other = segments.publish("/a", XYZ, version=5, layer="voxel")
    assert segments.attach(other, handle_of_other) is not first
    assert mappings_under(segments.path) == 1


def test_staleness_follows_the_last_reply(segments: Segments) -> None:
    name, handle = segments.publish("/a", XYZ, version=5)
    cell = segments.attach(name, handle)
    values = [getattr(handle, field) for field in handle.__struct_fields__]
    values[handle.__struct_fields__.index("stale")] = True
    segments.attach(name, type(handle)(*values))
    assert cell.stale
    segments.attach(name, handle)
    assert not cell.stale


def test_a_version_is_reported_when_its_last_layer_is_unmapped(segments: Segments) -> None:
    points = segments.cell("/a", XYZ, version=5)
    voxel = segments.cell("/a", XYZ, version=5, layer="voxel")
    other = segments.cell("/b", XYZ, version=6)
    attacher = segments.attacher
    del points
    assert attacher.unmapped() == []
    del voxel
    assert attacher.unmapped() == [5]
    attacher.unmapped().clear()
    assert attacher.unmapped() == []
    assert attacher.any_mapped
    del other
    assert attacher.unmapped() == [6]
    assert attacher.unmapped() == [6], "until it was reported"
    assert not attacher.any_mapped


def test_deferred_mappings_stay_until_their_thread_unmaps_them(segments: Segments) -> None:
    queue: SimpleQueue[Owned | None] = SimpleQueue()
    attacher = segments.attacher
    attacher.unmap_in(queue)
    cell = segments.cell("/a", XYZ, version=5)
    address = cell.xyz.ctypes.data
    del cell
    assert mappings_under(segments.path) == 1
    assert segments.attacher.unmapped() == []
    memory = queue.get_nowait()
    assert memory is not None
    assert memory.value <= address < memory.value + 65536
    del memory
    assert mappings_under(segments.path) == 0
    assert segments.attacher.unmapped() == [5]
    attacher.stop_unmapping_in(queue)


def test_what_is_queued_when_the_thread_ends_is_unmapped_too(segments: Segments) -> None:
    first: SimpleQueue[Owned | None] = SimpleQueue()
    second: SimpleQueue[Owned | None] = SimpleQueue()
    attacher = segments.attacher
    attacher.unmap_in(first)
    attacher.unmap_in(second)
    cells = [segments.cell(f"/{i}", XYZ, version=i) for i in range(1, 4)]
    cells.pop()
    attacher.stop_unmapping_in(first)
    assert mappings_under(segments.path) == 2
    cells.pop()
    assert second.qsize() == 1, "the other thread takes over"
    attacher.stop_unmapping_in(second)
    assert mappings_under(segments.path) == 1
    cells.pop()
    assert mappings_under(segments.path) == 0


def drop_when_all_are_there(cells: list[Cell], barrier: threading.Barrier) -> None:
    barrier.wait()
    cells.clear()


def test_dropping_cells_in_many_threads_while_the_thread_ends_loses_none(segments: Segments) -> None:
    queue: SimpleQueue[Owned | None] = SimpleQueue()
    attacher = segments.attacher
    for round_ in range(20):
        attacher.unmap_in(queue)
        cells = [segments.cell(f"/{round_}/{i}", XYZ, version=round_ * 100 + i + 1) for i in range(8)]
        barrier = threading.Barrier(9)
        threads = [threading.Thread(target=drop_when_all_are_there, args=([c], barrier)) for c in cells]
        for thread in threads:
            thread.start()
        cells.clear()
        barrier.wait()
        attacher.stop_unmapping_in(queue)
        for thread in threads:
            thread.join()
        threads.clear()
        del thread
        assert mappings_under(segments.path) == 0


@pytest.mark.parametrize("deferred", [False, True])
def test_nothing_written_in_python_runs_when_a_cell_ends(segments: Segments, deferred: bool) -> None:
    """There a signal handler's exception would be ignored, and Ctrl-C lost."""
    queue: SimpleQueue[Owned | None] = SimpleQueue()
    if deferred:
        segments.attacher.unmap_in(queue)
    cells = [segments.cell("/a", XYZ, version=5)]
    views = [cells[0].xyz]
    entered: list[str] = []
    before = sys.getprofile()
    sys.setprofile(lambda frame, event, _: entered.append(frame.f_code.co_name) if event == "call" else None)
    try:
        cells.clear()
        views.clear()
    finally:
        sys.setprofile(before)
    assert entered == []
    assert queue.qsize() == deferred
    segments.attacher.stop_unmapping_in(queue)
    assert segments.attacher.unmapped() == [5]
