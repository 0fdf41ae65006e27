# SPDX-License-Identifier: Apache-2.0
"""What a reader is told of changes: all that it does not know, and nothing that it does."""

from __future__ import annotations

import pytest

from shmmap.chunks.voxels import ChunkKey
from shmmap.daemon.live.worker import changes
from shmmap.daemon.live.worker.changes import Changes

A, B, C = ChunkKey(0, 0, 0), ChunkKey(1, 0, 0), ChunkKey(-1, 2, 0)


def test_what_changed_since() -> None:
    one = Changes(100)
    one.changed(A)
    seen = one.number
    one.changed(B)
    assert not one.is_newer(A, seen)
    assert one.is_newer(B, seen)
    assert not one.is_newer(B, one.number)
    assert not one.is_newer(C, 0), "it was never in memory"
    one.changed(A)
    assert one.is_newer(A, seen)


def test_what_left_since_and_did_not_come_back() -> None:
    one = Changes(100)
    for key in (A, B, C):
        one.changed(key)
    seen = one.number
    for key in (A, B, A):
        one.gone(key)
    assert one.left(seen) == [A, B]
    one.changed(B)
    assert one.left(seen) == [A]
    assert one.left(one.number) == []
    assert one.is_newer(B, seen), "it came back, with whatever it has now"
    assert not one.is_newer(A, seen)


def test_what_is_known() -> None:
    one = Changes(100)
    one.changed(A)
    assert one.known(100)
    assert one.known(101)
    assert not one.known(99), "that was an earlier life"
    assert not one.known(102), "that was another worker's, after which the clock was set back"


def test_not_all_that_left_is_remembered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(changes, "MOST_GONE", 3)
    one = Changes(0)
    for x in range(5):
        one.gone(ChunkKey(x, 0, 0))
    assert [since for since in range(6) if one.known(since)] == [2, 3, 4, 5]
    assert one.left(2) == [ChunkKey(x, 0, 0) for x in (2, 3, 4)]
    assert len(one.left(0)) == 3
