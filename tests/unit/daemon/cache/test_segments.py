# SPDX-License-Identifier: Apache-2.0
"""What is in memory: layers, names that others take, and another state of the map."""

from __future__ import annotations

import gc
import os
import resource
import select
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from shmmap.daemon.cache import map_switch, warm_index
from shmmap.daemon.cache.warm_index import Heights
from shmmap.daemon.records import Key, Resident
from shmmap.large_tables import ShardedDict
from shmmap.protocol import messages as m
from shmmap.protocol.codec import pack_versions
from shmmap.protocol.messages import Area, CircleMessage, Differential, Metadata, Selected
from shmmap.segment.names import retired_name
from tests.support.divided_map import DividedMap, make_map
from tests.unit.daemon.inner_daemon import EVERYWHERE, Inner, InnerDaemon, names

with_kernels = pytest.mark.usefixtures("layer_kernels")
NDT = "ndt(leaf=5.0,min_points=3)"


def ask(one: InnerDaemon, session: Any, number: int, layer: str) -> m.Cells:
    ids = tuple(one.cache.catalogue.id(i) for i in range(len(one.cache.catalogue)))
    return one.cells_for(Selected(number, ids, (layer,), 600.0), session)


@with_kernels
def test_ndt_is_served_where_its_points_would_never_fit(tmp_path: Path, inner: Inner) -> None:
    made = make_map(tmp_path / "map", columns=2, rows=2, points=20_000)
    one = inner(made.root, budget_bytes=1 << 20)
    one.ledger.budget_bytes = one.ledger.overhead_bytes + 400_000  # each file alone has 320 kB
    session = one.session()
    reply = ask(one, session, 1, NDT)
    assert (len(reply.cells), reply.failed) == (4, ())
    assert one.ledger.used_bytes <= one.ledger.budget_bytes
    assert {key.layer for key in {*one.ledger.by_key, *one.loads.by_key, *one.loads.failures}} == {NDT}


@with_kernels
def test_any_number_of_layers_is_in_memory(
    tmp_path: Path, inner: Inner, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Tables are for those with the most segments; the others are found without, and none is refused."""
    monkeypatch.setattr(warm_index, "TABLES_BYTES", 0)
    monkeypatch.setattr(warm_index, "LEAST_TABLES", 2)
    made = make_map(tmp_path / "map", columns=4, rows=2, points=50)
    one = inner(made.root)
    first, session, warm = (made.id("0_0.pcd"),), one.session(), one.cache.warm
    layers = [f"voxel(leaf={number}.0)" for number in range(1, 9)]
    for number, layer in enumerate(layers):
        assert len(one.cells_for(Selected(number + 1, first, (layer,), 600.0), session).cells) == 1
    assert set(warm.layers) == set(layers)
    assert list(warm.tables) == layers[:2]
    assert len(ask(one, session, 20, "points").cells) == 8  # one at a time, of a layer that came last
    assert "points" in warm.tables
    assert len(warm.tables) == 2
    everything = np.arange(8)
    for layer in ("points", *layers):
        current = [one.cache.layers.version(index, layer) for index in range(8)]
        expected = [version if warm.get(index, layer) else 0 for index, version in enumerate(current)]
        assert warm.versions(layer, everything) == expected
    assert len(warm) == 16
    one.reclaimer.retire(one.ledger.by_key[Key(first[0], layers[5])], one.now_s())
    assert warm.versions(layers[5], everything) is None
    assert len(warm) == 15
    for resident in list(one.ledger.residents()):
        one.reclaimer.retire(resident, one.now_s())
    assert (warm.layers, warm.tables, len(warm)) == ({}, {}, 0), "layers without segments leave no tables"


def test_what_old_versions_are_of_is_forgotten_some_day(
    tmp_path: Path, inner: Inner, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(warm_index, "RETIRED_REMEMBERED", 3)
    made = make_map(tmp_path / "map", columns=4, rows=2, points=50)
    one = inner(made.root)
    versions = [cell.version for cell in ask(one, one.session(), 1, "points").cells]
    residents = [one.ledger.by_key[Key(one.cache.catalogue.id(i), "points")] for i in range(8)]
    for resident in residents[:5]:
        one.reclaimer.retire(resident, one.now_s())
    assert set(one.cache.warm.of_version) == set(versions[2:])
    assert len(ask(one, one.session(), 2, "points").cells) == 8  # loaded again, or put back in service
    assert set(one.cache.warm.of_version) == set(versions)
    for resident in residents[5:]:
        one.reclaimer.retire(resident, one.now_s())
    assert set(one.cache.warm.of_version) == set(versions)


SIDE = 8
CELLS = SIDE * SIDE


@pytest.fixture
def made(tmp_path: Path) -> DividedMap:
    return make_map(tmp_path / "map", columns=SIDE, rows=SIDE, points=5)


def finish_change(one: InnerDaemon) -> None:
    """Do the rest of a change."""
    while one.map_switch.next_s <= one.now_s():
        one.map_switch.run_step(one.now_s())


def remove(made: DividedMap, name: str) -> None:
    del made.corners[name]
    made.write_metadata()


@pytest.mark.parametrize("turns", [0, 1, CELLS // 2, CELLS + CELLS // 2, 2 * CELLS + 3])
@pytest.mark.usefixtures("short_steps")
def test_requests_meanwhile_are_answered_as_if_it_were_over(
    inner: Inner, made: DividedMap, turns: int
) -> None:
    """Nothing is loaded again, nothing that left is handed out, and what is held is not sent again."""
    one = inner(str(made.root))
    held = pack_versions([cell.version for cell in one.everything().cells])
    loads = one.statistics.values["loads_started"]
    remove(made, "0_0.pcd")
    made.change("20_20.pcd", 3)
    one.reload()
    for _ in range(turns):
        one.map_switch.run_step(one.now_s())
    reply = one.cells_for(Differential(2, EVERYWHERE, packed=held, wait=30.0))
    assert names(reply) == ["20_20.pcd"]
    assert len(reply.removed_packed) == 8  # of the cell that left; the changed one is replaced
    assert len(one.everything(3).cells) == CELLS - 1
    assert one.statistics.values["loads_started"] == loads + 1
    finish_change(one)
    assert one.cache.unentered == 0
    assert "0_0.pcd" not in names(one.cells_for(Area(4, CircleMessage(1, 1, 2))))
    assert one.ledger.resident_count == CELLS - 1


@pytest.mark.parametrize("is_small", [True, False])
def test_the_state_before_a_change_is_freed_in_a_step_of_its_own(
    inner: Inner, made: DividedMap, is_small: bool
) -> None:
    one = inner(str(made.root))
    one.everything()
    before = weakref.ref(one.cache.catalogue)
    if is_small:
        made.change("20_20.pcd", 3)
    else:
        remove(made, "20_20.pcd")
    one.reload()
    assert before() is not None
    one.run_until(lambda: before() is None)


@pytest.mark.usefixtures("short_steps")
def test_a_change_during_a_change(inner: Inner, made: DividedMap) -> None:
    one = inner(str(made.root))
    one.everything()
    for name in sorted(made.corners)[:5]:
        remove(made, name)
        one.reload()
        one.map_switch.run_step(one.now_s())
    finish_change(one)
    assert len(one.cache.warm) == one.ledger.resident_count == CELLS - 5
    assert len(one.everything(2).cells) == CELLS - 5


@pytest.mark.usefixtures("short_steps")
def test_tables_of_many_states_do_not_pile_up(inner: Inner, made: DividedMap) -> None:
    """Also where another state comes before the segments have been checked for the last one."""

    def tables() -> int:
        return sum(isinstance(one, ShardedDict) for one in gc.get_objects())

    one = inner(str(made.root))
    one.everything()
    found = []
    for name in sorted(made.corners)[:6]:
        remove(made, name)
        one.reload()
        for _ in range(CELLS + 8):
            one.map_switch.run_step(one.now_s())
        assert one.cache.unentered > 0
        found.append(tables())
    assert max(found) == found[0]


def test_very_many_changes_are_not_remembered(
    inner: Inner, made: DividedMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Then the whole list is answered; fewer changes are named, also of several states."""
    monkeypatch.setattr(map_switch, "CELLS_REMEMBERED", 5)
    one = inner(str(made.root))
    first = one.cache.catalogue.map_version
    some = sorted(made.corners)[:6]
    for name in some[:3]:
        made.change(name, 3)
    one.reload()
    second = one.cache.catalogue.map_version
    made.change(some[3], 3)
    one.reload()
    page = one.queries.page(Metadata(1, since=first))
    assert [row.id for row in page.rows] == some[:4]  # type: ignore[union-attr]
    for name in some[4:]:
        made.change(name, 4)
    one.reload()
    assert one.map_switch.changes_since(first) is None
    assert one.map_switch.changes_since(second) is not None
    for name in some:
        made.change(name, 5)
    one.reload()
    assert one.map_switch.changes_since(second) is None
    everything = one.queries.page(Metadata(2, since=first))
    assert (len(everything.rows), everything.since_known) == (CELLS, False)  # type: ignore[union-attr]


def test_heights() -> None:
    heights = Heights(5)
    heights.learn(1, -1.0, 2.0)
    heights.learn(2, 5.0, 6.0)
    heights.learn(3, np.nan, np.nan)  # of a layer without heights
    heights.learn(4, 5.0, 6.0)
    heights.forget(np.array([4]))
    assert (heights.get(1), heights.get(0), heights.get(4)) == ((-1.0, 2.0), None, None)
    assert heights.overlapping(np.array([4, 3, 2, 1, 0]), (2.0, 4.0)).tolist() == [4, 3, 1, 0]


def load(one: InnerDaemon, request: int) -> Resident:
    assert len(one.cells_for(Selected(request, ("0_0.pcd",), wait=30.0)).cells) == 1
    return one.cache.warm.layers["points"][one.cache.index_of("0_0.pcd") or 0]


@contextmanager
def taken(one: InnerDaemon, name: str) -> Iterator[None]:
    os.mkdir(f"{one.shm_dir}{name}")
    yield
    os.rmdir(f"{one.shm_dir}{name}")


def shown(one: InnerDaemon) -> dict[str, str]:
    """Segments and their states in the daemon's list."""
    return {cell.segment: cell.state for cell in one.listed()}


def test_the_name_of_a_retired_segment(inner: Inner, small_map: DividedMap) -> None:
    """It retires under another one, is shown under that, comes back, and is freed in the end."""
    one = inner(small_map.root)
    first = load(one, 1)
    old = first.name
    with taken(one, retired_name(old)), open(f"{one.shm_dir}{old}", "rb"):
        one.reclaimer.retire(first, one.now_s())
        assert first.name != old
        assert Path(f"{one.shm_dir}{retired_name(first.name)}").exists()
        assert shown(one) == {first.name.rpartition(".")[2]: "zombie"}
        assert load(one, 2) is first
        assert shown(one) == {first.name.rpartition(".")[2]: "resident"}
        assert Path(f"{one.shm_dir}{first.name}").exists()
    one.reclaimer.retire(first, one.now_s())
    one.run_until(lambda: not one.ledger.retired)
    assert (one.ledger.retired_bytes, one.ledger.resident_bytes, shown(one)) == (0, 0, {})
    assert [name for name in os.listdir(one.shm_dir) if not name.endswith("statistics")] == []


def test_the_name_it_had_before(inner: Inner, small_map: DividedMap) -> None:
    """It cannot come back, so that the cell is loaded again; the retired one goes when its reader does."""
    one = inner(small_map.root)
    first = load(one, 1)
    with open(f"{one.shm_dir}{first.name}", "rb"):
        one.reclaimer.retire(first, one.now_s())
        with taken(one, first.name):
            assert load(one, 2) is not first
        assert one.ledger.retired
    one.run_until(lambda: not one.ledger.retired)


def test_what_others_cut_short_never_comes_back(inner: Inner, small_map: DividedMap) -> None:
    """Its cell is loaded again at once, although the damaged segment is still mapped by a reader."""
    one = inner(small_map.root)
    first = load(one, 1)
    path = f"{one.shm_dir}{first.name}"
    with open(path, "rb"):
        os.chmod(path, 0o600)  # an ordinary user may not write what it made read-only
        os.truncate(path, 0)
        assert one.cache.lost.retire_if_lost(first, one.now_s())
        assert load(one, 2) is not first
    one.run_until(lambda: not one.ledger.retired)


def test_a_name_that_others_remove_wakes_the_daemon(inner: Inner, small_map: DividedMap) -> None:
    one = inner(small_map.root)
    first = load(one, 1)
    os.unlink(f"{one.shm_dir}{first.name}")
    assert select.select([one.cache.lost.fd], [], [], 60.0)[0]
    assert one.cache.lost.vanished() == {first.name}


def test_no_descriptors_left(inner: Inner, small_map: DividedMap) -> None:
    """What cannot be looked at is taken for pinned."""
    one = inner(small_map.root)
    assert len(one.cells_for(Area(1, EVERYWHERE, wait=30.0)).cells) == 16
    for resident in list(one.ledger.residents()):
        one.reclaimer.retire(resident, one.now_s())
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    lowest = os.dup(0)
    os.close(lowest)
    resource.setrlimit(resource.RLIMIT_NOFILE, (lowest, limits[1]))
    try:
        one.offset_s += 5.0
        one.turn()
        assert len(one.ledger.retired) == 16, "freed without a look"
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, limits)
    one.offset_s += 5.0
    one.run_until(lambda: not one.ledger.retired)
