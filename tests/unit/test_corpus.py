# SPDX-License-Identifier: Apache-2.0
"""Every kept input of the fuzzer, and some mutations of each, the same in every run."""

from __future__ import annotations

import random

import pytest

from shmmap.errors import SegmentCorrupt
from shmmap.segment.header import read_columns
from shmmap.segment.layout import COLUMN, COLUMNS_OFFSET
from tests.support.fuzzing import TARGETS, corpus, repair

MUTATIONS = 40


@pytest.mark.parametrize("name", TARGETS)
def test_kept_inputs(name: str) -> None:
    target = TARGETS[name]
    inputs = corpus(name)
    assert inputs
    outcomes = {key: target.check(data) for key, data in inputs.items()}
    wellformed = [
        key
        for key, outcome in outcomes.items()
        if outcome not in ("refused/refused", "refused", "SegmentCorrupt", "ProtocolMismatch")
    ]
    assert len(wellformed) >= 2


@pytest.mark.parametrize("name", TARGETS)
def test_mutations(name: str) -> None:
    target = TARGETS[name]
    rng = random.Random(name)
    pool = list(corpus(name).values())
    for data in pool:
        for _ in range(MUTATIONS):
            target.check(target.mutate(data, rng, pool))


def test_an_empty_column_of_a_shape_that_no_array_has() -> None:
    data = bytearray(corpus("segment")["empty"])
    fields = list(COLUMN.unpack_from(data, COLUMNS_OFFSET))
    fields[5:9] = [0, 2**62, 0, 0]
    COLUMN.pack_into(data, COLUMNS_OFFSET, *fields)
    with pytest.raises(SegmentCorrupt, match="contradicts the layout"):
        read_columns(memoryview(repair(data)), len(data))
