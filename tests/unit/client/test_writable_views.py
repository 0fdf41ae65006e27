# SPDX-License-Identifier: Apache-2.0
"""Views for libraries that know no read-only memory: read without a copy, written without harm to others."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from numpy.typing import NDArray

from shmmap.client.cell import Cell
from shmmap.errors import LimitReached
from shmmap.segment.attach import attach, attach_writable
from shmmap.segment.names import retired_name
from shmmap.segment.pins import in_use, prepare_process
from tests.support.process_costs import mappings_under
from tests.support.skips import open3d_or_skip

if TYPE_CHECKING:
    from tests.unit.client.conftest import Segments

XYZ = np.arange(30_000, dtype=np.float32).reshape(10_000, 3)
COLUMNS: dict[str, NDArray[Any]] = {
    "xyz": XYZ,
    "intensity": np.linspace(0, 1, len(XYZ), dtype=np.float32),
    "ring": (np.arange(len(XYZ)) % 64).astype(np.uint16),
    "rgb": np.arange(3 * len(XYZ), dtype=np.uint8).reshape(-1, 3),
}


def segment_file(segments: Segments, cell: Cell) -> Path:
    return Path(segments.path, cell.segment.lstrip("/"))


def writable(cell: Cell) -> NDArray[Any]:
    return cell._writable()["xyz"]  # what the wrappers hand on; they need packages that may be missing


def private_kib(path: str) -> int:
    """Memory that this process has written to in mappings below a directory."""
    total, inside = 0, False
    for line in Path("/proc/self/smaps").read_text().splitlines():
        if not line.split(maxsplit=1)[0].endswith(":"):
            inside = path in line
        elif inside and line.startswith("Anonymous:"):
            total += int(line.split()[1])
    return total


def test_a_write_is_a_page_of_this_process_and_no_other_sees_it(segments: Segments) -> None:
    cell = segments.cell("/map/a.pcd", COLUMNS)
    before = segment_file(segments, cell).read_bytes()
    view, other = writable(cell), writable(cell)
    assert mappings_under(segments.path) == 3
    assert np.array_equal(view, XYZ)
    assert private_kib(segments.path) == 0, "reading copies nothing"
    view[0] = -1.0
    assert private_kib(segments.path) * 1024 == os.sysconf("SC_PAGE_SIZE")
    view += 5.0
    np.testing.assert_array_equal(view[1:], XYZ[1:] + 5.0)
    for same in (cell.xyz, other, writable(cell)):
        np.testing.assert_array_equal(same, XYZ)
    assert segment_file(segments, cell).read_bytes() == before
    cell.verify()
    with pytest.raises(ValueError, match="read-only"):
        cell.xyz[0] = 1


def test_views_outlive_the_cell_and_the_segment_stays_in_use(segments: Segments) -> None:
    prepare_process()
    cell = segments.cell("/map/a.pcd", COLUMNS)
    path = segment_file(segments, cell)
    view = writable(cell)
    view[3] = 9.0
    del cell
    fd = os.open(path, os.O_RDONLY)
    assert in_use(fd)
    assert segments.attacher.unmapped() == []
    np.testing.assert_array_equal(view[4:], XYZ[4:])
    del view
    assert mappings_under(segments.path) == 0
    assert not in_use(fd)
    assert segments.attacher.unmapped() == [1]
    os.close(fd)


def test_the_cell_may_be_retired_or_gone(segments: Segments) -> None:
    cell = segments.cell("/map/a.pcd", COLUMNS)
    path = segment_file(segments, cell)
    path.rename(retired_name(str(path)))
    retired = writable(cell)
    assert mappings_under(segments.path) == 2
    os.unlink(retired_name(str(path)))
    gone = writable(cell)
    assert mappings_under(segments.path) == 2, "a copy"
    for view in (retired, gone):
        view += 1.0
        np.testing.assert_array_equal(view, XYZ + 1.0)
    np.testing.assert_array_equal(cell.xyz, XYZ)


def test_another_file_of_that_name_is_not_mapped(segments: Segments) -> None:
    cell = segments.cell("/map/a.pcd", COLUMNS)
    path = segment_file(segments, cell)
    nbytes = path.stat().st_size
    path.unlink()
    for foreign in (b"", b"x" * nbytes):
        path.write_bytes(foreign)
        np.testing.assert_array_equal(writable(cell), XYZ)
        path.unlink()
    os.mkfifo(path)  # nor does it wait there
    np.testing.assert_array_equal(writable(cell), XYZ)


def test_one_of_many_in_one_object(segments: Segments) -> None:
    name, _ = segments.publish("/map/a.pcd", COLUMNS)
    one = Path(segments.path, name.lstrip("/")).read_bytes()
    one += bytes(-len(one) % 4096)
    Path(segments.path, "slab").write_bytes(bytes(3 * 4096) + one + one)
    segment = attach("/slab", shm_dir=segments.path, offset=3 * 4096, nbytes=len(one))
    private = attach_writable(segment, "/slab", shm_dir=segments.path, offset=3 * 4096)
    private.column(0)[:] = 0
    assert segment.raw.tobytes() == one
    np.testing.assert_array_equal(segment.column(0), XYZ)


def test_an_empty_cell(segments: Segments) -> None:
    cell = segments.cell("/map/a.pcd", {"xyz": np.empty((0, 3), np.float32)})
    assert writable(cell).shape == (0, 3)


def test_after_a_fork_each_process_has_what_it_wrote(segments: Segments) -> None:
    cell = segments.cell("/map/a.pcd", COLUMNS)
    view = writable(cell)
    view[0] = 1.0
    pid = os.fork()
    if pid == 0:
        view[0] = 2.0
        view[5000] = 2.0
        os._exit(0 if view[0, 0] == 2.0 and np.array_equal(cell.xyz, XYZ) else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0
    assert view[0, 0] == 1.0
    np.testing.assert_array_equal(view[1:], XYZ[1:])


def test_without_room_for_data_it_is_a_copy_or_refused_by_the_limits_name(segments: Segments) -> None:
    cell = segments.cell("/map/a.pcd", COLUMNS)
    before = resource.getrlimit(resource.RLIMIT_DATA)
    resource.setrlimit(resource.RLIMIT_DATA, (1 << 20, before[1]))  # below what the process has already
    try:
        view = None
        refusal = ""
        try:
            view = writable(cell)  # by memory that was freed before
        except LimitReached as error:
            refusal = str(error)
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, before)
    if view is None:
        assert "1 MiB of data (RLIMIT_DATA)" in refusal
    else:
        assert mappings_under(segments.path) == 1, "the kernel refuses a mapping"
        np.testing.assert_array_equal(view, XYZ)
    np.testing.assert_array_equal(cell.xyz, XYZ)


def test_without_descriptors_it_is_a_copy(segments: Segments) -> None:
    cell = segments.cell("/map/a.pcd", COLUMNS)
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (3, before[1]))
    try:
        view = writable(cell)
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)
    view += 1.0
    np.testing.assert_array_equal(cell.xyz, XYZ)


WRITERS: dict[str, Callable[[Any], str]] = {
    "open3d": lambda number: (
        f"cell.to_open3d().translate([{number}, 0, 0]).scale(2.0, [0, 0, 0]); "
        "cell.to_open3d().point['intensity'][:] = 7"
    ),
    "torch": lambda number: f"t = cell.to_torch(); t['xyz'] += {number}; t['rgb'].zero_()",
    "ctypes": lambda number: (
        f"view = cell._writable()['xyz']; ctypes.memset(view.ctypes.data, {number}, view.nbytes)"
    ),
}


@pytest.mark.parametrize("library", WRITERS)
def test_a_process_that_writes_ends_by_itself_and_no_other_sees_it(segments: Segments, library: str) -> None:
    """With ten writes; ``tests/benchmarks/writable_views.py`` has eight processes with a hundred each."""
    if library == "open3d":
        open3d_or_skip()
    elif library == "torch":
        pytest.importorskip("torch", reason="torch is not installed")
    name, handle = segments.publish("/map/a.pcd", COLUMNS)
    program = f"""
import ctypes
from shmmap.client.attaching import Attacher
from shmmap.client.cell import Access
from shmmap.protocol.messages import Handle
handle = Handle("/map/a.pcd", 1, "points", {name!r}, 0, {handle.bytes}, {handle.points}, 0.0, 0.0, 20.0, 20.0)
cell = Attacher().attach(handle, handle.id, {name!r}, Access({segments.path!r}, 5, None))
for _ in range(10):
    {WRITERS[library](3)}
    cell.verify()
"""
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0
    segments.attach(name, handle).verify()


def test_open3d_reads_the_same_memory(segments: Segments) -> None:
    o3d = open3d_or_skip()
    cell = segments.cell("/map/a.pcd", COLUMNS)
    cloud = cell.to_open3d()
    assert isinstance(cloud, o3d.t.geometry.PointCloud)
    positions = cloud.point["positions"].numpy()
    np.testing.assert_array_equal(positions, XYZ)
    assert cloud.point["ring"].numpy().shape == (len(XYZ), 1)
    assert cloud.get_max_bound().numpy().tolist() == XYZ.max(axis=0).tolist()
    assert private_kib(segments.path) == 0, "nothing is copied"
    del cell, positions
    assert mappings_under(segments.path) == 2, "the tensors keep the mapping"
    np.testing.assert_array_equal(cloud.point["positions"].numpy(), XYZ)
    cloud.translate([1, 0, 0])
    np.testing.assert_array_equal(cloud.point["positions"].numpy()[:, 0], XYZ[:, 0] + 1)
    del cloud
    assert mappings_under(segments.path) == 0


def test_torch_reads_the_same_memory(segments: Segments) -> None:
    torch = pytest.importorskip("torch", reason="torch is not installed")
    cell = segments.cell("/map/a.pcd", COLUMNS)
    tensors = cell.to_torch()
    for name, values in COLUMNS.items():
        assert tensors[name].numpy().dtype == values.dtype
        np.testing.assert_array_equal(tensors[name].numpy(), values)
    assert private_kib(segments.path) == 0, "nothing is copied"
    del cell
    assert mappings_under(segments.path) == 2, "the tensors keep the mapping"
    tensors["xyz"].add_(1.0)
    assert torch.equal(tensors["xyz"], torch.tensor(XYZ + 1.0))
