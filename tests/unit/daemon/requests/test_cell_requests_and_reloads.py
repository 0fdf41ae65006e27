# SPDX-License-Identifier: Apache-2.0
"""Requests for cells while files, cells and whole maps are replaced."""

from __future__ import annotations

import mmap
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from shmmap.origin.catalogue import Catalogue
from shmmap.protocol.messages import (
    Area,
    Cells,
    CircleMessage,
    Differential,
    Hello,
    Metadata,
    MetadataPage,
    Selected,
)
from tests.support.divided_map import DividedMap, random_points
from tests.support.segment_reader import map_segment, parse
from tests.support.skips import open3d_or_skip
from tests.unit.daemon.inner_daemon import EVERYWHERE, Inner, names


def rewrite(made: DividedMap, name: str, points: int, corner: tuple[int, int] | None = None) -> None:
    made.write_cell(
        name,
        corner or made.corners[name],
        random_points(np.random.default_rng(points), corner or made.corners[name], points),
    )


def test_indices_change_while_requests_wait(inner: Inner, small_map: DividedMap) -> None:
    """A cell that comes first in the order, and one that vanishes: others must not be mixed up."""
    one = inner(small_map.root)
    with one.loaders_standing_still():
        one.ask(one.session(), Area(1, CircleMessage(0, 0, 5), wait=30.0))
        wanted = ["20_20.pcd", "0_0.pcd", "20_20.pcd", "0_-20.pcd"]
        one.ask(one.session(), Selected(2, tuple(wanted), wait=30.0))
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
    one.run_until(lambda: not one.ledger.reserved_bytes)
    assert {
        Path(key.cell_id).name for key in {*one.ledger.by_key, *one.loads.by_key, *one.loads.failures}
    } == set(names(one.cells_of(1))) | {"20_20.pcd"}


def test_a_file_replaced_before_the_loader_comes_to_it(inner: Inner, small_map: DividedMap) -> None:
    """What was read counts, and both the version and the map's version say so."""
    one = inner(small_map.root)
    session, before = one.session(), one.cache.catalogue.map_version
    with one.loaders_standing_still():
        one.ask(session, Selected(1, ("0_0.pcd",), wait=30.0))
        one.turn()
        rewrite(small_map, "0_0.pcd", 33)
    reply = one.cells_of(1)
    assert [cell.points for cell in reply.cells] == [33]
    assert reply.map_version != before
    page = one.queries.page(Metadata(2, since=before))
    assert [Path(row.id).name for row in page.rows] == ["0_0.pcd"]  # type: ignore[union-attr]
    assert reply.cells[0].version == page.rows[0].version  # type: ignore[union-attr]
    one.reload()
    assert one.cache.catalogue.version(one.cache.index_of("0_0.pcd") or 0) == reply.cells[0].version


def test_a_file_replaced_after_the_loader_has_read_it(
    inner: Inner, small_map: DividedMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The daemon knows of it before the segment comes: none is published, and the cell is loaded again."""
    one = inner(small_map.root)
    publish = one.scheduler._publish

    def changed_meanwhile(*done: Any) -> None:
        if one.statistics.values["loads_started"] == 1:
            rewrite(small_map, "0_0.pcd", 33)
            one.reload()
        publish(*done)

    monkeypatch.setattr(one.scheduler, "_publish", changed_meanwhile)
    reply = one.cells_for(Selected(1, ("0_0.pcd",), wait=30.0))
    assert [(cell.points, cell.stale) for cell in reply.cells] == [(33, False)]
    assert [one.statistics.values[name] for name in ("loads_started", "loads_finished")] == [2, 1]


def test_what_changed_since_a_state_of_the_map_is_found_once_for_all_pages(
    inner: Inner, small_map: DividedMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = inner(small_map.root)
    before, sought = one.cache.catalogue.map_version, Mock(wraps=one.map_switch.changes_since)
    monkeypatch.setattr(one.map_switch, "changes_since", sought)
    changed = ["-20_-20.pcd", "0_0.pcd", "20_20.pcd"]
    for name in changed:
        rewrite(small_map, name, 33)
    small_map.remove_cell("-40_-40.pcd")
    small_map.write_metadata()
    one.reload()
    for area, expected in ((None, changed), (CircleMessage(20, 20, 15), changed[1:])):
        for number, name in enumerate(expected):
            page = one.queries.page(Metadata(1, area, before, number, 1))
            assert isinstance(page, MetadataPage)
            assert [Path(row.id).name for row in page.rows] == [name]
            assert page.next == (number + 1 if name != expected[-1] else None)
            assert [Path(cell).name for cell in page.removed] == ["-40_-40.pcd"][number:]
    sought.assert_called_once_with(before)
    rewrite(small_map, "20_0.pcd", 33)
    one.reload()
    page = one.queries.page(Metadata(2, since=before))
    assert [Path(row.id).name for row in page.rows] == sorted([*changed, "20_0.pcd"])  # type: ignore[union-attr]


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
    reply = one.everything()
    assert len(reply.cells) == 16
    assert (reply.failed, reply.pending) == ((), ())
    assert one.statistics.values["loads_started"] == 16


@pytest.mark.parametrize("what", ["rewritten", "moved", "removed", "all"])
def test_a_reload_checks_the_segments_of_what_changed(inner: Inner, small_map: DividedMap, what: str) -> None:
    """Segments are warm exactly if they are current, also where a layer reads the cells around."""
    open3d_or_skip()
    layers = ("points", "denoise(neighbors=5,halo=1.0)")
    one = inner(small_map.root)
    everything = Area(1, EVERYWHERE, layers, wait=600.0)
    assert len(one.cells_for(everything).cells) == 32
    if what == "removed":
        small_map.remove_cell("0_0.pcd")
    elif what == "moved":  # to another neighbour
        small_map.corners["0_0.pcd"] = (-60, -60)
    else:
        for name in list(small_map.corners) if what == "all" else ["0_0.pcd"]:
            rewrite(small_map, name, 33)
    small_map.write_metadata()
    one.reload()
    assert one.cache.unentered == (32 if what in ("removed", "all") else 2)
    while one.map_switch.next_s <= one.now_s():
        one.map_switch.run_step(one.now_s())
    residents = list(one.ledger.residents())
    warm = {resident for table in one.cache.warm.layers.values() for resident in table.values()}
    assert warm == {resident for resident in residents if one.cache.is_current(resident)}
    # of the 16 denoised ones, 9 around the old place are not, nor 1 at the new one
    assert len(warm) == {"rewritten": 15 + 7, "moved": 15 + 6, "removed": 15 + 7, "all": 0}[what]
    for index in range(len(one.cache.catalogue)):
        points = one.cache.warm.get(index, "points")
        assert (one.cache.heights.get(index) is None) == (points is None)
    again = one.cells_for(Area(2, EVERYWHERE, layers, wait=600.0))
    assert not any(cell.stale for cell in again.cells)
    assert len(one.cache.warm) == len(again.cells) == 32 - 2 * (what == "removed")


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
        reply = one.everything(turn + 1)
        assert not any(cell.stale for cell in reply.cells)
        versions.append([cell.version for cell in reply.cells])
        if not mapped:
            for cell in reply.cells:
                with open(one.path_of(cell.segment), "rb") as file:
                    mapped.append(mmap.mmap(file.fileno(), 0, prot=mmap.PROT_READ))
        assert one.ledger.resident_count == 16
        assert {resident.name for resident in one.ledger.by_key.values()} == {
            resident.name for resident in one.ledger.residents()
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
    one.everything()
    assert one.cells_for(Area(2, high, wait=30.0), session).cells == ()
    columns = random_points(np.random.default_rng(1), (0, 0), 20)
    columns["z"] = columns["z"] + np.float32(52.0)
    small_map.write_cell("0_0.pcd", (0, 0), columns)
    one.reload()
    assert names(one.cells_for(Area(3, high, wait=30.0), session)) == ["0_0.pcd"]
    assert one.cells_for(Differential(4, CircleMessage(10, 10, 1, 0.0, 8.0), wait=30.0), session).cells == ()


def test_moved_cells_are_loaded_again_with_their_box(inner: Inner, small_map: DividedMap) -> None:
    one = inner(small_map.root)
    one.everything()
    evicted = one.cache.warm.layers["points"][one.cache.index_of("0_0.pcd") or 0]
    with open(one.path_of(evicted.name.rsplit(".", 1)[1]), "rb") as held:
        one.reclaimer.retire(evicted, one.now_s())  # retired while it moves
        small_map.corners["0_0.pcd"] = (400, 400)
        small_map.corners["20_20.pcd"] = (500, 500)
        small_map.write_metadata()
        one.reload()
        reply = one.cells_for(Selected(2, ("0_0.pcd", "20_20.pcd"), wait=30.0))
        held.close()
    assert [(cell.min_x, cell.min_y) for cell in reply.cells] == [(400.0, 400.0), (500.0, 500.0)]
    for cell in reply.cells:
        assert parse(map_segment(one.path_of(cell.segment))).fields["box"][:2] == (cell.min_x, cell.min_y)


def test_an_empty_map(inner: Inner, small_map: DividedMap) -> None:
    one = inner(small_map.root)
    before = one.everything()
    empty = Catalogue.from_cells([])
    one.map_switch.switch(empty, empty.changes_from(one.cache.catalogue))
    one.scheduler.map_changed()
    assert one.everything(2) == Cells(2, one.cache.epoch, empty.map_version, layers=("points",))
    packed = b"".join(cell.version.to_bytes(8, "little") for cell in before.cells)
    assert sorted(one.cells_for(Differential(3, EVERYWHERE, packed=packed)).removed_packed) == sorted(packed)
    welcome = one.queries.welcome(one.session(), Hello(4, 2, 0))
    assert (welcome.cells, welcome.bounds) == (0, None)
    one.run_until(lambda: one.ledger.used_bytes == one.ledger.overhead_bytes)
    one.reload()
    assert len(one.everything(5).cells) == 16
