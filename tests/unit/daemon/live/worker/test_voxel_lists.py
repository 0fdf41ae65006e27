# SPDX-License-Identifier: Apache-2.0
"""Lists of voxels: those of the area and no others, bounded memory, and no name that stays."""

from __future__ import annotations

import errno
import math
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from shmmap.chunks.layout import new_header
from shmmap.chunks.voxels import ChunkKey
from shmmap.daemon.live.worker import voxel_lists
from shmmap.daemon.live.worker.areas import check_area, inside, key_range, touches
from shmmap.daemon.live.worker.voxel_lists import KEPT_S, VOXEL_BYTES, Later, VoxelLists
from shmmap.errors import BadRequest, OverBudget
from shmmap.protocol.areas import BoxMessage
from shmmap.protocol.live import LiveArea, LiveVoxels, LiveVoxelsReply, SphereMessage
from tests.support.live_drive import RESOLUTION
from tests.support.served_map import Served

INF, NAN = float("inf"), float("nan")
VOXELS = 256
KEYS = [ChunkKey(x, 0, 0) for x in range(20)]


def names(shm: Path) -> list[str]:
    return sorted(name for name in os.listdir(shm) if ".voxels." in name)


@pytest.fixture
def served(serve: Callable[..., Served]) -> Served:
    """20 chunks in memory, of 256 occupied voxels each; lists may take a quarter of a million bytes."""
    one = serve(10**6)
    for key in KEYS:
        file = one.live.memory.create(new_header(one.live.identity(key, 1)))
        view = file.grow(1)
        view.bricks[0] = 100
        view.index[0] = 1
        view.state["bricks"] = view.state["version"] = 1
        view.state["active"] = view.state["occupied"] = VOXELS
        one.live.add_chunk(file, 0.0)
    return one


@pytest.fixture
def lists(served: Served) -> VoxelLists:
    return served.map.readers.lists


def collect(
    lists: VoxelLists, keys: list[ChunkKey], session: int = 1, kind: str = "occupied", scope: str = "memory",
    area: LiveArea | None = None,
) -> LiveVoxelsReply:  # fmt: skip
    """Make a list, all steps at once; what a thread is to do is done here."""
    steps = lists.collect(LiveVoxels(1, "lidar", kind, area, scope), iter([keys]), session, 5)
    outcome = None
    while True:
        try:
            step = steps.send(outcome)
        except StopIteration as done:
            reply: LiveVoxelsReply = done.value
            return reply
        outcome = step() if callable(step) else None


@pytest.mark.parametrize(
    "area",
    [
        SphereMessage(NAN, 0, 0, 1), SphereMessage(0, 0, 0, INF), SphereMessage(0, 0, 0, -1),
        SphereMessage(0, 0, 0, 1.4e154), SphereMessage(0, 0, 0, 1.7e308), SphereMessage(0, 0, 0, NAN),
        SphereMessage(1e155, 0, 0, 1), SphereMessage(0, 0, -1.7e308, 1), SphereMessage(-INF, 0, 0, 1),
        BoxMessage(1, 0, 0, 1), BoxMessage(0, 1, 1, 0), BoxMessage(0, 0, INF, 1), BoxMessage(0, NAN, 1, 1),
        BoxMessage(0, 0, 1, 1, 2.0, 1.0), BoxMessage(0, 0, 1, 1, 2.0, None),
        BoxMessage(0, 0, 1, 1, None, 2.0),
        BoxMessage(0, 0, 1, 1, NAN, 2.0),
    ],
)  # fmt: skip
def test_areas_that_make_no_sense(area: LiveArea) -> None:
    with pytest.raises(BadRequest, match="area"):
        check_area(area)


@pytest.mark.parametrize("resolution", [1e-4, 0.2, 1e3])
@pytest.mark.parametrize(
    "area",
    [
        BoxMessage(-1.7e308, -1.7e308, 1.7e308, 1.7e308), BoxMessage(0, 0, 1, 1, -1.7e308, 1.7e308),
        SphereMessage(0, 0, 0, 9e149), SphereMessage(9e149, -9e149, 9e149, 9e149),
        SphereMessage(5e-324, 0, 0, 5e-324),
    ],
)  # fmt: skip
def test_the_largest_areas_that_make_sense(area: LiveArea, resolution: float) -> None:
    """Whatever their numbers come to, squared or divided by a small voxel."""
    check_area(area)
    low, high = key_range(area, resolution)
    assert all(a < b for a, b in zip(low, high, strict=True))
    with np.errstate(all="raise", under="ignore"):
        touches(area, ChunkKey(3, -1, 0), resolution)
        inside(area, np.array([[1.0, 2.0, 3.0]]))


AREAS: list[LiveArea] = [
    SphereMessage(0, 0, 0, 0), SphereMessage(-3.0, 20.0, 1.0, 14.0), SphereMessage(1e6, 0, 0, 10.0),
    BoxMessage(-1.0, -1.0, 1.0, 1.0), BoxMessage(-30.0, 3.0, 14.0, 3.2), BoxMessage(0, 0, 5, 5, -2.0, 2.0),
    BoxMessage(0, 0, 5, 5, 13.0, 40.0),
]  # fmt: skip


@pytest.mark.parametrize("area", AREAS)
def test_a_chunk_is_looked_into_if_any_of_its_voxels_lies_in_the_area(area: LiveArea) -> None:
    check_area(area)
    steps = (np.arange(64) + 0.5) * RESOLUTION
    centres = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), -1).reshape(-1, 3)
    for x in range(-3, 4):
        for y in range(-3, 4):
            for z in (-1, 0, 1):
                key = ChunkKey(x, y, z)
                if inside(area, centres + key.box(RESOLUTION)[:3]).any():
                    assert touches(area, key, RESOLUTION), key
                    low_key, high_key = key_range(area, RESOLUTION)
                    assert all(a <= b <= c for a, b, c in zip(low_key, key, high_key, strict=True)), key
    far = ChunkKey(1000, -1000, 0)
    assert not touches(area, far, RESOLUTION)
    assert touches(None, far, RESOLUTION)


def test_a_list_says_which_voxels_there_are(served: Served, lists: VoxelLists, shm: Path) -> None:
    area = BoxMessage(0.0, 0.0, 0.45, 10.0)  # two voxels along x
    reply = collect(lists, KEYS[:2], area=area)
    assert (reply.request, reply.change, reply.count) == (1, 5, 2 * 8 * 4)
    data = (shm / reply.segment[1:]).read_bytes()
    assert len(data) == reply.bytes == VOXEL_BYTES * reply.count
    indices = np.frombuffer(data, "<i4", 3 * reply.count).reshape(-1, 3)
    assert set(indices[:, 0].tolist()) == {0, 1}
    assert (np.frombuffer(data, "<i2", reply.count, 12 * reply.count) == 100).all()
    assert (shm / reply.segment[1:]).stat().st_mode & 0o777 == 0o600
    assert collect(lists, KEYS, kind="free").count == 0
    assert collect(lists, [ChunkKey(9, 9, 9)]).count == 0


def test_more_than_fits_is_refused_and_what_was_made_is_forgotten(lists: VoxelLists, shm: Path) -> None:
    most = 10**6 // voxel_lists.PART_OF_BUDGET // VOXEL_BYTES // VOXELS  # chunks
    many = [KEYS[0]] * (most + 1)
    with pytest.raises(OverBudget, match="all lists together may take 250000 bytes"):
        collect(lists, many)
    assert (lists.nbytes, names(shm)) == (0, [])
    collect(lists, many[:20])
    with pytest.raises(OverBudget):
        collect(lists, many[1:], session=2)


def test_lists_that_are_being_made_count_as_well(lists: VoxelLists) -> None:
    """Else a reader that asks for many at a time has as much memory taken as it likes."""
    message = LiveVoxels(1, "lidar")
    works = [lists.collect(message, iter([[KEYS[0]] * 40]), session, 0) for session in (1, 2)]

    def go_on() -> None:
        while True:
            for work in works:
                assert next(work) is None

    with pytest.raises(OverBudget):
        go_on()
    for work in works:
        work.close()
    collect(lists, [KEYS[0]] * 60)


def test_a_list_waits_until_chunks_have_made_room(served: Served, lists: VoxelLists) -> None:
    """And takes no byte before: it is within the budget as they are."""
    residency = served.live.residency
    residency.beside_bytes = residency.limits.budget_bytes - residency.chunk_bytes
    steps = lists.collect(LiveVoxels(1, "lidar"), iter([KEYS[:1]]), 1, 0)
    while not isinstance(next(steps), Later):
        pass
    assert (lists.asked_bytes, lists.nbytes) == (4096, 0)
    residency.beside_bytes -= 4096
    with pytest.raises(StopIteration):
        next(steps)
    assert (lists.asked_bytes, lists.nbytes) == (0, 4096)
    assert residency.beside_bytes + residency.chunk_bytes == residency.limits.budget_bytes
    lists.on_disconnect(1)
    assert residency.beside_bytes + residency.chunk_bytes == residency.limits.budget_bytes - 4096


@pytest.mark.parametrize("how", ["released", "expired", "left"])
def test_a_list_is_cut_when_it_was_read_or_was_there_for_long(lists: VoxelLists, shm: Path, how: str) -> None:
    """Whatever its reader has open: else it could keep as much memory as it likes."""
    reply = collect(lists, KEYS)
    with (shm / reply.segment[1:]).open("rb") as file:
        assert os.fstat(file.fileno()).st_blocks * 512 == lists.nbytes > reply.bytes
        begun_s = time.monotonic()
        lists.expire(begun_s)
        assert begun_s < lists.next_expiry_s <= time.monotonic() + KEPT_S
        if how == "released":
            lists.release(1, reply.segment)
        elif how == "expired":
            lists.expire(time.monotonic() + KEPT_S)
        else:
            lists.on_disconnect(1)
        assert os.fstat(file.fileno()).st_blocks == 0
        assert file.read() == b""
    assert (lists.nbytes, lists.live.residency.beside_bytes, names(shm)) == (0, 0, [])
    assert lists.next_expiry_s == math.inf


def test_a_session_s_oldest_lists_are_removed(lists: VoxelLists, shm: Path) -> None:
    made = [collect(lists, KEYS[:1]).segment[1:] for _ in range(voxel_lists.LISTS_PER_SESSION + 2)]
    other = collect(lists, KEYS[:1], session=2).segment
    assert names(shm) == sorted([*made[2:], other[1:]])
    lists.release(1, other)
    lists.release(1, "/nothing")
    assert other[1:] in names(shm), "it is not that session's"
    lists.release(1, "/" + made[3])
    assert made[3] not in names(shm)
    lists.on_disconnect(1)
    assert names(shm) == [other[1:]]
    lists.on_disconnect(2)
    assert (lists.nbytes, names(shm)) == (0, [])


def test_where_there_is_no_memory_no_name_stays(
    monkeypatch: pytest.MonkeyPatch, lists: VoxelLists, shm: Path
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(os, "fchmod", full)
        with pytest.raises(OSError, match="No space"):
            collect(lists, KEYS)
    assert (lists.nbytes, names(shm)) == (0, [])


def test_lists_of_an_previous_run_are_removed(lists: VoxelLists, shm: Path) -> None:
    name = collect(lists, KEYS[:1]).segment[1:]
    other = name.replace(".lidar.", ".radar.")
    (shm / other).touch()
    VoxelLists(lists.live).remove_all()
    assert names(shm) == [other]
    (shm / other).unlink()


@pytest.mark.parametrize("scope", ["disk", "all"])
def test_the_disk_is_read_in_threads(served: Served, lists: VoxelLists, scope: str) -> None:
    """Some files at a time, and never by the worker itself."""
    served.until(lambda: served.map.is_saved, save_all=True)
    if scope == "all":
        for key in KEYS[5:]:
            del served.live.residency.chunks[key]
            served.live.memory.give_up(served.live.chunks.pop(key))
    load, where = served.live.files.load, []
    served.live.files.load = lambda key: where.append(threading.get_ident()) or load(key)  # type: ignore[method-assign, func-returns-value]
    ticket = served.ask(lambda n: LiveVoxels(n, "lidar", scope=scope))
    reply = served.answer(ticket)
    assert reply.count == VOXELS * len(KEYS)
    assert len(where) == len(KEYS[5:] if scope == "all" else KEYS)
    assert threading.get_ident() not in where


def test_a_file_that_cannot_be_read_is_an_error_of_the_one_request(served: Served) -> None:
    served.until(lambda: served.map.is_saved, save_all=True)

    def broken(_key: ChunkKey) -> bytes:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    served.live.files.load = broken  # type: ignore[method-assign, assignment]
    failed = served.answer(served.ask(lambda n: LiveVoxels(n, "lidar", scope="disk")))
    assert (failed.code, "Input/output error" in failed.message) == ("bad_map_data", True)
    assert served.answer(served.ask(lambda n: LiveVoxels(n, "lidar"))).count == VOXELS * len(KEYS)
