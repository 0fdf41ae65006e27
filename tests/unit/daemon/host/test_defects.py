# SPDX-License-Identifier: Apache-2.0
"""When one cannot go on, and what is logged."""

from __future__ import annotations

import logging
from collections import Counter
from typing import cast

import pytest

from shmmap.daemon.host.defects import MOST, WITHIN_S, Defects
from shmmap.statistics.writer import StatisticsWriter


class Counts(Counter[str]):
    def add(self, name: str, value: int = 1) -> None:
        self[name] += value


def here(defects: Defects) -> bool:
    try:
        raise RuntimeError("here")
    except RuntimeError:
        return defects.met()


def there(defects: Defects) -> bool:
    try:
        raise RuntimeError("there")
    except RuntimeError:
        return defects.met()


def test_a_hundred_in_ten_seconds_at_one_place(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.ERROR, "shmmap")
    now_s, counts = 0.0, Counts()
    defects = Defects(cast("StatisticsWriter", counts), lambda: now_s)
    slowly = []
    for number in range(3 * MOST):
        now_s = number * (WITHIN_S / (MOST - 1) + 0.001)
        slowly.append(here(defects))
    assert not any(slowly)
    now_s += 2 * WITHIN_S
    quickly = [(here(defects), there(defects)) for _ in range(MOST - 1)]
    assert not any(one or other for one, other in quickly)
    assert here(defects)
    assert counts == {"defects": 5 * MOST - 1}
    told = [record.getMessage() for record in caplog.records]
    lasted_s = 3 * WITHIN_S + 3 * WITHIN_S
    assert 3 < len(told) <= lasted_s / WITHIN_S + 2
    assert "there" in caplog.text
