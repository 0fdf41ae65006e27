# SPDX-License-Identifier: Apache-2.0
"""Cells whose origin cannot be reached at present: they fail as ``offline`` and are tried again."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from shmmap import MapWindow, Offline, connect
from shmmap.daemon.loading import loads
from shmmap.protocol.codec import pack_versions
from shmmap.protocol.messages import Differential, Selected
from tests.support.divided_map import DividedMap
from tests.unit.daemon.inner_daemon import EVERYWHERE, Inner, InnerDaemon
from tests.unit.daemon.whole_daemon import WholeDaemon

CELL = "0_0.pcd"


@pytest.fixture
def out_of_reach(small_map: DividedMap, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file that keeps loaders from reaching where a cell comes from, as long as it is there."""
    monkeypatch.setenv("SHMMAP_TEST_WORKER", "offline:")
    mark = Path(small_map.id(CELL) + ".offline")
    mark.touch()
    return mark


def ask(one: InnerDaemon, request: int) -> list[str]:
    """Ask for the cell; return what came, or why it did not."""
    one.ask(one.session(), Selected(request, (CELL,), wait=30.0))
    reply = one.cells_of(request)
    return [Path(cell.id).name for cell in reply.cells] + [failed.code for failed in reply.failed]


def test_it_is_tried_again_after_a_pause(inner: Inner, small_map: DividedMap, out_of_reach: Path) -> None:
    one = inner(small_map.root)
    one.stop_clock()
    assert ask(one, 1) == ["offline"]
    started = one.statistics.values["loads_started"]
    assert ask(one, 2) == ["offline"]
    assert one.statistics.values["loads_started"] == started, "not at once"
    one.offset_s += 1.5
    assert ask(one, 3) == ["offline"]
    assert one.statistics.values["loads_started"] == started + 1
    out_of_reach.unlink()
    one.offset_s += 2.5
    assert ask(one, 4) == [CELL]
    assert not one.loads.failures


def test_others_are_not_concerned(inner: Inner, small_map: DividedMap, out_of_reach: Path) -> None:
    assert out_of_reach.exists()
    one = inner(small_map.root)
    reply = one.everything()
    assert len(reply.cells) == 15
    (failed,) = reply.failed
    assert (Path(failed.id).name, failed.code, failed.holders) == (CELL, "offline", ())
    assert reply.covered, "where the cell lies is known"


def test_an_old_version_stays_until_the_new_one_can_be_reached(
    inner: Inner, small_map: DividedMap, out_of_reach: Path
) -> None:
    out_of_reach.unlink()
    one = inner(small_map.root)
    held = one.everything(1)
    small_map.change(CELL, 3)
    one.reload()
    out_of_reach.touch()
    packed = pack_versions([cell.version for cell in held.cells])
    one.ask(one.session(), Differential(2, EVERYWHERE, packed=packed, wait=30.0))
    reply = one.cells_of(2)
    assert (reply.cells, reply.removed, reply.removed_packed) == ((), (), b"")
    assert [failed.code for failed in reply.failed] == ["offline"]
    fresh = one.everything(3)  # a client without it gets the old one, marked
    assert [Path(cell.id).name for cell in fresh.cells if cell.stale] == [CELL]


@pytest.mark.parametrize("background", [True, False])
def test_a_window_asks_until_it_comes(
    whole: Callable[..., WholeDaemon],
    small_map: DividedMap,
    out_of_reach: Path,
    monkeypatch: pytest.MonkeyPatch,
    background: bool,
) -> None:
    monkeypatch.setattr(loads, "FIRST_RETRY_S", 0.01)
    monkeypatch.setattr(loads, "LAST_RETRY_S", 0.05)
    one = whole(small_map.root)
    with (
        one.turning(),
        MapWindow(one.endpoint, 50.0, background=background, refresh_interval=1e9) as window,
    ):
        update = window.move_to(0.0, 0.0, wait=0.3)
        while len(window.cells) < 15 or update.pending:
            update = window.move_to(0.0, 0.0, wait=0.3)
        assert not window.wait_until_current(0.1)
        (failed,) = update.failed
        assert isinstance(failed, Offline)
        assert not update.complete
        out_of_reach.unlink()
        window.move_to(0.0, 0.0, wait=30.0)
        assert window.wait_until_current(30.0)
        assert (len(window.cells), window.complete) == (16, True)


def test_a_client_that_gives_up_ends_as_with_a_busy_daemon(
    whole: Callable[..., WholeDaemon], small_map: DividedMap, out_of_reach: Path
) -> None:
    assert out_of_reach.exists()
    one = whole(small_map.root)
    with one.turning(), connect(one.endpoint) as client, pytest.raises(Offline) as refused:
        client.selected(CELL, wait=60.0).raise_for_failures()
    assert (refused.value.cell_id, refused.value.exit_code) == (small_map.id(CELL), 75)
    assert "ask again" in refused.value.hint
