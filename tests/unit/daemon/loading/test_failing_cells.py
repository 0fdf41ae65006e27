# SPDX-License-Identifier: Apache-2.0
"""Cells that fail: when they are tried again, and that no file is looked at by the serving loop."""

from __future__ import annotations

import os
from collections.abc import Callable
from itertools import count
from pathlib import Path
from typing import Any

import pytest

from shmmap import MapWindow, Offline, connect
from shmmap.daemon.cache.ledger import Ledger
from shmmap.daemon.loading import loads
from shmmap.daemon.loading.loads import Attempt, FailedFileCheck, Loads
from shmmap.daemon.records import Failure, Key
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
    reply = one.cells_for(Selected(request, (CELL,), wait=30.0))
    return [Path(cell.id).name for cell in reply.cells] + [failed.code for failed in reply.failed]


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
    reply = one.cells_for(Differential(2, EVERYWHERE, packed=packed, wait=30.0))
    assert (reply.cells, reply.removed, reply.removed_packed) == ((), (), b"")
    assert [failed.code for failed in reply.failed] == ["offline"]
    fresh = one.everything(3)  # who has none of it gets the old one, marked
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


def test_who_gives_up_ends_as_with_a_busy_daemon(
    whole: Callable[..., WholeDaemon], small_map: DividedMap, out_of_reach: Path
) -> None:
    assert out_of_reach.exists()
    one = whole(small_map.root)
    with one.turning(), connect(one.endpoint) as client, pytest.raises(Offline) as refused:
        client.selected(CELL, wait=60.0).raise_for_failures()
    assert (refused.value.cell_id, refused.value.exit_code) == (small_map.id(CELL), 75)
    assert "ask again" in refused.value.hint


@pytest.fixture
def broken(inner: Inner, small_map: DividedMap, monkeypatch: pytest.MonkeyPatch) -> InnerDaemon:
    """Return a daemon that has failed to load a cell; its loop may not look at the map any more."""
    (small_map.pcd_dir / CELL).write_bytes(b"no point cloud")
    one = inner(small_map.root)
    one.stop_clock()
    assert ask(one, 1) == ["load_failed"]

    def guarded(look: Any) -> Any:
        def looked(path: Any, *arguments: Any, **options: Any) -> Any:
            assert not str(path).startswith(str(small_map.root)), f"the loop looks at {path}"
            return look(path, *arguments, **options)

        return looked

    for name in ("stat", "lstat", "open"):
        monkeypatch.setattr(os, name, guarded(getattr(os, name)))
    return one


def test_a_request_that_does_not_wait_is_answered_at_once(broken: InnerDaemon, small_map: DividedMap) -> None:
    """And a loader is sent to look, so that the next one gets the mended file."""
    with broken.loaders_standing_still():
        broken.ask(broken.session(), Selected(2, (CELL,)))
        (reply,) = [reply for _, reply in broken.replies if reply.request == 2]
        assert [failure.code for failure in reply.failed] == ["load_failed"]
        assert not reply.pending
        (load,) = broken.loads.by_key.values()
        assert isinstance(load.work, FailedFileCheck)
        small_map.change(CELL, 5)
    assert ask(broken, 3) == [CELL]
    assert not broken.loads.failures


def test_a_bad_file_is_tried_again_later_and_later(inner: Inner, small_map: DividedMap) -> None:
    """After 1, 2, 4, ... and at most 30 seconds, however often clients ask; at once when it changed."""
    path = small_map.pcd_dir / "0_0.pcd"
    whole = path.read_bytes()
    path.write_bytes(whole[:-3])
    one = inner(small_map.root)
    one.stop_clock()
    requests = count(1)

    def tries() -> int:
        before = one.statistics.values["loads_started"]
        assert [ask(one, next(requests)) for _ in range(3)] == [["load_failed"]] * 3
        return one.statistics.values["loads_started"] - before

    assert tries() == 1
    for delay_s in (1, 2, 4, 8, 16, 30, 30):
        one.offset_s += delay_s - 0.01
        assert tries() == 0
        one.offset_s += 0.02
        assert tries() == 1
    path.write_bytes(whole)
    assert ask(one, next(requests)) == [CELL]


def test_a_file_that_kills_its_loader_is_tried_again_later_and_later(
    inner: Inner, small_map: DividedMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each try costs a loader: that a client asks again is no reason for another one."""
    monkeypatch.setenv("SHMMAP_TEST_WORKER", "crash:0_0.pcd")
    one = inner(small_map.root)
    one.stop_clock()
    for request, (passed_s, crashes) in enumerate([(0.0, 1), (0.99, 1), (0.02, 2), (1.98, 2), (0.03, 3)]):
        one.offset_s += passed_s
        assert ask(one, request) == ["load_failed"]
        assert one.statistics.values["worker_crashes"] == crashes
    path = small_map.pcd_dir / "0_0.pcd"
    path.write_bytes(path.read_bytes())
    ask(one, 99)
    assert one.statistics.values["worker_crashes"] == 4, "another state of the file is tried at once"


def test_failures_are_remembered_up_to_a_number(monkeypatch: pytest.MonkeyPatch) -> None:
    """The last ones of each kind; of those forgotten nothing stays."""
    monkeypatch.setattr("shmmap.daemon.loading.loads.MAX_FAILURES", 3)
    loads = Loads(Ledger(1 << 20))

    def fail(number: int, code: str) -> Key:
        key = Key(f"/{number}.pcd", "points")
        load = loads.want(key, 0, 1.0)
        assert loads.start(load, Attempt(0.0))
        loads.finish(load, Failure(code, "", None, 0.0, 0.0))
        return key

    broken = [fail(number, "load_failed") for number in (0, 1, 2, 0, 3, 4)]
    full = [fail(number, "no_space") for number in (5, 6)]
    assert set(loads.failures) == {broken[0], broken[4], broken[5], *full}
    loads.forget_refusals()
    assert set(loads.failures) == {broken[0], broken[4], broken[5]}
    assert not loads.by_key
