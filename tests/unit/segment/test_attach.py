# SPDX-License-Identifier: Apache-2.0
"""Attaching: right bytes, read-only, for exactly as long as any view exists."""

from __future__ import annotations

import errno
import fcntl
import gc
import os
import resource
import subprocess
import sys
from functools import partial
from pathlib import Path
from queue import SimpleQueue

import numpy as np
import pytest

from shmmap.errors import SegmentCorrupt, SegmentError, StaleHandle
from shmmap.segment import attach as attach_module
from shmmap.segment.attach import Owned, attach
from shmmap.segment.directory import ShmDirectory
from shmmap.segment.header import PublishBlock
from shmmap.segment.names import DEFAULT_SHM_DIR
from shmmap.segment.pins import prepare_process
from tests.support.process_costs import mappings_under
from tests.support.segment_reader import read_segment
from tests.unit.segment.conftest import Publish


def test_the_same_as_an_independent_reader(shm: ShmDirectory, publish: Publish) -> None:
    name = publish(1000)
    segment = attach(name, shm_dir=shm.path, slot=5)
    expected = read_segment(f"{shm.path}{name}")
    assert [column[0] for column in segment.columns] == list(expected.columns)
    for index, column in enumerate(expected.columns.values()):
        view = segment.column(index)
        assert view.dtype == column.dtype
        assert np.array_equal(view, column)
        assert view.flags.c_contiguous
        assert view.ctypes.data % 64 == 0
    assert segment.header.cell_id == expected.fields["cell_id"]
    assert segment.header.box == expected.fields["box"]
    assert segment.published == PublishBlock(7, 8)
    segment.verify()


def test_views_cannot_be_written_nor_made_writable(shm: ShmDirectory, publish: Publish) -> None:
    view = attach(publish(), shm_dir=shm.path).column(0)
    with pytest.raises(ValueError, match="read-only"):
        view[0] = 1
    with pytest.raises(ValueError, match="WRITEABLE"):
        view.flags.writeable = True
    with pytest.raises(ValueError, match="WRITEABLE"):
        view.reshape(-1)[5:9].flags.writeable = True


@pytest.mark.parametrize("kind", ["column", "slice", "reshaped", "raw", "memoryview"])
def test_the_mapping_lasts_as_long_as_any_view(shm: ShmDirectory, publish: Publish, kind: str) -> None:
    """Also when the name is gone, and the segment object."""
    name = publish(5000)
    sink: SimpleQueue[Owned | None] = SimpleQueue()
    segment = attach(name, shm_dir=shm.path, sinks=[sink])
    xyz = segment.column(0)
    expected = xyz.copy()
    view: object = {
        "column": xyz,
        "slice": xyz[100:200, 1],
        "reshaped": xyz.reshape(-1)[::7],
        "raw": segment.raw,
        "memoryview": memoryview(xyz),  # type: ignore[arg-type]
    }[kind]
    shm.unlink(name)
    del segment, xyz
    gc.collect()
    assert sink.empty()
    assert mappings_under(name) == 1
    if kind == "column":
        assert np.array_equal(view, expected)  # type: ignore[arg-type]
    del view
    gc.collect()
    assert sink.qsize() == 1
    sink.get_nowait()
    assert mappings_under(name) == 0


def test_no_descriptor_is_kept(shm: ShmDirectory, publish: Publish) -> None:
    name = publish()
    before = os.listdir("/proc/self/fd")
    held = [attach(name, shm_dir=shm.path, slot=i) for i in range(50)]
    assert os.listdir("/proc/self/fd") == before
    held.clear()


def test_gone(shm: ShmDirectory) -> None:
    with pytest.raises(StaleHandle):
        attach("/shmmap.unit.0000", shm_dir=shm.path)
    with pytest.raises(StaleHandle):
        attach("/shmmap.unit.unused-name")  # plain POSIX shared memory


def test_what_is_no_segment(shm: ShmDirectory, publish: Publish) -> None:
    whole = Path(f"{shm.path}{publish(100)}").read_bytes()
    for content in (b"", b"x", bytes(4096), whole[:100], whole[:4096], os.urandom(5000)):
        Path(shm.path, "bad").write_bytes(content)
        with pytest.raises(SegmentCorrupt):
            attach("/bad", shm_dir=shm.path)
    Path(shm.path, "bad").write_bytes(whole)
    with pytest.raises(SegmentCorrupt):
        attach("/bad", shm_dir=shm.path, nbytes=len(whole) + 1)
    with pytest.raises(SegmentCorrupt):
        attach("/bad", shm_dir=shm.path, offset=4096)
    os.unlink(f"{shm.path}/bad")
    gc.collect()  # a refusal's traceback may be part of a cycle
    assert mappings_under(f"{shm.path}/bad") == 0


def test_other_things_of_that_name(shm: ShmDirectory, publish: Publish) -> None:
    os.mkdir(f"{shm.path}/folder")
    os.symlink(f"{shm.path}{publish()}", f"{shm.path}/link")
    for name in ("/folder", "/link"):
        with pytest.raises(SegmentError):
            attach(name, shm_dir=shm.path)
    os.rmdir(f"{shm.path}/folder")
    os.unlink(f"{shm.path}/link")


@pytest.mark.root
def test_no_permission(shm: ShmDirectory, publish: Publish) -> None:
    name = publish()
    os.chmod(shm.path, 0o755)
    os.seteuid(65534)
    try:
        with pytest.raises(SegmentError, match="may not read") as refusal:
            attach(name, shm_dir=shm.path)
    finally:
        os.seteuid(0)
    assert not isinstance(refusal.value, StaleHandle)


def test_no_room_for_a_mapping(shm: ShmDirectory, publish: Publish) -> None:
    """In a process of its own: the address space is limited below what the segment needs."""
    name = publish(400_000)
    code = (
        "import resource, sys\n"
        "from shmmap.segment.attach import attach\n"
        "from shmmap.errors import SegmentError\n"
        "used = int(open('/proc/self/statm').read().split()[0]) * 4096\n"
        "resource.setrlimit(resource.RLIMIT_AS, (used + (2 << 20), -1))\n"
        "try:\n    attach(sys.argv[2], shm_dir=sys.argv[1])\n"
        "except SegmentError as error:\n    print(error.hint)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, shm.path, name], capture_output=True, text=True, check=True
    )
    assert "ulimit -v" in done.stdout


def test_populated_pages_are_there_at_once(shm: ShmDirectory, publish: Publish) -> None:
    name = publish(200_000)
    faults = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    segment = attach(name, shm_dir=shm.path, populate=True)
    after_attach = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    pages = len(segment.raw) // 4096
    assert int(segment.raw[::4096].sum()) >= 0
    after_reading = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    assert after_reading - after_attach < pages / 4
    assert after_attach >= faults


@pytest.mark.parametrize("usual", [True, False])
def test_a_name_that_something_else_has_by_now(shm: ShmDirectory, usual: bool) -> None:
    """Without O_NONBLOCK, opening a pipe would block."""
    directory = DEFAULT_SHM_DIR if usual else shm.path
    path = f"{directory}/unit-{os.getpid()}.pipe"
    os.mkfifo(path)
    try:
        with pytest.raises(StaleHandle):
            attach(f"/unit-{os.getpid()}.pipe", shm_dir=directory)
    finally:
        os.unlink(path)


def test_a_lease_that_is_not_given_back(
    shm: ShmDirectory, publish: Publish, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The daemon was stopped in the middle of a look: the client gets an error at once, and may ask again."""
    prepare_process()  # the kernel asks a lease back by a signal
    name = publish()
    fd = shm.open(name)
    try:
        fcntl.fcntl(fd, fcntl.F_SETLEASE, fcntl.F_WRLCK)
        monkeypatch.setattr(attach_module, "LEASE_S", 0.01)
        with pytest.raises(StaleHandle, match="lease"):
            attach(name, shm_dir=shm.path)
    finally:
        os.close(fd)


def test_what_the_header_claims_must_lie_behind_the_offset(shm: ShmDirectory, publish: Publish) -> None:
    """A segment that begins in the middle of an object ends, at the latest, where the object does."""
    data = Path(shm.path, publish(1000).lstrip("/")).read_bytes()
    path = Path(shm.path, "two")
    path.write_bytes(bytes(4096) + data)
    whole = attach("/two", offset=4096, nbytes=len(data), shm_dir=shm.path)
    assert np.array_equal(whole.column(0), attach(publish(1000), shm_dir=shm.path).column(0))
    path.write_bytes(bytes(4096) + data[:-4096])
    assert path.stat().st_size == len(data), "total_bytes is not more than the object has"
    for nbytes in (0, len(data) - 4096):
        with pytest.raises(SegmentCorrupt):
            attach("/two", offset=4096, nbytes=nbytes, shm_dir=shm.path)
    path.unlink()


def test_without_a_lock_it_is_just_as_safe(
    shm: ShmDirectory, publish: Publish, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(fd: int, slot: int) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(attach_module, "lock_slot", refuse)
    assert len(attach(publish(), shm_dir=shm.path, slot=5).columns) == 2


@pytest.mark.parametrize("needs_less", [False, True])
@pytest.mark.parametrize("how", ["end", "give_back", "del"])
def test_what_is_owned_is_given_back_once(how: str, needs_less: bool) -> None:
    """By its end, or by `Owned.end` although another thread still refers to it."""
    gone: list[int] = []
    memory = Owned(zip([7]), gone.append)
    assert (memory.value, gone) == (7, [])
    if needs_less and how != "give_back":
        memory.keep(partial(gone.append, 7))
    elsewhere = memory if how == "end" else None
    if how == "end":
        memory.end()
        assert gone == [7]
        memory.end()
    elif how == "give_back":
        memory.give_back()
    del memory, elsewhere
    assert gone == [7]
