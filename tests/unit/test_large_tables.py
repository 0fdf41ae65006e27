# SPDX-License-Identifier: Apache-2.0
"""A sharded dictionary does what a dict does; a sparse table takes the memory of its written rows."""

from __future__ import annotations

import mmap
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from shmmap import large_tables
from shmmap.large_tables import ShardedDict, sparse_zeros

KEYS = st.integers(0, 40)
DONE = st.sampled_from(["set", "delete", "pop", "popitem", "get", "default"])
ROWS = 1 << 23
WRITTEN = 64


@pytest.fixture(params=[5, 1000], ids=["shared out", "few"])
def few(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(large_tables, "FEW", request.param)


@pytest.mark.usefixtures("few")
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.tuples(DONE, KEYS), max_size=200))
def test_it_does_what_a_dict_does(steps: list[tuple[str, int]]) -> None:
    ours: ShardedDict[int, int] = ShardedDict()
    plain: dict[int, int] = {}
    for number, (what, key) in enumerate(steps):
        if what == "set":
            ours[key] = plain[key] = number
        elif what == "delete" and key in plain:
            del ours[key], plain[key]
        elif what == "pop":
            assert ours.pop(key, None) == plain.pop(key, None)
            with pytest.raises(KeyError):
                ours.pop(key)
        elif what == "popitem" and plain:
            taken, value = ours.popitem()
            assert plain.pop(taken) == value
        elif what == "popitem":
            with pytest.raises(KeyError, match="empty"):
                ours.popitem()
        elif what == "default":
            assert ours.setdefault(key, number) == plain.setdefault(key, number)
        assert ours.get(key) == plain.get(key)
        assert (key in ours) == (key in plain)
        assert bool(ours) == bool(plain)
    assert ours.among(range(-1, 42)) == [one for one in range(-1, 42) if one in plain]
    assert ours == plain
    assert (len(ours), set(ours), sorted(ours.values())) == (len(plain), set(plain), sorted(plain.values()))


@pytest.mark.parametrize("count", [1, 3, 5000])
def test_a_walk_sees_what_stays_though_others_come_and_go(count: int) -> None:
    ours: ShardedDict[int, int] = ShardedDict()
    for key in range(count):
        ours[key] = 0
    seen = set()
    for key in ours.walk():
        seen.add(key)
        ours.pop(key * 7 % count // 2 * 2, None)  # an even one, seen or not
        ours[count + len(seen)] = 0
    assert seen.issuperset(range(1, count, 2))


def test_few_entries_are_in_one_dict_and_many_in_none_that_is_large() -> None:
    ours: ShardedDict[int, int] = ShardedDict()
    ours[1] = 1
    assert len(ours._shards) == 1
    for number in range(100_000):
        ours[hash(f"cell {number}")] = number
    assert max(map(len, ours._shards)) < 100_000 / 32


def resident_bytes() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * mmap.PAGESIZE


@pytest.mark.parametrize(
    ("shape", "dtype"), [(0, np.uint64), (3, np.bool_), ((7, 2), np.float64), ((1 << 20, 3), np.int32)]
)
def test_it_is_an_array_of_zeros(shape: int | tuple[int, ...], dtype: type[np.generic]) -> None:
    table = sparse_zeros(shape, dtype)
    right = np.zeros(shape, dtype)
    assert table.dtype == right.dtype
    assert np.array_equal(table, right)
    table[...] = 1
    assert table.all()
    assert table.flags.c_contiguous


def test_a_row_here_and_there_takes_no_more_than_a_page_each_and_memory_goes_with_the_table() -> None:
    before = resident_bytes()
    table = sparse_zeros(ROWS, np.uint64)
    table[:: ROWS // WRITTEN] = 7
    assert int(table.sum()) == 7 * WRITTEN
    assert table[1] == 0
    assert resident_bytes() - before < table.nbytes / 2
    table[...] = 1
    before = resident_bytes()
    del table
    assert before - resident_bytes() > 0.9 * 8 * ROWS
