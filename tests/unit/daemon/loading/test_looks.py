# SPDX-License-Identifier: Apache-2.0
"""Files of cells that failed are looked at by loaders, never by the serving loop."""

from __future__ import annotations

import os
from typing import Any

import pytest

from shmmap.protocol.messages import Selected
from tests.support.divided_map import DividedMap
from tests.unit.daemon.inner_daemon import Inner, InnerDaemon

CELL = "0_0.pcd"


def ask(one: InnerDaemon, request: int, wait_s: float | None = 30.0) -> None:
    one.ask(one.session(), Selected(request, (CELL,), wait=wait_s))


@pytest.fixture
def broken(inner: Inner, small_map: DividedMap, monkeypatch: pytest.MonkeyPatch) -> InnerDaemon:
    """Return a daemon that has failed to load a cell; its loop may not look at the map any more."""
    (small_map.pcd_dir / CELL).write_bytes(b"no point cloud")
    one = inner(small_map.root)
    one.stop_clock()
    ask(one, 1)
    assert [failure.code for failure in one.cells_of(1).failed] == ["load_failed"]

    def guarded(look: Any) -> Any:
        def looked(path: Any, *arguments: Any, **options: Any) -> Any:
            assert not str(path).startswith(str(small_map.root)), f"the loop looks at {path}"
            return look(path, *arguments, **options)

        return looked

    for name in ("stat", "lstat", "open"):
        monkeypatch.setattr(os, name, guarded(getattr(os, name)))
    return one


def test_an_unchanged_file_is_not_loaded_again(broken: InnerDaemon) -> None:
    started = broken.statistics.values["loads_started"]
    ask(broken, 2)
    assert [failure.code for failure in broken.cells_of(2).failed] == ["load_failed"]
    assert broken.statistics.values["loads_started"] == started, "a look is no load"
    assert not broken.loads.by_key


def test_a_request_without_wait_is_answered_at_once(broken: InnerDaemon, small_map: DividedMap) -> None:
    """And a loader is sent to look, so that the next one gets the mended file."""
    with broken.loaders_standing_still():
        ask(broken, 2, wait_s=None)
        (reply,) = [reply for _, reply in broken.replies if reply.request == 2]
        assert [failure.code for failure in reply.failed] == ["load_failed"]
        assert not reply.pending
        (load,) = broken.loads.by_key.values()
        assert load.unless is not None
        small_map.change(CELL, 5)
    ask(broken, 3)
    assert len(broken.cells_of(3).cells) == 1
    assert not broken.loads.failures
