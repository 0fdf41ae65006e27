# SPDX-License-Identifier: Apache-2.0
"""What was evicted to make room is known once, and the oldest is forgotten."""

from __future__ import annotations

import pytest

from shmmap.daemon.events.eviction_history import EvictionHistory
from shmmap.daemon.records import Key


def test_what_was_evicted_is_known_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shmmap.daemon.events.eviction_history.LIMIT", 3)
    history = EvictionHistory()
    for number in range(5):
        history.evicted(Key(f"{number}", "points"), number)
    assert len(history) == 3
    assert not history.loaded(Key("0", "points"), 0)  # forgotten
    assert history.loaded(Key("3", "points"), 3)
    assert not history.loaded(Key("3", "points"), 3)  # it was just brought back
    assert not history.loaded(Key("4", "points"), 99)  # it changed meanwhile
