# SPDX-License-Identifier: Apache-2.0
"""Lists of voxels: those of the area and no others, bounded memory, and no name that stays."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from shmmap.chunks.layout import new_header
from shmmap.chunks.voxels import ChunkKey
from shmmap.daemon.live.worker import voxel_lists
from shmmap.daemon.live.worker.voxel_lists import VOXEL_BYTES, VoxelLists, check_area, inside, touches
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
        one.live.take_over(file, 0.0)
    return one


@pytest.fixture
def lists(served: Served) -> VoxelLists:
    return served.map.readers.lists


def collect(
    lists: VoxelLists, keys: list[ChunkKey], session: int = 1, kind: str = "occupied", scope: str = "memory",
    area: LiveArea | None = None,
) -> LiveVoxelsReply:  # fmt: skip
    """Make a list, all steps at once."""
    work: Iterator[LiveVoxelsReply | None] = lists.collect(
        LiveVoxels(1, "lidar", kind, area, scope), keys, session, 5
    )
    (reply,) = [reply for reply in work if reply is not None]
    return reply


@pytest.mark.parametrize(
    "area",
    [
        SphereMessage(NAN, 0, 0, 1), SphereMessage(0, 0, 0, INF), SphereMessage(0, 0, 0, -1),
        BoxMessage(1, 0, 0, 1), BoxMessage(0, 1, 1, 0), BoxMessage(0, 0, INF, 1), BoxMessage(0, NAN, 1, 1),
        BoxMessage(0, 0, 1, 1, 2.0, 1.0), BoxMessage(0, 0, 1, 1, 2.0, None),
        BoxMessage(0, 0, 1, 1, None, 2.0),
        BoxMessage(0, 0, 1, 1, NAN, 2.0),
    ],
)  # fmt: skip
def test_areas_that_make_no_sense(area: LiveArea) -> None:
    with pytest.raises(BadRequest, match="area"):
        check_area(area)


AREAS: list[LiveArea] = [
    SphereMessage(0, 0, 0, 0), SphereMessage(-3.0, 20.0, 1.0, 14.0), SphereMessage(1e6, 0, 0, 10.0),
    BoxMessage(-1.0, -1.0, 1.0, 1.0), BoxMessage(-30.0, 3.0, 14.0, 3.2), BoxMessage(0, 0, 5, 5, -2.0, 2.0),
    BoxMessage(0, 0, 5, 5, 13.0, 40.0),
]  # fmt: skip


@pytest.mark.parametrize("area", AREAS)
def test_a_chunk_is_looked_into_if_any_of_its_voxels_lies_in_the_area(area: LiveArea) -> None:
    check_area(area)
    for x in range(-3, 4):
        for y in range(-3, 4):
            for z in (-1, 0, 1):
                key = ChunkKey(x, y, z)
                steps = (np.arange(64) + 0.5) * RESOLUTION
                low = np.array(key.box(RESOLUTION)[:3])
                grid = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), -1).reshape(-1, 3) + low
                if inside(area, grid).any():
                    assert touches(area, key, RESOLUTION), key
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
    """Else a reader who asks for many at a time has as much memory taken as it likes."""
    message = LiveVoxels(1, "lidar")
    half = [KEYS[0]] * 40
    works = [lists.collect(message, half, session, 0) for session in (1, 2)]
    for work in works:
        for _ in range(4):
            assert next(work) is None
    assert lists.nbytes > 2 * 20 * VOXELS * VOXEL_BYTES

    def go_on() -> None:
        while True:
            for work in works:
                next(work)

    with pytest.raises(OverBudget):
        go_on()
    for work in works:
        work.close()  # type: ignore[attr-defined]
    assert lists.nbytes == 0


def test_a_session_s_oldest_lists_give_way(lists: VoxelLists, shm: Path) -> None:
    made = [collect(lists, KEYS[:1]).segment[1:] for _ in range(voxel_lists.LISTS_OF_A_SESSION + 2)]
    other = collect(lists, KEYS[:1], session=2).segment
    assert names(shm) == sorted([*made[2:], other[1:]])
    lists.release(1, other)
    lists.release(1, "/nothing")
    assert other[1:] in names(shm), "it is not that session's"
    lists.release(1, "/" + made[3])
    assert made[3] not in names(shm)
    lists.left(1)
    assert names(shm) == [other[1:]]
    lists.left(2)
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


def test_lists_of_an_earlier_life_are_removed(lists: VoxelLists, shm: Path) -> None:
    name = collect(lists, KEYS[:1]).segment[1:]
    other = name.replace(".lidar.", ".radar.")
    (shm / other).touch()
    VoxelLists(lists.live, str(shm), 0o600, -1).remove_all()
    assert names(shm) == [other]
    (shm / other).unlink()


def test_the_disk_is_asked_one_chunk_a_step(served: Served, lists: VoxelLists) -> None:
    """Between two, mappers have their turn."""
    served.until(lambda: served.map.is_saved, save_all=True)
    message = LiveVoxels(1, "lidar", scope="disk")
    steps = list(lists.collect(message, KEYS, 1, 0))
    assert steps[:-1] == [None] * len(KEYS)
    assert steps[-1] is not None
    assert steps[-1].count == VOXELS * len(KEYS)
