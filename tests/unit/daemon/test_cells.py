# SPDX-License-Identifier: Apache-2.0
"""Requests for cells at bad moments: reloads, evictions, full budgets, dying loaders while somebody waits."""

from __future__ import annotations

import contextlib
import math
import mmap
import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from shmmap.daemon.residency import Key
from shmmap.errors import BadRequest
from shmmap.origin.catalogue import Catalogue
from shmmap.protocol.messages import (
    Area,
    BoxMessage,
    Cells,
    CircleMessage,
    Differential,
    Hello,
    Intent,
    Metadata,
    Selected,
)
from tests.support.divided_map import DividedMap, random_points
from tests.support.segment_reader import map_segment, parse
from tests.unit.daemon.inner_daemon import InnerDaemon

Inner = Callable[..., InnerDaemon]
EVERYWHERE = BoxMessage(-1e4, -1e4, 1e4, 1e4)


def names(reply: Cells) -> list[str]:
    return [Path(cell.id).name for cell in reply.cells]


def everything(one: InnerDaemon, request: int = 1) -> Cells:
    """Ask for all cells and wait for them."""
    one.cells.area(one.session(), Area(request, EVERYWHERE, wait=30.0), one.now_s())
    return one.cells_of(request)


@contextlib.contextmanager
def loaders_standing_still(one: InnerDaemon) -> Iterator[list[int]]:
    """Stop the loaders (one is started if there is none); on the way out they go on."""
    if not len(one.pool):
        one.pool.start_one()
    one.run_until(lambda: all(worker.ready for worker in one.pool))
    pids = [worker.process.pid for worker in one.pool]
    for pid in pids:
        os.kill(pid, signal.SIGSTOP)
        os.waitid(os.P_PID, pid, os.WSTOPPED | os.WNOWAIT)
    try:
        yield pids
    finally:
        for pid in pids:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGCONT)


def rewrite(made: DividedMap, name: str, points: int, corner: tuple[int, int] | None = None) -> None:
    made.write_cell(
        name,
        corner or made.corners[name],
        random_points(np.random.default_rng(points), corner or made.corners[name], points),
    )


def path_of(one: InnerDaemon, segment: str) -> str:
    return f"{one.shm_dir}{one.store.segment_prefix}{segment}"


# --- reload -------------------------------------------------------------------------------------------


def test_indices_change_while_requests_wait(inner: Inner, small_map: DividedMap) -> None:
    """A cell that comes first in the order, and one that vanishes: others must not be mixed up."""
    one = inner(small_map.root)
    with loaders_standing_still(one):
        one.cells.area(one.session(), Area(1, CircleMessage(0, 0, 5), wait=30.0), one.now_s())
        wanted = ["20_20.pcd", "0_0.pcd", "20_20.pcd", "0_-20.pcd"]
        one.cells.selected(one.session(), Selected(2, tuple(wanted), wait=30.0), one.now_s())
        one.turn()
        rewrite(small_map, "-100_-100.pcd", 9, (-100, -100))
        small_map.remove_cell("0_-20.pcd")
        small_map.write_metadata()
        one.reload()
    assert names(one.cells_of(1)) == ["-20_-20.pcd", "-20_0.pcd", "0_0.pcd"]
    reply = one.cells_of(2)
    assert names(reply) == ["20_20.pcd", "0_0.pcd", "20_20.pcd"]
    assert [(f.id.rsplit("/", 1)[-1], f.code) for f in reply.failed] == [("0_-20.pcd", "unknown_cell")]
    for cell in (*one.cells_of(1).cells, *reply.cells):
        assert (cell.min_x, cell.min_y) == small_map.corners[Path(cell.id).name]
    one.run_until(lambda: not one.books.reserved_bytes)
    assert {Path(key.cell_id).name for key in one.books.slots} == set(names(one.cells_of(1))) | {"20_20.pcd"}


def test_a_file_replaced_before_the_loader_comes_to_it(inner: Inner, small_map: DividedMap) -> None:
    """What was read counts, and both the version and the map's version say so."""
    one = inner(small_map.root)
    session, before = one.session(), one.store.catalogue.map_version
    with loaders_standing_still(one):
        one.cells.selected(session, Selected(1, ("0_0.pcd",), wait=30.0), one.now_s())
        one.turn()
        rewrite(small_map, "0_0.pcd", 33)
    reply = one.cells_of(1)
    assert [cell.points for cell in reply.cells] == [33]
    assert reply.map_version != before
    page = one.admin.answer(Metadata(2, since=before), one.now_s())
    assert [Path(row.id).name for row in page.rows] == ["0_0.pcd"]  # type: ignore[union-attr]
    assert reply.cells[0].version == page.rows[0].version  # type: ignore[union-attr]
    one.reload()
    assert one.store.catalogue.version(one.store.index_of("0_0.pcd") or 0) == reply.cells[0].version


def test_a_map_switched_back_by_its_symlink(inner: Inner, small_map: DividedMap, tmp_path: Path) -> None:
    """The files are older than those the daemon knows, which never happens to one file: served, once."""
    older = small_map.pcd_dir.rename(tmp_path / "older")
    newer = tmp_path / "newer"
    newer.mkdir()
    for path in older.iterdir():
        (newer / path.name).write_bytes(path.read_bytes())
    small_map.pcd_dir.symlink_to(newer)
    one = inner(small_map.root)
    (small_map.root / "link").symlink_to(older)
    (small_map.root / "link").rename(small_map.pcd_dir)
    reply = everything(one)
    assert len(reply.cells) == 16
    assert (reply.failed, reply.pending) == ((), ())
    assert one.statistics.values["loads_started"] == 16


def test_a_map_that_comes_and_goes(inner: Inner, small_map: DividedMap, tmp_path: Path) -> None:
    """Two states in turn, a reader of the first all the time: each time exactly the state's versions."""
    other = tmp_path / "other"
    other.mkdir()
    for path in small_map.pcd_dir.iterdir():
        (other / path.name).write_bytes(path.read_bytes())
    first = small_map.pcd_dir.rename(tmp_path / "first")
    small_map.pcd_dir.symlink_to(first)
    one = inner(small_map.root)
    versions = []
    mapped: list[mmap.mmap] = []
    for turn in range(6):
        reply = everything(one, turn + 1)
        assert not any(cell.stale for cell in reply.cells)
        versions.append([cell.version for cell in reply.cells])
        if not mapped:
            for cell in reply.cells:
                with open(path_of(one, cell.segment), "rb") as file:
                    mapped.append(mmap.mmap(file.fileno(), 0, prot=mmap.PROT_READ))
        assert one.books.resident_count == 16
        assert {slot.resident.name for slot in one.books.slots.values() if slot.resident} == {
            resident.name for resident in one.books.residents()
        }
        (small_map.root / "link").symlink_to(other if turn % 2 == 0 else first)
        (small_map.root / "link").rename(small_map.pcd_dir)
        one.reload()
    assert versions[0] == versions[2] == versions[4]
    assert versions[1] == versions[3] == versions[5]
    assert not set(versions[0]) & set(versions[1])
    for one_map in mapped:
        one_map.close()


def test_heights_of_a_replaced_file_are_unknown(inner: Inner, small_map: DividedMap) -> None:
    """The old version lay below the range: the new one must be looked at before it is left out."""
    one = inner(small_map.root)
    session, high = one.session(), CircleMessage(10, 10, 1, 50.0, 60.0)
    everything(one)
    one.cells.area(session, Area(2, high, wait=30.0), one.now_s())
    assert one.cells_of(2).cells == ()
    columns = random_points(np.random.default_rng(1), (0, 0), 20)
    columns["z"] = columns["z"] + np.float32(52.0)
    small_map.write_cell("0_0.pcd", (0, 0), columns)
    one.reload()
    one.cells.area(session, Area(3, high, wait=30.0), one.now_s())
    assert names(one.cells_of(3)) == ["0_0.pcd"]
    one.cells.differential(
        session, Differential(4, CircleMessage(10, 10, 1, 0.0, 8.0), wait=30.0), one.now_s()
    )
    assert one.cells_of(4).cells == ()


def test_moved_cells_are_loaded_again_with_their_box(inner: Inner, small_map: DividedMap) -> None:
    one = inner(small_map.root)
    everything(one)
    evicted = one.store.warm.layers["points"][one.store.index_of("0_0.pcd") or 0]
    with open(path_of(one, evicted.name.rsplit(".", 1)[1]), "rb") as held:
        one.store.evict(evicted, one.now_s())  # a zombie while it moves
        small_map.corners["0_0.pcd"] = (400, 400)
        small_map.corners["20_20.pcd"] = (500, 500)
        small_map.write_metadata()
        one.reload()
        one.cells.selected(one.session(), Selected(2, ("0_0.pcd", "20_20.pcd"), wait=30.0), one.now_s())
        reply = one.cells_of(2)
        held.close()
    assert [(cell.min_x, cell.min_y) for cell in reply.cells] == [(400.0, 400.0), (500.0, 500.0)]
    for cell in reply.cells:
        assert parse(map_segment(path_of(one, cell.segment))).fields["box"][:2] == (cell.min_x, cell.min_y)


def nowhere(index: int) -> int | None:
    """Say of every cell that it left the map."""
    del index
    return None


def test_an_empty_map(inner: Inner, small_map: DividedMap) -> None:
    one = inner(small_map.root)
    before = everything(one)
    empty = Catalogue.from_cells([])
    one.cells.renumber(nowhere, one.store.catalogue.id)
    one.store.replace_catalogue(empty, one.now_s())
    assert everything(one, 2) == Cells(2, 77, empty.map_version)
    packed = b"".join(cell.version.to_bytes(8, "little") for cell in before.cells)
    one.cells.differential(one.session(), Differential(3, EVERYWHERE, packed=packed), one.now_s())
    assert sorted(one.cells_of(3).removed_packed) == sorted(packed)
    welcome = one.admin.welcome(one.session(), Hello(4, 1, 0))
    assert (welcome.cells, welcome.bounds) == (0, None)
    one.run_until(lambda: one.books.used_bytes == one.books.overhead_bytes)
    one.reload()
    assert len(everything(one, 5).cells) == 16


# --- memory -------------------------------------------------------------------------------------------


def test_evicted_while_a_request_waits_for_others(inner: Inner, small_map: DividedMap) -> None:
    """It is put back or loaded once more while there is time: never forgotten."""
    one = inner(small_map.root)
    session = one.session()
    one.cells.selected(session, Selected(1, ("0_0.pcd", "20_20.pcd"), wait=30.0), one.now_s())
    one.cells_of(1)
    first = one.store.warm.layers["points"][one.store.index_of("0_0.pcd") or 0]
    second = one.store.warm.layers["points"][one.store.index_of("20_20.pcd") or 0]
    wanted = ("0_0.pcd", "20_20.pcd", "20_0.pcd")
    with loaders_standing_still(one), open(path_of(one, second.name.rsplit(".", 1)[1]), "rb"):
        one.cells.selected(session, Selected(2, wanted, wait=30.0), one.now_s())
        one.store.evict(first, one.now_s() - 1.0)
        one.store.evict(second, one.now_s() - 1.0)
        one.run_until(lambda: first.name not in one.books.zombies)
        assert second.name in one.books.zombies, "somebody has it open"
        os.kill(next(iter(one.pool)).process.pid, signal.SIGCONT)
        reply = one.cells_of(2)
    assert names(reply) == list(wanted)
    assert reply.cells[0].segment != first.name.rsplit(".", 1)[1], "loaded once more"
    assert reply.cells[1].segment == second.name.rsplit(".", 1)[1], "put back in service"
    assert reply.pending == ()


def sizes(small_map: DividedMap, inner: Inner) -> int:
    """Bytes of one ordinary segment of this map (all are alike)."""
    one = inner(small_map.root)
    everything(one)
    return min(resident.nbytes for resident in one.books.residents())


def test_a_budget_that_is_just_enough(inner: Inner, small_map: DividedMap) -> None:
    """While cells load more is reserved than they come to need: no reason to refuse the last ones."""
    each = sizes(small_map, inner)
    one = inner(small_map.root, workers=2)
    estimate = one.store.estimate(0, "points")
    assert estimate > each
    one.books.budget_bytes = one.books.overhead_bytes + 15 * each + estimate
    reply = everything(one)
    assert (len(reply.cells), reply.failed) == (16, ())
    other = inner(small_map.root, workers=2)
    other.books.budget_bytes = other.books.overhead_bytes + 15 * each + estimate - 4096
    reply = everything(other)
    assert (len(reply.cells), [failure.code for failure in reply.failed]) == (15, ["over_budget"])


def test_what_is_mapped_and_asked_for_again_and_again_is_no_reason_to_wait(
    inner: Inner, small_map: DividedMap
) -> None:
    """Somebody else is told at once, though each answer begins another grace for what it hands out."""
    each = sizes(small_map, inner)
    one = inner(small_map.root)
    one.books.budget_bytes = one.books.overhead_bytes + 4 * each + 8192
    reader, other = one.session("reader"), one.session("other")
    one.cells.area(reader, Area(1, CircleMessage(0, 0, 5), wait=30.0), one.now_s())
    opened = [os.open(path_of(one, cell.segment), os.O_RDONLY) for cell in one.cells_of(1).cells]
    assert len(opened) == 4
    one.cells.selected(other, Selected(2, ("20_20.pcd",), wait=3000.0), one.now_s())
    request = 10

    def answered() -> bool:
        nonlocal request
        request += 1
        one.cells.area(reader, Area(request, CircleMessage(0, 0, 5)), one.now_s())
        return any(reply.request == 2 for _, reply in one.replies)

    one.run_until(answered)
    (failure,) = one.cells_of(2).failed
    assert failure.code == "over_budget"
    assert [(holder.session, holder.cells) for holder in failure.holders] == [(0, 4)]
    for fd in opened:
        os.close(fd)
    one.cells.let_go(reader.drop(list(reader.held)))
    one.offset_s += 2.0
    one.cells.selected(other, Selected(3, ("20_20.pcd",), wait=30.0), one.now_s())
    assert names(one.cells_of(3)) == ["20_20.pcd"]


def ascii_cell(made: DividedMap, name: str, points: int) -> None:
    """Write a file that needs more memory than it is long."""
    head = f"VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {points}\nHEIGHT 1\n"
    path = made.pcd_dir / name
    path.write_text(f"{head}POINTS {points}\nDATA ascii\n" + "1 2 3\n" * points)


def test_two_loads_that_need_more_than_both_can_have(inner: Inner, small_map: DividedMap) -> None:
    """One is refused, and its room given to the other: no deadlock, no deadline."""
    for name in ("0_0.pcd", "20_20.pcd"):
        ascii_cell(small_map, name, 50_000)
    one = inner(small_map.root, workers=2)
    half = one.store.estimate(one.store.index_of("0_0.pcd") or 0, "points")
    one.books.budget_bytes = one.books.overhead_bytes + 2 * half + 100_000
    one.cells.selected(one.session(), Selected(1, ("0_0.pcd", "20_20.pcd"), wait=3000.0), one.now_s())
    reply = one.cells_of(1)
    assert len(reply.cells) == 1
    assert [failure.code for failure in reply.failed] == ["over_budget"]
    assert one.statistics.values["loads_timed_out"] == 0
    assert one.books.reserved_bytes == 0


def test_a_loader_killed_while_it_waits_for_room(inner: Inner, small_map: DividedMap) -> None:
    ascii_cell(small_map, "20_20.pcd", 50_000)
    each = sizes(small_map, inner)
    one = inner(small_map.root)
    one.books.budget_bytes = one.books.overhead_bytes + 50_000 * 12 + 2 * 4096 + 2 * each
    session = one.session()
    one.stop_clock()  # the cells handed out first stay in their grace
    one.cells.area(session, Area(1, CircleMessage(0, 0, 5), wait=30.0), one.now_s())
    assert len(one.cells_of(1).cells) == 4
    one.cells.selected(session, Selected(2, ("20_20.pcd", "20_0.pcd"), wait=300.0), one.now_s())
    one.run_until(lambda: one.store.loads.hungry)
    (worker,) = one.pool
    worker.process.kill()
    one.run_until(lambda: worker not in list(one.pool))
    one.offset_s += 31.0
    reply = one.cells_of(2)
    assert [failure.code for failure in reply.failed] == ["load_failed"]
    assert "SIGKILL" in reply.failed[0].message
    one.run_until(lambda: not one.books.reserved_bytes)
    assert one.store.loads.hungry == {}


def test_the_deadline_ends_a_loader_that_waits_for_room(inner: Inner, small_map: DividedMap) -> None:
    ascii_cell(small_map, "20_20.pcd", 50_000)
    each = sizes(small_map, inner)
    one = inner(small_map.root, load_timeout_s=0.5)
    one.books.budget_bytes = one.books.overhead_bytes + 50_000 * 12 + 2 * 4096 + 2 * each
    session = one.session()
    one.stop_clock()
    one.cells.area(session, Area(1, CircleMessage(0, 0, 5), wait=30.0), one.now_s())
    assert len(one.cells_of(1).cells) == 4
    one.cells.selected(session, Selected(2, ("20_20.pcd",), wait=30.0), one.now_s())
    one.run_until(lambda: one.store.loads.hungry)
    one.offset_s += 0.6
    assert [failure.code for failure in one.cells_of(2).failed] == ["load_timeout"]
    assert (one.books.reserved_bytes, one.store.loads.hungry, len(one.pool)) == (0, {}, 0)


def test_duplicates_count_once_for_the_quota(inner: Inner, small_map: DividedMap) -> None:
    quota = 3 * inner(small_map.root).store.estimate(0, "points")
    one = inner(small_map.root, quota_bytes=quota)
    session, ids = one.session(), ("0_0.pcd",) * 10 + ("20_20.pcd",) * 10
    for request in (1, 2):  # cold, then warm
        one.cells.selected(session, Selected(request, ids, wait=30.0), one.now_s())
        reply = one.cells_of(request)
        assert (names(reply), reply.failed) == (list(ids), ())
    reply = everything(one, 3)
    assert {failure.code for failure in reply.failed} == {"over_budget"}
    assert one.statistics.values["refused_quota"] == len(reply.failed)


# --- requests that make little sense ------------------------------------------------------------------


@pytest.mark.parametrize("wait", [-1.0, -0.0001, math.nan, math.inf, -math.inf, 3600.5, 1e300])
@pytest.mark.parametrize("warm", [False, True])
def test_waits_that_are_refused(inner: Inner, small_map: DividedMap, wait: float, warm: bool) -> None:
    """Whether the cells are in memory or not."""
    one = inner(small_map.root)
    session = one.session()
    if warm:
        everything(one)
    with pytest.raises(BadRequest, match="wait"):
        one.cells.area(session, Area(2, EVERYWHERE, wait=wait), one.now_s())
    with pytest.raises(BadRequest, match="wait"):
        one.cells.differential(session, Differential(2, EVERYWHERE, wait=wait), one.now_s())
    with pytest.raises(BadRequest, match="wait"):
        one.cells.selected(session, Selected(2, (), wait=wait), one.now_s())
    assert not len(one.cells)
    assert not one.books.queued


def test_waits_that_are_answered_at_once(inner: Inner, small_map: DividedMap) -> None:
    one = inner(small_map.root)
    session = one.session()
    for request, wait in ((1, None), (2, 0.0), (3, -0.0)):
        one.cells.area(session, Area(request, EVERYWHERE, wait=wait), one.now_s())
        (reply,) = [reply for _, reply in one.replies if reply.request == request]
        assert len(reply.pending) == 16
    one.cells.area(session, Area(4, EVERYWHERE, wait=3600.0), one.now_s())
    assert len(one.cells_of(4).cells) == 16


@pytest.mark.parametrize(
    "area",
    [
        CircleMessage(1e300, -1e300, 1e300),
        CircleMessage(0, 0, 1e308),
        BoxMessage(-1.7e308, -1.7e308, 1.7e308, 1.7e308),
        BoxMessage(1.6e308, 1.6e308, 1.7e308, 1.7e308),
        CircleMessage(1e308, 1e308, 0.0),
    ],
)
def test_areas_at_the_end_of_the_world(
    inner: Inner, small_map: DividedMap, area: CircleMessage | BoxMessage
) -> None:
    """Some touch everything and some nothing; memory can still be made and others served afterwards."""
    one = inner(small_map.root)
    session = one.session()
    one.cells.area(session, Area(1, area, wait=30.0), one.now_s())
    reply = one.cells_of(1)
    assert len(reply.cells) in (0, 16)
    assert (reply.pending, reply.failed) == ((), ())
    assert len(everything(one, 2).cells) == 16
    one.offset_s += 2.0
    one.reclaimer.free(one.books.budget_bytes, one.now_s())
    one.run_until(lambda: one.books.used_bytes == one.books.overhead_bytes)


def test_nearest_cells_first(inner: Inner, small_map: DividedMap) -> None:
    """As seen from where the client says it is, else from the middle of what it asks for."""
    one = inner(small_map.root)
    session = one.session()
    with loaders_standing_still(one):
        one.cells.area(session, Area(1, EVERYWHERE), one.now_s())
        nearest = one.books.next_queued()
    assert nearest is not None
    assert Path(nearest.key.cell_id).name == "-20_-20.pcd"  # of the four that touch the middle
    two = inner(small_map.root)
    two.cells.area(two.session(), Area(1, CircleMessage(35, 35, 300)), two.now_s())
    nearest = two.books.next_queued()
    assert nearest is not None
    assert Path(nearest.key.cell_id).name == "20_20.pcd"
    two = inner(small_map.root)
    session = two.session()
    session.intent, session.says_where = Intent(-35.0, 35.0), True
    two.cells.area(session, Area(1, CircleMessage(35, 35, 300)), two.now_s())
    nearest = two.books.next_queued()
    assert nearest is not None
    assert Path(nearest.key.cell_id).name == "-40_20.pcd"


def test_nothing_stays_of_requests_that_are_over(inner: Inner, small_map: DividedMap) -> None:
    one = inner(small_map.root)
    session = one.session()
    with loaders_standing_still(one):
        for request in range(1, 6):
            one.cells.area(session, Area(request, EVERYWHERE, wait=0.01 * request), one.now_s())
        one.cells.area(session, Area(9, EVERYWHERE, wait=30.0), one.now_s())
        one.run_until(lambda: len(one.cells) == 1)
        one.cells.forget(session)
        assert len(one.cells) == 0
    one.run_until(lambda: one.books.resident_count == 16)
    assert all(slot.waiting == 0 for slot in one.books.slots.values())
    assert one.cells.next_deadline_s() == math.inf
    assert 9 not in [reply.request for _, reply in one.replies]
    assert all(isinstance(key, Key) for key in one.settled)


def test_a_cell_asked_for_twice_and_evicted_while_the_request_waits(
    inner: Inner, small_map: DividedMap
) -> None:
    """It is loaded once more, and the request is answered once."""
    one = inner(small_map.root)
    session = one.session()
    one.cells.selected(session, Selected(1, ("0_0.pcd",), wait=30.0), one.now_s())
    one.cells_of(1)
    first = one.store.warm.layers["points"][one.store.index_of("0_0.pcd") or 0]
    wanted = ("0_0.pcd", "0_0.pcd", "20_0.pcd")
    with loaders_standing_still(one):
        one.cells.selected(session, Selected(2, wanted, wait=30.0), one.now_s())
        one.store.evict(first, one.now_s() - 1.0)
        one.run_until(lambda: first.name not in one.books.zombies)
    assert names(one.cells_of(2)) == list(wanted)
    assert sum(reply.request == 2 for _, reply in one.replies) == 1
    assert len(one.cells) == 0
