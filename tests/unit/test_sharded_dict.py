# SPDX-License-Identifier: Apache-2.0
"""A sharded dictionary does what a dict does, and none of its tables is large."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from shmmap.sharded_dict import ShardedDict

KEYS = st.integers(0, 40)


@given(st.lists(st.tuples(st.sampled_from(["set", "delete", "pop", "get", "default"]), KEYS), max_size=200))
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
        elif what == "default":
            assert ours.setdefault(key, number) == plain.setdefault(key, number)
        assert ours.get(key) == plain.get(key)
        assert (key in ours) == (key in plain)
    assert ours == plain
    assert (len(ours), set(ours), sorted(ours.values())) == (len(plain), set(plain), sorted(plain.values()))


def test_none_of_its_tables_is_large() -> None:
    ours: ShardedDict[int, int] = ShardedDict()
    for number in range(100_000):
        ours[hash(f"cell {number}")] = number
    assert max(map(len, ours._shards)) < 100_000 / 32
