# SPDX-License-Identifier: Apache-2.0
"""When defects are too many to go on."""

from __future__ import annotations

import logging
from collections import Counter
from typing import cast

import pytest

from shmmap.daemon.requests.dispatch import MAX_DEFECTS, WITHIN_S, Defects
from shmmap.statistics.writer import StatisticsWriter


class Counts(Counter[str]):
    def add(self, name: str) -> None:
        self[name] += 1


def here(defects: Defects) -> bool:
    try:
        raise RuntimeError("here")
    except RuntimeError:
        return defects.record()


def there(defects: Defects) -> bool:
    try:
        raise RuntimeError("there")
    except RuntimeError:
        return defects.record()


def test_a_hundred_defects_in_ten_seconds_at_one_place(caplog: pytest.LogCaptureFixture) -> None:
    """That many are too many; those of another place, or over a longer time, are not."""
    caplog.set_level(logging.ERROR, "shmmap")
    now_s, counts = 0.0, Counts()
    defects = Defects(cast("StatisticsWriter", counts), lambda: now_s)
    for number in range(3 * MAX_DEFECTS):
        now_s = number * (WITHIN_S / (MAX_DEFECTS - 1) + 0.001)
        assert not here(defects)
    now_s += 2 * WITHIN_S
    assert not any(here(defects) or there(defects) for _ in range(MAX_DEFECTS - 1))
    assert here(defects)
    assert counts == {"defects": 5 * MAX_DEFECTS - 1}
    assert 3 < len(caplog.records) <= 6 + 2
    assert "there" in caplog.text
