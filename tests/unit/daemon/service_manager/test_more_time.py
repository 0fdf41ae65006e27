# SPDX-License-Identifier: Apache-2.0
"""A start that takes long asks for more time, and no longer than it takes."""

from __future__ import annotations

import threading

import pytest

from shmmap.daemon.service_manager import more_time
from shmmap.daemon.service_manager.more_time import MoreTime


def test_it_asks_while_it_lasts() -> None:
    told: list[tuple[str, ...]] = []
    twice = threading.Event()

    def tell(*lines: str) -> None:
        told.append(lines)
        if len(told) == 2:
            twice.set()

    with MoreTime(tell, "reading the map", every_s=0.0):
        assert twice.wait(60.0)
    count = len(told)
    assert set(told) == {("STATUS=reading the map", "EXTEND_TIMEOUT_USEC=60000000")}
    assert more_time.EVERY_S < more_time.MORE_S / 2
    assert threading.active_count() == 1 or all(t.name != "more time" for t in threading.enumerate())
    assert len(told) == count


def test_what_hangs_gets_no_more_in_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(more_time, "MOST_S", -1.0)
    told: list[tuple[str, ...]] = []
    one = MoreTime(lambda *lines: told.append(lines), "reading the map", every_s=0.0)
    with one:
        one._thread.join(60.0)
        assert not one._thread.is_alive()
    assert not told


def test_an_error_comes_through() -> None:
    with pytest.raises(OSError, match="no map"), MoreTime(lambda *_: None, "reading the map"):
        raise OSError("no map")
