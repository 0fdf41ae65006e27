# SPDX-License-Identifier: Apache-2.0
"""The byte budget: never exceeded, judged from outside; who fills it is named; no client starves."""

from __future__ import annotations

import mmap
import os
import random
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tests.process.conftest import DaemonFactory
from tests.support.daemon_process import Deadline, first_answer
from tests.support.divided_map import DividedMap, make_map, random_points
from tests.support.mapping_process import MappingProcess
from tests.support.process_costs import MemoryWatch
from tests.support.raw_client import RawCells, RawClient, RawHandle, circle
from tests.support.segment_reader import assert_same_points, map_segment, names

Connect = Callable[..., RawClient]
CELL_BYTES = 72 << 10  # 4200 points of 16 bytes, header, whole pages
STATISTICS_BYTES = 256 << 10  # room for the statistics segment, which counts too


@pytest.fixture
def heavy_map(tmp_path: Path) -> DividedMap:
    """Return a map of 8 x 8 cells of 72 kB each in shared memory."""
    return make_map(tmp_path / "heavy", columns=8, rows=8, points=4200)


class Holder:
    """A client that maps what it is handed, with the session's lock, and can drop it."""

    def __init__(self, client: RawClient) -> None:
        self.client = client
        self.mapped: dict[int, mmap.mmap] = {}
        self.version_of: dict[str, int] = {}

    def take(self, reply: RawCells) -> None:
        """Drop what the reply removes, then map what it brings."""
        for version in reply.removed_versions:
            self.drop(version)
        for handle in reply.cells:
            self.map(handle)

    def map(self, handle: RawHandle) -> None:
        """Map one cell; an older version of it is dropped."""
        try:
            mapping = map_segment(self.client.path(handle), self.client.session)
        except FileNotFoundError:
            return  # gone since: ask again
        old = self.version_of.get(handle.id)
        if old is not None and old != handle.version:
            self.drop(old)
        self.mapped[handle.version] = mapping
        self.version_of[handle.id] = handle.version

    def drop(self, version: int) -> None:
        """Unmap a version."""
        mapping = self.mapped.pop(version, None)
        if mapping is not None:
            mapping.close()
        self.version_of = {i: v for i, v in self.version_of.items() if v != version}

    def drop_all(self) -> None:
        """Unmap everything and say so."""
        for version in list(self.mapped):
            self.drop(version)
        self.client.release()


@pytest.mark.root
def test_never_exceeded_while_clients_wander(
    daemon: DaemonFactory, connect: Connect, heavy_map: DividedMap, private_tmpfs: Callable[[str], str]
) -> None:
    """Three clients wander over a map several times the budget; another process watches the file system."""
    directory = private_tmpfs("64m")
    budget = 24 * CELL_BYTES + STATISTICS_BYTES
    one = daemon(heavy_map.root, "--budget", str(budget), shm_dir=directory)
    rng = random.Random(7)
    with MemoryWatch(directory, one.pid) as watch:
        holders = [Holder(connect(one)) for _ in range(3)]
        for step in range(40):
            holder = holders[step % 3]
            x, y = rng.uniform(-80, 80), rng.uniform(-80, 80)
            reply = holder.client.differential(
                circle(x, y, 8), packed=list(holder.mapped), wait=10.0, intent=[x, y]
            )
            assert reply.failed == []
            assert reply.pending == []
            wanted = set(heavy_map.in_circle(x, y, 8))
            holder.take(reply)
            assert {i.rsplit("/", 1)[1] for i in holder.version_of} <= wanted
        evictions = holders[0].client.ask("stats")[4]["evictions"]
        for holder in holders:
            holder.drop_all()
    assert one.log.count("cells evicted") >= min(evictions, 1)
    assert one.log.count("evicted cell=") == 0, "single evictions are logged only for debugging"
    assert 0 < watch.peak_bytes <= budget
    assert 0 < watch.peak_descriptors < 64  # of the daemon and of any loader, however many cells come and go
    assert evictions > 0 or watch.peak_bytes < budget
    assert one.stop() == 0
    assert os.listdir(directory) == []


def test_a_full_budget_names_who_fills_it(
    daemon: DaemonFactory, connect: Connect, heavy_map: DividedMap
) -> None:
    budget = 16 * CELL_BYTES + STATISTICS_BYTES
    one = daemon(heavy_map.root, "--budget", str(budget), "--session-quota", "1")
    holder = Holder(connect(one, name="the holder"))
    other = connect(one, name="another")
    ids = sorted(map(heavy_map.id, heavy_map.corners))
    holder.take(holder.client.selected(ids[:10]))
    assert len(holder.mapped) == 10
    strange = other.selected(ids[10:12]).cells
    with MappingProcess([other.path(h) for h in strange]) as other_process:
        other.release()
        reply = other.selected(ids[20:40], wait=10.0)
        assert reply.cells
        assert {f.code for f in reply.failed} == {"over_budget"}
        assert len(reply.cells) + len(reply.failed) == 20
        by_session = {holder_[0]: holder_ for holder_ in reply.failed[0].holders}
        mine = by_session[holder.client.session]
        assert (mine[1], mine[2], mine[3]) == (os.getpid(), os.getuid(), "the holder")
        assert mine[4] >= 10 * 4200 * 16
        assert mine[5] == 10
        assert by_session[0][1] == 0  # a mapping without a known owner
        assert by_session[0][5] == 2
        assert other_process.checksums()
        holder.drop_all()
    done: set[str] = set()
    waiting = Deadline()
    while waiting(len(done) < 12):  # once others release it goes on, a few at a time as the budget allows
        reply = other.selected([i for i in ids[20:40] if i not in done][:8], wait=10.0)
        done |= {h.id for h in reply.cells}
    assert one.segment_bytes() <= budget


def test_a_cell_larger_than_the_budget(
    daemon: DaemonFactory, connect: Connect, divided_map: DividedMap
) -> None:
    corner = divided_map.corners["0_0.pcd"]
    huge = random_points(np.random.default_rng(1), corner, 100_000)
    divided_map.write_cell("0_0.pcd", corner, huge)
    one = daemon(divided_map.root, "--budget", "1M")
    reply = connect(one).area(circle(0, 0, 5))
    assert [(f.id.rsplit("/", 1)[-1], f.code) for f in reply.failed] == [("0_0.pcd", "over_budget")]
    assert len(reply.cells) == 3


def test_a_hoarder_meets_its_quota_and_others_get_theirs(
    daemon: DaemonFactory, connect: Connect, heavy_map: DividedMap
) -> None:
    budget = 20 * CELL_BYTES + STATISTICS_BYTES
    one = daemon(heavy_map.root, "--budget", str(budget), "--session-quota", "0.5")
    hoarder = Holder(connect(one, name="hoarder"))
    for _ in range(3):
        reply = hoarder.client.differential(circle(0, 0, 500), packed=list(hoarder.mapped), wait=10.0)
        hoarder.take(reply)
        assert reply.failed
        assert {f.code for f in reply.failed} == {"over_budget"}
    assert len(hoarder.mapped) * CELL_BYTES <= budget // 2
    assert hoarder.mapped
    modest = Holder(connect(one, name="modest"))
    for x in (-70.0, 0.0, 70.0):
        reply = modest.client.differential(circle(x, 70, 5), packed=list(modest.mapped), wait=20.0)
        modest.take(reply)
        assert (reply.failed, reply.pending) == ([], [])
        assert {i.rsplit("/", 1)[1] for i in modest.version_of} == set(heavy_map.in_circle(x, 70, 5))
    modest.drop_all()
    hoarder.drop_all()


@pytest.mark.root
def test_a_reload_finishes_with_room_for_one_more_cell_only(
    daemon: DaemonFactory, connect: Connect, heavy_map: DividedMap, private_tmpfs: Callable[[str], str]
) -> None:
    """Two clients follow the same window while every cell of it changes; they drop what they replace."""
    directory = private_tmpfs("64m")
    window = heavy_map.in_circle(0, 0, 25)
    largest = 90 << 10
    rows_and_counters = 144 << 10
    budget = len(window) * CELL_BYTES + largest + rows_and_counters
    one = daemon(heavy_map.root, "--budget", str(budget), "--session-quota", "1", shm_dir=directory)
    with MemoryWatch(directory, one.pid) as watch:
        holders = [Holder(connect(one, name=f"client {i}")) for i in range(2)]
        for holder in holders:
            reply = holder.client.area(circle(0, 0, 25))
            holder.take(reply)
            assert len(holder.mapped) == len(window)
        old = dict(holders[0].version_of)
        rng = np.random.default_rng(3)
        for number, name in enumerate(window):
            corner = heavy_map.corners[name]
            count = 5200 if number == 3 else 4200
            heavy_map.write_cell(name, corner, random_points(rng, corner, count))
        assert holders[0].client.ask("reload")[3] == len(window)
        for _ in range(200):
            for holder in holders:
                reply = holder.client.differential(circle(0, 0, 25), packed=list(holder.mapped), wait=1.0)
                assert reply.removed_versions == []
                holder.take(reply)
            if all(set(h.version_of.values()).isdisjoint(old.values()) for h in holders):
                break
        for holder in holders:
            assert set(holder.version_of) == {heavy_map.id(name) for name in window}
            assert set(holder.version_of.values()).isdisjoint(old.values())
        final = holders[0].client.area(circle(0, 0, 25))
        assert names(final.cells) == window
        for handle in final.cells:
            assert_same_points(holders[0].client, handle, heavy_map)
        for holder in holders:
            holder.drop_all()
    assert watch.peak_bytes <= budget


@pytest.mark.root
def test_a_file_system_smaller_than_the_budget(
    daemon: DaemonFactory, heavy_map: DividedMap, private_tmpfs: Callable[[str], str]
) -> None:
    """It does not start, and says what to do; one that fits does."""
    directory = private_tmpfs("16m")
    one = daemon(heavy_map.root, "--budget", "64M", shm_dir=directory, start=False)
    assert one.run_to_end() == 78
    assert f"a budget of 64 MiB does not fit {directory}" in one.log
    assert "lower --budget, or enlarge the tmpfs" in one.log
    assert one.leftovers() == []
    one.arguments[1] = "12M"
    one.start()


@pytest.mark.root
def test_a_full_file_system_is_reported_and_survived(
    daemon: DaemonFactory, connect: Connect, heavy_map: DividedMap, private_tmpfs: Callable[[str], str]
) -> None:
    """Another program fills the tmpfs: no SIGBUS anywhere, what is there stays good, later it goes on."""
    directory = private_tmpfs("8m")
    one = daemon(heavy_map.root, "--budget", "6M", shm_dir=directory)
    holder = Holder(connect(one))
    holder.take(holder.client.area(circle(0, 0, 5)))
    filler = Path(directory, "filler")
    fd = os.open(filler, os.O_CREAT | os.O_WRONLY)
    with pytest.raises(OSError, match="No space"):
        os.posix_fallocate(fd, 0, 8 << 20)
    free = os.statvfs(directory)
    os.posix_fallocate(fd, 0, free.f_bfree * free.f_frsize)
    os.close(fd)
    reply = holder.client.area(circle(60, 60, 15), wait=10.0)
    assert {f.code for f in reply.failed} == {"no_space"}
    assert len(holder.client.area(circle(0, 0, 5)).cells) == 4
    filler.unlink()
    reply = first_answer(
        lambda: holder.client.area(circle(60, 60, 15), wait=10.0), lambda found: not found.failed
    )
    assert names(reply.cells) == heavy_map.in_circle(60, 60, 15)
    holder.drop_all()
    assert re.search(r"loader (replaced|ended|could not start)", one.log) is None
