# SPDX-License-Identifier: Apache-2.0
"""Memory of a state of the map that is served no more goes back; nothing that is still served does."""

from __future__ import annotations

import mmap
import select
import threading
from pathlib import Path

import numpy as np
import pytest

from shmmap.daemon.map.catalogue_reload import Reloader, Reread
from shmmap.daemon.map.catalogue_view import CatalogueView
from shmmap.daemon.map.old_tables import give_back
from shmmap.origin.catalogue import Catalogue

CELLS = 1 << 18


def resident_bytes() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * mmap.PAGESIZE


def state(before: Catalogue | None = None, shift: float = 0.0) -> Catalogue:
    """A state of a map of a row of cells; names and boxes are those of the one before it, unless shifted."""
    corners = np.column_stack((np.arange(CELLS) * 20.0 + shift, np.zeros(CELLS)))
    same = before is not None and not shift
    return Catalogue(
        id_prefix="/m/",
        names=before.names if before is not None else np.arange(10**6, 10**6 + CELLS).astype("S7"),
        boxes=before.boxes if before is not None and same else np.hstack((corners, corners + 20.0)),
        stamps=np.ones((CELLS, 3), np.int64),
        before=before,
    )


def test_the_old_stamps_go_and_all_else_stays() -> None:
    old = state()
    new = state(old)
    version = new.map_version
    before = resident_bytes()
    give_back(old, new)
    assert before - resident_bytes() > 0.9 * old.stamps.nbytes
    assert old.id(CELLS - 1) == new.id(CELLS - 1) == f"/m/{10**6 + CELLS - 1}"
    assert new.boxes[-1].tolist() == [(CELLS - 1) * 20.0, 0.0, CELLS * 20.0, 20.0]
    assert np.all(new.stamps == 1)
    again = Catalogue(id_prefix="/m/", names=new.names, boxes=new.boxes, stamps=new.stamps)
    assert again.map_version == version


def test_boxes_go_with_them_where_the_map_has_others() -> None:
    old = state()
    new = state(old, shift=5.0)
    before = resident_bytes()
    give_back(old, new)
    assert before - resident_bytes() > 0.9 * (old.stamps.nbytes + old.boxes.nbytes)
    assert old.id(7) == new.id(7)
    assert new.boxes[0].tolist() == [5.0, 0.0, 25.0, 20.0]


def test_the_state_that_is_served_is_left_alone() -> None:
    """Also where it has the same memory as another array."""
    one = state()
    give_back(one, one)
    same = Catalogue(id_prefix="/m/", names=one.names, boxes=one.boxes[:], stamps=one.stamps[:])
    give_back(one, same)
    assert np.all(one.stamps == 1)
    assert np.all(one.boxes[:, 3] == 20.0)


def collected(reloader: Reloader, served: list[CatalogueView], *, takes_over: bool) -> None:
    """Have the map read again, and do what the loop does; wait until the threads of it have ended."""
    reloader.ask(lambda _: None)
    assert select.select([reloader.fd], [], [], 60.0)[0]

    def apply(found: Reread) -> Reread:
        if takes_over:
            served[0] = found.catalogue
        return found

    reloader.collect(apply, lambda _: None)
    for thread in threading.enumerate():
        if thread.name == "giving back":
            thread.join(60.0)


@pytest.mark.parametrize("takes_over", [True, False])
def test_a_reload_gives_back_what_is_served_no_more(takes_over: bool) -> None:
    old = state()
    served: list[CatalogueView] = [old]

    class Origin:
        path = "/m"

        def load(self, *, fresh: bool = False, before: object | None = None) -> Catalogue:
            assert fresh
            assert before is old
            return state(old)

    reloader = Reloader(Origin(), lambda: served[0])
    try:
        collected(reloader, served, takes_over=takes_over)
    finally:
        reloader.close()
    left = np.count_nonzero(old.stamps)  # parts of pages at the ends may stay
    assert left < 1024 if takes_over else left == old.stamps.size
    now = served[0].tables
    assert now is not None
    assert np.all(now.stamps == 1)
