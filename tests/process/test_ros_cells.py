# SPDX-License-Identifier: Apache-2.0
"""What nodes for ROS 2 share, against real daemons: names, answers, changed cells."""

from __future__ import annotations

import contextlib
import math
import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from shmmap_clients.ros_cells import (
    Answer,
    Catalogue,
    CellAnswers,
    RecentCells,
    StillLoading,
    cell_name,
    cloud_layout,
    fill_rows,
    follow_events,
    joined_cells,
    split_name,
)
from shmmap_clients.ros_cells import answers as answers_module

import shmmap
from tests.process.conftest import DaemonFactory
from tests.support.daemon_process import DaemonProcess, until
from tests.support.divided_map import DividedMap, make_map

NEAR = (3.0, -4.0, 15.0)


def area(x: float, y: float, radius: float) -> Any:
    return SimpleNamespace(center_x=x, center_y=y, radius=radius)


class Node:
    """A node that answers for one daemon, as often as it takes until the cells are there."""

    def __init__(self, one: DaemonProcess, **options: Any) -> None:
        self.client = shmmap.connect(one.endpoint)
        self.catalogue = Catalogue()
        self.answers = CellAnswers(self.catalogue, RecentCells(), **options)

    def repeated(self, ask: Callable[[], Answer]) -> Answer:
        found: list[Answer] = []

        def has_answered() -> bool:
            try:
                found.append(ask())
            except StillLoading:
                return False
            return True

        until(has_answered)
        return found[0]

    def partial(self, *where: float, last: bool = False) -> Answer:
        return self.repeated(lambda: self.answers.partial(self.client, area(*where), last))

    def differential(self, ids: Iterable[str], *where: float, last: bool = False) -> Answer:
        listed = list(ids)
        return self.repeated(
            lambda: self.answers.differential(self.client, area(*(where or NEAR)), listed, last)
        )

    def selected(self, ids: Sequence[str], *, last: bool = False) -> Answer:
        return self.repeated(lambda: self.answers.selected(self.client, ids, last))


@pytest.fixture
def nodes() -> Iterator[Callable[..., Node]]:
    made: list[Node] = []

    def make(one: DaemonProcess, **options: Any) -> Node:
        made.append(Node(one, **options))
        return made[-1]

    yield make
    for one in made:
        one.client.close()


Nodes = Callable[..., Node]


def names(town: DividedMap, node: Node, files: Iterable[str]) -> list[str]:
    """Names of files at the versions that the daemon has now."""
    node.catalogue.refresh(node.client)
    return [cell_name(town.id(one), node.catalogue.versions[town.id(one)]) for one in files]


# --- the three requests -------------------------------------------------------------------------------


def test_three_requests(standing: DaemonProcess, standing_map: DividedMap, nodes: Nodes) -> None:
    node = nodes(standing)
    near = sorted(standing_map.in_square(*NEAR), key=standing_map.id)
    all_names = names(standing_map, node, near)
    found = node.partial(*NEAR)
    assert (found.names, found.removed, found.left_out, found.too_large) == (all_names, [], [], 0)
    assert [cell.id for cell in found.cells] == [standing_map.id(one) for one in near]
    assert [split_name(one) for one in found.names] == [(cell.id, cell.version) for cell in found.cells]
    (far,) = names(standing_map, node, ["40_40.pcd"])
    has = [all_names[1], "gone.pcd", far, all_names[2], far, f"/nowhere.pcd@{5:016x}"]
    found = node.differential(has)
    assert found.names == [one for one in all_names if one not in has]
    assert found.removed == ["gone.pcd", far, has[-1]]
    assert node.differential(all_names).names == node.differential(all_names).removed == []
    wanted = [far, "unknown", standing_map.id(near[0]), far]
    found = node.selected(wanted)
    assert found.names == [far, all_names[0], far]
    assert len(found.left_out) == 1
    assert "unknown" in found.problem
    assert node.selected([]) == Answer()
    assert node.selected(["40_40.pcd"]).names == [far], "the file's name alone"


def test_the_list_has_the_names_of_the_answers(
    standing: DaemonProcess, standing_map: DividedMap, nodes: Nodes
) -> None:
    node, plain = nodes(standing), nodes(standing, plain_ids=True)
    found = node.partial(0, 0, 1e6)
    assert found.names == node.catalogue.names()
    assert plain.partial(0, 0, 1e6).names == node.catalogue.names(plain_ids=True)
    assert node.catalogue.boxes().tolist() == [
        list(standing_map.box(Path(one).name)) for one in node.catalogue.cells
    ]


def test_areas_that_make_no_sense(standing: DaemonProcess, nodes: Nodes) -> None:
    """As Autoware answers them, without an error."""
    node = nodes(standing)
    node.catalogue.refresh(node.client)
    everything = node.catalogue.names()
    inside = [one for one in everything if "/0_0.pcd@" in one]
    has = ["x", *inside, next(one for one in everything if "/20_0.pcd@" in one)]
    for where, wanted in {
        (0.0, 0.0, math.inf): everything,
        (math.inf, math.nan, math.inf): everything,
        (math.nan, 0.0, 100.0): [],
        (0.0, 0.0, math.nan): [],
        (10.0, 10.0, -5.0): inside,
        (10.0, 10.0, -11.0): [],
        (3e38, 3e38, 5.0): [],
    }.items():
        assert node.partial(*where).names == wanted, where
        found = node.differential(has, *where)
        assert found.names == [one for one in wanted if one not in has], where
        assert found.removed == [one for one in has if one not in wanted], where


def test_requests_in_slices_are_answered_as_those_in_one(
    standing: DaemonProcess, nodes: Nodes, monkeypatch: pytest.MonkeyPatch
) -> None:
    node = nodes(standing)
    whole = node.partial(0, 0, 1e6)
    has = [whole.names[3], "no", *whole.names[:2], f"{whole.cells[5].id}@{1:016x}", whole.cells[7].id]
    one = [node.differential(has, *where) for where in (NEAR, (0.0, 0.0, 1e6))]
    ids = [*whole.names, "unknown", *whole.names]
    selected = node.selected(ids)
    monkeypatch.setattr(answers_module, "_SLICE_CELLS", 3)
    assert node.partial(0, 0, 1e6) == whole
    assert [node.differential(has, *where) for where in (NEAR, (0.0, 0.0, 1e6))] == one
    assert node.selected(ids).names == selected.names == whole.names * 2


# --- changed cells ------------------------------------------------------------------------------------


def change(node: Node, town: DividedMap, file: str, seed: int) -> None:
    town.change(file, seed)
    node.client.reload()


def test_a_changed_cell_comes_once_to_each_requester(
    served: DaemonProcess, divided_map: DividedMap, nodes: Nodes
) -> None:
    """Also to one that holds the old one yet, and over restarts of node and daemon."""
    node = nodes(served)
    caches = [set(node.partial(*NEAR).names) for _ in range(3)]
    file = "0_0.pcd"
    for seed, restart in enumerate((False, False, True), start=7):
        (old,) = names(divided_map, node, [file])
        change(node, divided_map, file, seed)
        (new,) = names(divided_map, node, [file])
        assert new != old
        if restart:
            served.kill()
            served.start()
        node = nodes(served)  # another one, that knows nothing of the requesters
        for cache in caches:
            found = node.differential(sorted(cache))
            assert (found.names, found.removed) == ([new], [old])
            assert found.cells[0]["xyz"][:, 0].tolist() == divided_map.points(file)["x"].tolist()
            cache -= set(found.removed)
            cache |= set(found.names)
            assert node.differential(sorted(cache)).names == []
            assert node.differential(sorted(cache)).removed == []
    assert node.selected([old, new]).names == [new, new], "whichever version is named"


def test_a_requester_that_keeps_the_old_name_drops_it_again(
    served: DaemonProcess, divided_map: DividedMap, nodes: Nodes
) -> None:
    """And never the present one, though the node's list of cells is an older one."""
    node = nodes(served)
    (old,) = names(divided_map, node, ["0_0.pcd"])
    behind = nodes(served)
    behind.catalogue.refresh(behind.client)
    change(node, divided_map, "0_0.pcd", 3)
    (new,) = names(divided_map, node, ["0_0.pcd"])
    for one in (node, behind):
        for has in ([old, new], [new, old], [new, divided_map.id("0_0.pcd"), old]):
            found = one.differential(has, 10, 10, 5)
            assert (found.names, found.removed) == ([], [one for one in has if one != new])


def test_plain_ids_of_a_cache_are_outdated(
    standing: DaemonProcess, standing_map: DividedMap, nodes: Nodes
) -> None:
    """Their version is not known, so that the cell comes under its name."""
    node = nodes(standing)
    (name,) = names(standing_map, node, ["0_0.pcd"])
    far = standing_map.id("40_40.pcd")
    for has in (standing_map.id("0_0.pcd"), "0_0.pcd"):
        found = node.differential([has, far], 10, 10, 5)
        assert name in found.names
        assert found.removed == [has, far]


def test_an_old_cell_stays_where_the_new_one_cannot_be_had(
    served: DaemonProcess, divided_map: DividedMap, nodes: Nodes
) -> None:
    node = nodes(served)
    all_names = names(divided_map, node, divided_map.in_square(*NEAR))
    path = Path(divided_map.id("0_0.pcd"))
    path.write_bytes(b"this is no cloud")
    node.client.reload()
    found = node.differential(all_names)
    assert (found.names, found.removed) == ([], [])
    assert len(found.left_out) == 1
    assert str(path) in found.problem


def test_with_plain_ids_a_change_goes_unnoticed(
    served: DaemonProcess, divided_map: DividedMap, nodes: Nodes
) -> None:
    """As with Autoware's loader: this is what is given up."""
    node = nodes(served, plain_ids=True)
    found = node.partial(*NEAR)
    assert found.names == sorted(divided_map.id(one) for one in divided_map.in_square(*NEAR))
    change(node, divided_map, "0_0.pcd", 5)
    again = node.differential([*found.names, "gone", divided_map.id("40_40.pcd")])
    assert (again.names, again.removed) == ([], ["gone", divided_map.id("40_40.pcd")])
    named = cell_name(found.names[0], 5)
    again = node.differential([named])
    assert (again.names, again.removed) == (found.names, [named])
    assert node.selected(found.names[:1]).names == found.names[:1]


def test_paths_may_have_what_names_have(daemon: DaemonFactory, nodes: Nodes, tmp_path: Path) -> None:
    town = make_map(tmp_path / f"a@b@{3:016x}" / f"c@{1:016x}", columns=2, rows=2)
    random = town.points("0_0.pcd")
    odd = f"x.pcd@{2:016x}.pcd"
    town.write_cell(odd, (40, 40), random)
    town.write_metadata()
    node = nodes(daemon(town.root))
    found = node.partial(0, 0, 1e6)
    assert [split_name(one)[0] for one in found.names] == sorted(town.id(one) for one in town.corners)
    assert node.differential(found.names, 0, 0, 1e6) == Answer()
    assert node.selected(found.names).names == found.names
    assert node.selected([town.id(one) for one in sorted(town.corners, key=town.id)]).names == found.names
    change(node, town, odd, 9)
    old = next(one for one in found.names if odd in one)
    again = node.differential(found.names, 0, 0, 1e6)
    assert again.removed == [old]
    assert [cell.id for cell in again.cells] == [town.id(odd)]


# --- cells that are not there -------------------------------------------------------------------------


def test_no_thread_waits_for_cells(served: DaemonProcess, divided_map: DividedMap, nodes: Nodes) -> None:
    """A request raises until an event says that there is more; the last one takes what is there."""
    node = nodes(served)
    warm = node.partial(-50, -50, 2)
    assert warm.cells
    loaders = served.stop_loaders()
    where = area(50.0, 50.0, 2.0)
    with pytest.raises(StillLoading):
        node.answers.partial(node.client, where, False)
    assert node.partial(-50, -50, 2) == warm, "others are answered meanwhile"
    with pytest.raises(StillLoading):
        node.answers.differential(node.client, where, warm.names, False)
    last = node.answers.differential(node.client, where, warm.names, True)
    assert (last.names, last.removed) == ([], warm.names)
    assert [one.endswith("not loaded in time") for one in last.left_out] == [True]
    stop, woken = threading.Event(), threading.Event()
    follower = threading.Thread(target=follow_events, args=(served.endpoint, stop, woken.set))
    follower.start()
    assert woken.wait(60), "when it begins"
    woken.clear()
    for pid in loaders:
        os.kill(pid, signal.SIGCONT)
    assert woken.wait(60), "by the daemon's event"
    assert node.partial(50.0, 50.0, 2.0).cells
    served.kill()
    woken.clear()
    served.start()
    assert woken.wait(60), "when the daemon is back"
    stop.set()
    follower.join()


def test_what_others_hold_is_waited_for_rather_than_an_empty_answer(
    daemon: DaemonFactory, nodes: Nodes, tmp_path: Path
) -> None:
    town = make_map(tmp_path / "map", columns=4, rows=4, points=60_000)
    one = daemon(town.root, "--budget", "6M")
    node, everything = nodes(one), sorted(map(town.id, town.corners))
    holders = [shmmap.connect(one.endpoint) for _ in range(2)]
    held = [cell for some in holders for cell in some.selected(everything, wait=5, strict=None)]
    missing = sorted(set(everything) - {cell.id for cell in held})
    assert held
    assert missing
    waits = ""
    while not waits:  # what is being loaded comes to nothing
        with contextlib.suppress(StillLoading):
            node.answers.selected(node.client, missing, False)
        try:
            assert not node.answers.selected(node.client, missing, True).cells
        except StillLoading as error:
            waits = str(error)
    assert waits.startswith("none of its cells can be had: ")
    some = node.answers.selected(node.client, [held[0].id, *missing], True)
    assert [cell.id for cell in some.cells] == [held[0].id]
    assert len(some.left_out) == len(missing)
    del some, held
    for holder in holders:
        holder.close()
    assert node.selected(missing[:1]).cells


def test_what_is_too_large_is_the_nearest_that_fits(
    standing: DaemonProcess, nodes: Nodes, monkeypatch: pytest.MonkeyPatch
) -> None:
    everything = nodes(standing).partial(0, 0, 1e6)
    cell_bytes = 500 * 16
    node = nodes(standing, max_bytes=(1 << 16) + 5 * (cell_bytes + 1000))

    def distance(cell: shmmap.Cell) -> float:
        low_x, low_y, high_x, high_y = cell.box
        return math.hypot(max(low_x - 31, 31 - high_x, 0), max(low_y - 32, 32 - high_y, 0))

    found = node.partial(31, 32, 1e6)
    assert found.too_large == len(everything.cells) - len(found.cells)
    assert len(found.cells) == 5
    assert "do not fit" in found.problem
    nearest = sorted(everything.cells, key=distance)[:5]
    assert {cell.id for cell in found.cells} == {cell.id for cell in nearest}
    assert found.names == sorted(found.names)
    rest = node.differential(found.names, 31, 32, 1e6)
    assert len(rest.names) == 5
    assert not set(rest.names) & set(found.names), "the next ones"
    assert node.selected(everything.names * 2).names == everything.names[:5]
    none = nodes(standing, max_bytes=1 << 16).partial(*NEAR)
    assert (none.cells, none.too_large) == ([], 4)
    monkeypatch.setattr(answers_module, "_SLICE_CELLS", 2)
    assert node.partial(31, 32, 1e6).names == found.names
    assert node.selected(everything.names * 2).names == everything.names[:5]
    monkeypatch.setattr(answers_module, "_MAX_CELLS", 3)
    assert node.selected(everything.names[:5]).names == everything.names[:3]
    assert node.selected(everything.names[:5]).too_large == 2


def test_all_points_as_one_cloud(standing: DaemonProcess, standing_map: DividedMap, nodes: Nodes) -> None:
    node = nodes(standing)
    node.catalogue.refresh(node.client)
    cells = node.catalogue.cells.values()
    layout, points, data = joined_cells(node.client, cells, wait_s=60)
    rows = [standing_map.points(Path(cell.id).name) for cell in cells]
    assert points == sum(len(one["x"]) for one in rows)
    table = np.frombuffer(data, "<f4").reshape(points, 4)
    for n, axis in enumerate(("x", "y", "z", "intensity")):
        assert table[:, n].tolist() == np.concatenate([one[axis] for one in rows]).tolist()
    first = node.client.selected(next(iter(cells)).id)[0]
    assert layout == cloud_layout(first.columns)
    place = bytearray(first.points * layout.point_step)
    with memoryview(place) as whole:
        fill_rows(whole, first.columns, first.origin, layout)
    assert place == bytes(data[: len(place)])
    with pytest.raises(shmmap.BadRequest, match="whole map takes about"):
        joined_cells(node.client, cells, max_bytes=100_000, wait_s=60)
    voxels = joined_cells(node.client, cells, "voxel(leaf=3)", wait_s=60)
    assert 0 < voxels[1] < points
