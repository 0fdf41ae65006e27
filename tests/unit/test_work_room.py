# SPDX-License-Identifier: Apache-2.0
"""Bytes that are worked on at once stay below the limit, and a large piece has its turn."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor

from shmmap.work_room import WorkRoom


def test_pieces_share_the_room() -> None:
    room, lock = WorkRoom(100), threading.Lock()
    taken: list[int] = []
    peaks: list[list[int]] = []

    def work(nbytes: int) -> int:
        with room.taken(nbytes):
            with lock:
                taken.append(nbytes)
                peaks.append(list(taken))
            with lock:
                taken.remove(nbytes)
        return nbytes

    pieces = [40, 30, 500, 100, 1, 60] * 50
    with ThreadPoolExecutor(16) as pool:
        assert list(pool.map(work, pieces)) == pieces
    assert all(sum(peak) <= 100 or len(peak) == 1 for peak in peaks)


def test_a_large_piece_comes_before_those_that_ask_later() -> None:
    room = WorkRoom(100)
    order: list[str] = []
    asked = threading.Event()

    def work(name: str, nbytes: int) -> None:
        with room.taken(nbytes):
            order.append(name)

    with ThreadPoolExecutor(2) as pool, room.taken(10):
        large = pool.submit(work, "large", 1000)
        while not room._turn.locked():
            asked.wait(0.001)
        small = pool.submit(work, "small", 1)
        assert not small.done()
        assert not large.done()
        order.append("first")
    assert order == ["first", "large", "small"]
