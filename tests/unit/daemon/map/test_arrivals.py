# SPDX-License-Identifier: Apache-2.0
"""Bytes that several threads receive: none is lost, and none is counted twice."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from shmmap.daemon.map.arrivals import Arrivals
from tests.support.interleaving import interleaved


@pytest.mark.parametrize("add", [Arrivals.add_index, Arrivals.add_ahead, Arrivals.add_pages])
def test_bytes_that_come_at_the_same_time(add: Callable[[Arrivals, int], None]) -> None:
    for arrivals in interleaved(Arrivals, lambda one: add(one, 1), lambda one: add(one, 2)):
        assert sum(arrivals.take()) + arrivals.pages_bytes == 3


def test_bytes_that_come_while_some_are_taken() -> None:
    taken: list[tuple[int, int]] = []
    for arrivals in interleaved(Arrivals, lambda one: taken.append(one.take()), lambda one: one.add_ahead(2)):
        assert taken.pop()[1] + arrivals.take()[1] == 2
