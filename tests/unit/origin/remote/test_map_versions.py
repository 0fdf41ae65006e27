# SPDX-License-Identifier: Apache-2.0
"""Versions: golden bytes, the chain from CURRENT, one switch at a time, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from shmmap.errors import InstanceBusy, MapDataError, MapMissing

pytest.importorskip("zstandard", reason="zstandard is not installed")

from shmmap.origin.remote.map_versions import (
    Current,
    CurrentState,
    Entry,
    add_version,
    earlier_versions,
    list_entries,
    new_entry,
    pack_json,
    read_current,
    read_entry,
    require_current,
    require_served,
    unpack_current,
)
from shmmap.origin.remote.opened_store import open_store
from shmmap.origin.remote.store import Store, StoreRefused

ROOT = "0123456789abcdef" * 4


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return open_store(str(tmp_path / "map"))


def published(store: Store, root: str = ROOT, nbytes: int = 100) -> Entry:
    seen = read_current(store)
    entry = new_entry(store, root, nbytes, seen.current)
    add_version(store, entry, seen)
    return entry


def test_golden_bytes() -> None:
    assert pack_json(Current(3, ROOT, 4567)) == (
        b'{"version": 3, "root": "' + ROOT.encode() + b'", "bytes": 4567}\n'
    )
    entry = Entry(4, ROOT, 9, "2026-11-26T15:00:00.000001Z", before=3, restored=1)
    assert pack_json(entry) == (
        b'{"version": 4, "root": "' + ROOT.encode() + b'", "bytes": 9,'
        b' "created": "2026-11-26T15:00:00.000001Z", "before": 3, "restored": 1}\n'
    )
    assert entry.created_s == 1795705200.000001


def test_each_version_names_the_one_before(store: Store) -> None:
    assert read_current(store) == CurrentState(None, None)
    with pytest.raises(MapMissing, match="no map is published"):
        require_current(store)
    for number in (1, 2, 3):
        assert published(store).version == number
    assert require_current(store).version == 3
    assert [(one.version, one.before) for one in earlier_versions(store, require_current(store))] == [
        (3, 2), (2, 1), (1, 0),
    ]  # fmt: skip
    store.delete("versions/2.json")
    assert [one.version for one in earlier_versions(store, require_current(store))] == [3]
    assert list_entries(store) == [1, 3]


def test_an_entry_that_was_never_served_is_beside_the_chain(store: Store) -> None:
    published(store)
    new_entry(store, "f" * 64, 1, require_current(store))
    assert published(store).version == 3
    assert [one.version for one in earlier_versions(store, require_current(store))] == [3, 1]
    assert list_entries(store) == [1, 2, 3]


def test_a_version_is_read_back(store: Store) -> None:
    """Also where others have followed; not where a store has lost it, or had another's in its place."""
    with pytest.raises(StoreRefused, match="has accepted version 1, and does not return it"):
        require_served(store, Current(1, ROOT, 100))
    made = published(store).current
    require_served(store, made)
    with pytest.raises(StoreRefused, match="has accepted version 2"):
        require_served(store, Current(2, ROOT, 100))
    for _ in range(3):
        published(store, "f" * 64)
    require_served(store, made)
    other = Current(4, ROOT, 100)
    for name, data in (
        ("CURRENT", pack_json(other)),  # a version of the same number has replaced it
        ("versions/4.json", pack_json(Entry(4, ROOT, 100, "2026-11-26T15:00:00.000001Z", before=3))),
    ):
        kept = bytes(store.get(name, 999))
        store.put(name, data)
        with pytest.raises(InstanceBusy, match="another publisher has changed"):
            require_served(store, Current(4, "f" * 64, 100))
        store.put(name, kept)
    require_served(store, Current(4, "f" * 64, 100))
    store.put("versions/3.json", pack_json(Entry(3, ROOT, 100, "2026-11-26T15:00:00.000001Z", before=1)))
    for lost in (Current(2, "f" * 64, 100), Current(3, "f" * 64, 100)):
        with pytest.raises(InstanceBusy):
            require_served(store, lost)


def test_other_files_among_the_entries_are_left_alone(store: Store) -> None:
    published(store)
    for name in (".2.json.tmp", "2.json.bak", "x.json", "02.json", "-1.json", "99999999999999999999.json"):
        store.put(f"versions/{name}", b"{}")
    assert list_entries(store) == [1]
    assert published(store).version == 2


@pytest.mark.parametrize(
    "text",
    [
        "", "{}", "[]", "null", '{"version": 1}', '{"version": 0, "root": "%s", "bytes": 1}',
        '{"version": 1, "root": "%S", "bytes": 1}',
        '{"version": 1, "root": "../../etc", "bytes": 1}', '{"version": 1, "root": "%s", "bytes": 0}',
        '{"version": 1, "root": "%s", "bytes": 16777217}',
        '{"version": 9223372036854775808, "root": "%s", "bytes": 1}',
        '{"version": 1.5, "root": "%s", "bytes": 1}', "[" * 60_000, '{"version": 1, "root": "\udcff',
    ],
)  # fmt: skip
def test_a_current_that_names_nothing(text: str) -> None:
    text = text.replace("%s", ROOT).replace("%S", ROOT.upper())
    with pytest.raises(MapDataError) as error:
        unpack_current(text.encode(errors="surrogateescape"))
    assert error.value.cause == "damaged"


def test_what_later_publishers_say_more_is_ignored() -> None:
    text = json.dumps({"version": 1, "root": ROOT, "bytes": 1, "more": {"a": [1]}})
    assert unpack_current(text.encode()) == Current(1, ROOT, 1)


@pytest.mark.parametrize(
    "changes",
    [{"version": 2}, {"created": "yesterday"}, {"created": "2026-11-26T15:00:00"}, {"before": 1},
     {"before": -1}, {"root": "x"}],
)  # fmt: skip
def test_an_entry_that_is_not_this_one(store: Store, changes: dict[str, object]) -> None:
    fields = {"version": 1, "root": ROOT, "bytes": 1, "created": "2026-11-26T15:00:00Z", "before": 0}
    store.put("versions/1.json", json.dumps({**fields}).encode())
    assert read_entry(store, 1).restored == 0
    store.put("versions/1.json", json.dumps({**fields, **changes}).encode())
    with pytest.raises(MapDataError):
        read_entry(store, 1)
