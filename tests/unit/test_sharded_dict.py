# SPDX-License-Identifier: Apache-2.0
"""A sharded dictionary does what a dict does, and none of its tables is large."""

from __future__ import annotations

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from shmmap import large_tables
from shmmap.large_tables import ShardedDict

KEYS = st.integers(0, 40)
DONE = st.sampled_from(["set", "delete", "pop", "popitem", "get", "default"])


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
        elif what == "default":
            assert ours.setdefault(key, number) == plain.setdefault(key, number)
        assert ours.get(key) == plain.get(key)
        assert (key in ours) == (key in plain)
        assert bool(ours) == bool(plain)
    assert ours == plain
    assert (len(ours), set(ours), sorted(ours.values())) == (len(plain), set(plain), sorted(plain.values()))


def test_none_of_its_tables_is_large() -> None:
    ours: ShardedDict[int, int] = ShardedDict()
    for number in range(100_000):
        ours[hash(f"cell {number}")] = number
    assert max(map(len, ours._shards)) < 100_000 / 32


def test_few_entries_take_little_memory() -> None:
    ours: ShardedDict[int, int] = ShardedDict()
    ours[1] = 1
    assert len(ours._shards) == 1


def test_nothing_is_taken_from_an_empty_one() -> None:
    ours: ShardedDict[int, int] = ShardedDict()
    with pytest.raises(KeyError, match="empty"):
        ours.popitem()
