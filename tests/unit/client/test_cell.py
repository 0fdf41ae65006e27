# SPDX-License-Identifier: Apache-2.0
"""Cells: read-only views that outlive everything, and their wrappers."""

from __future__ import annotations

import gc
import subprocess
import sys
import weakref
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from numpy.typing import NDArray

from shmmap.client.cell import Access
from shmmap.errors import SegmentCorrupt, StaleHandle
from tests.support.process_costs import mappings_under

if TYPE_CHECKING:
    from tests.unit.client.conftest import Segments

XYZ = np.arange(30, dtype=np.float32).reshape(10, 3)
COLUMNS: dict[str, NDArray[Any]] = {
    "xyz": XYZ,
    "intensity": np.linspace(0, 1, 10),
    "ring": np.arange(10, dtype=np.uint16),
    "rgb": np.arange(30, dtype=np.uint8).reshape(10, 3),
}


def test_columns_keep_names_order_dtypes_and_bits(segments: Segments) -> None:
    cell = segments.cell("/map/a.pcd", COLUMNS, version=0xABC)
    assert cell.column_names == tuple(COLUMNS)
    for name, values in COLUMNS.items():
        assert cell[name].dtype == values.dtype
        assert cell[name].tobytes() == values.tobytes()
        assert cell.columns[name] is cell[name]
    assert cell.xyz is cell["xyz"]
    assert (cell.id, cell.layer, cell.points, cell.version) == ("/map/a.pcd", "points", 10, 0xABC)
    assert cell.version_hex == "0000000000000abc"
    assert cell.box == (0.0, 0.0, 20.0, 20.0)
    assert (cell.unit("xyz"), cell.unit("ring")) == ("m", "")
    assert not cell.stale


def test_header_fields(segments: Segments) -> None:
    cell = segments.cell("/map/a.pcd", COLUMNS, origin=(1.0, 2.0, 3.0))
    assert cell.header.cell_id == "/map/a.pcd"
    assert cell.z_bounds == (-1.0, 8.0)
    assert (cell.source_points, cell.dropped_points) == (12, 2)
    assert tuple(cell.source) == (11, 22, 33)
    assert cell.source_digest == bytes(range(16))
    assert cell.origin == (1.0, 2.0, 3.0)
    assert cell.frame_id == "map"


def test_an_unknown_column_is_named_with_those_there_are(segments: Segments) -> None:
    cell = segments.cell("/map/a.pcd", COLUMNS)
    with pytest.raises(KeyError, match=r"no column 'colour' \(it has xyz, intensity, ring, rgb\)"):
        cell["colour"]
    with pytest.raises(KeyError, match="no column 'colour'"):
        cell.unit("colour")


def test_views_cannot_be_written_nor_made_writeable(segments: Segments) -> None:
    cell = segments.cell("/map/a.pcd", COLUMNS)
    for view in (cell.xyz, cell.xyz[2:4], cell.xyz.reshape(-1), cell["ring"].view(np.uint8), cell.xyz.T):
        assert not view.flags.writeable
        with pytest.raises(ValueError, match="read-only"):
            view[0] = 1
        with pytest.raises(ValueError, match="WRITEABLE"):
            view.flags.writeable = True


def test_a_view_of_a_view_keeps_the_bytes_and_the_last_one_unmaps(segments: Segments) -> None:
    cell = segments.cell("/map/a.pcd", COLUMNS)
    view = cell.xyz[3:].reshape(-1)[::2][1:]
    expected = XYZ[3:].reshape(-1)[::2][1:].copy()
    gone = weakref.ref(cell)
    name = cell.segment
    del cell
    assert gone() is None
    segments.directory.unlink(name)
    assert mappings_under(segments.path) == 1
    np.testing.assert_array_equal(view, expected)
    del view
    assert mappings_under(segments.path) == 0


def test_nothing_of_a_cell_needs_the_garbage_collector(segments: Segments) -> None:
    gc.disable()
    try:
        cell = segments.cell("/map/a.pcd", COLUMNS)
        assert len(cell.columns) == 4
        assert cell.header.rows == 10
        assert mappings_under(segments.path) == 1
        del cell
        assert mappings_under(segments.path) == 0
    finally:
        gc.enable()


def test_verify_finds_a_flipped_bit(segments: Segments) -> None:
    name, handle = segments.publish("/map/a.pcd", COLUMNS)
    cell = segments.attach(name, handle)
    cell.verify()
    path = Path(segments.path, name.lstrip("/"))
    path.chmod(0o600)
    offset = cell.header.columns[2].offset
    with path.open("r+b") as file:
        file.seek(offset + 3)
        byte = file.read(1)[0]
        file.seek(offset + 3)
        file.write(bytes([byte ^ 1]))
    with pytest.raises(SegmentCorrupt, match="'ring'"):
        cell.verify()


def test_a_segment_that_is_gone_is_a_stale_handle(segments: Segments) -> None:
    name, handle = segments.publish("/map/a.pcd", COLUMNS)
    segments.directory.unlink(name)
    with pytest.raises(StaleHandle):
        segments.attach(name, handle)


def test_an_empty_cell(segments: Segments) -> None:
    cell = segments.cell("/map/a.pcd", {"xyz": np.empty((0, 3), np.float32), "i": np.empty(0, np.uint8)})
    assert cell.xyz.shape == (0, 3)
    assert cell["i"].shape == (0,)
    cell.verify()


def test_dlpack_is_the_same_memory_read_only_or_refused(segments: Segments) -> None:
    cell = segments.cell("/map/a.pcd", COLUMNS)
    try:
        alias = np.from_dlpack(cell.xyz)
    except BufferError:  # numpy before 2.1: DLPack could not say "read-only" yet
        return
    assert np.shares_memory(alias, cell.xyz)
    assert not alias.flags.writeable


def test_writing_past_numpy_ends_the_process_and_harms_no_other(segments: Segments) -> None:
    """What the documentation warns of: the mapping itself is read-only."""
    name, handle = segments.publish("/map/a.pcd", COLUMNS)
    program = f"""
import ctypes
from shmmap.segment.attach import attach
view = attach({name!r}, shm_dir={segments.path!r}).column(0)
ctypes.memset(view.ctypes.data, 255, 4)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, check=False)
    assert done.returncode == -11
    segments.attach(name, handle).verify()


def test_the_name_is_the_id_as_the_daemon_shortens_it(segments: Segments) -> None:
    name, handle = segments.publish("0_0.pcd", COLUMNS)
    access = Access(segments.path, 99, None)
    cell = segments.attacher.attach(handle, "/map/pointcloud_map/0_0.pcd", name, access)
    assert (cell.id, cell.name) == ("/map/pointcloud_map/0_0.pcd", "0_0.pcd")
