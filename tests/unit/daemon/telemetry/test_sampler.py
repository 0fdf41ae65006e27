# SPDX-License-Identifier: Apache-2.0
"""Beats while cells come and go write what has changed, and nothing else."""

from __future__ import annotations

from typing import Any

import pytest

from shmmap.daemon.telemetry.sampler import BEAT_S, CHANGE_BEAT_S, Sampler
from tests.support.divided_map import DividedMap
from tests.unit.daemon.inner_daemon import Inner


def test_a_change_is_written_soon_and_what_was_only_used_with_the_next_whole_beat(
    inner: Inner, small_map: DividedMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = inner(small_map.root)
    one.everything()
    whole: list[float] = []
    sampler = Sampler(one.cache, one.scheduler, one.event_log, one.sessions, (), lambda: whole.append(now_s))
    written: list[str] = []
    write = one.statistics._write_row

    def noted(slot: int, packed: bytes) -> bool:
        written.extend(str(name) for name, at in one.statistics._slots.items() if at == slot)
        return write(slot, packed)

    monkeypatch.setattr(one.statistics, "_write_row", noted)
    now_s = 1000.0
    sampler.turn(now_s)
    assert whole == [1000.0]
    residents: list[Any] = list(one.ledger.residents())
    one.cache.used.update(residents)
    one.cache.rows.show(residents[0], "resident")
    written.clear()
    sampler.turn(now_s := 1000.0 + CHANGE_BEAT_S / 2)
    assert written == []
    sampler.turn(now_s := 1000.0 + CHANGE_BEAT_S)
    assert written == [residents[0].name]
    sampler.turn(now_s := 1000.0 + BEAT_S / 2)
    assert (written, whole) == ([residents[0].name], [1000.0])
    sampler.turn(now_s := 1000.0 + BEAT_S)
    assert set(written) == {resident.name for resident in residents}
    assert whole == [1000.0, 1000.0 + BEAT_S]
