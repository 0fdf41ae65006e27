# SPDX-License-Identifier: Apache-2.0
"""Readers that come, stop, go on and die; cells that change and are evicted; a daemon that is killed.

Whatever the order: no reader's bytes ever change, the books agree with the files, and in the end
all memory is free.
"""

from __future__ import annotations

import os
import random
import signal
from dataclasses import dataclass

import numpy as np
import pytest

from tests.support.daemon_process import DaemonProcess, until
from tests.support.divided_map import DividedMap, random_points
from tests.support.mapping_process import MappingProcess
from tests.support.raw_client import RawClient, circle
from tests.support.segment_reader import read_segment

STEPS = 60


@dataclass
class Reader:
    """A process that maps some segments, and what they held when it began."""

    process: MappingProcess
    checksums: list[int]
    stopped: bool = False

    def check(self) -> None:
        """Its bytes are the same as ever."""
        if not self.stopped:
            assert self.process.checksums() == self.checksums

    def toggle(self) -> None:
        """Stop it, or let it go on."""
        os.kill(self.process.pid, signal.SIGCONT if self.stopped else signal.SIGSTOP)
        self.stopped = not self.stopped


class Life:
    """The daemon, its one client and its readers."""

    def __init__(self, one: DaemonProcess, client: RawClient, made: DividedMap, seed: int) -> None:
        self.one = one
        self.client = client
        self.made = made
        self.random = random.Random(seed)
        self.points = np.random.default_rng(seed)
        self.readers: list[Reader] = []

    def begin_reading(self) -> None:
        """A new reader maps an area; what it got is what some state of the files was."""
        if len(self.readers) >= 6:
            return
        x, y = self.random.uniform(-60, 60), self.random.uniform(-60, 60)
        reply = self.client.area(circle(x, y, 15))
        assert reply.failed == []
        for handle in reply.cells:
            segment = read_segment(self.client.path(handle))
            assert (segment.fields["cell_id"], segment.version) == (handle.id, handle.version)
            if not handle.stale:
                expected = self.made.points(handle.id.rsplit("/", 1)[1])
                assert segment.columns["xyz"][:, 0].tobytes() == expected["x"].tobytes()
        process = MappingProcess([self.client.path(handle) for handle in reply.cells])
        self.readers.append(Reader(process, process.checksums()))

    def check_one(self) -> None:
        """Look at some reader's bytes."""
        if self.readers:
            self.random.choice(self.readers).check()

    def toggle_one(self) -> None:
        """Stop or continue some reader."""
        if self.readers:
            self.random.choice(self.readers).toggle()

    def kill_one(self) -> None:
        """Some reader dies, stopped or not."""
        if self.readers:
            self.readers.pop(self.random.randrange(len(self.readers))).process.end()

    def evict(self) -> None:
        """Everything that no process maps goes."""
        self.client.ask("evict")

    def evict_some(self) -> None:
        """A few cells go."""
        self.client.ask("evict", self.random.sample(sorted(self.made.corners), 5))

    def change(self) -> None:
        """Two files change and the map is read again."""
        for name in self.random.sample(sorted(self.made.corners), 2):
            corner = self.made.corners[name]
            count = int(self.points.integers(1, 900))
            self.made.write_cell(name, corner, random_points(self.points, corner, count))
        assert self.client.ask("reload")[3] == 2

    def restart(self) -> None:
        """The daemon is killed and comes back."""
        self.one.kill()
        self.one.start()
        self.client.hello()

    def check_books(self) -> None:
        """The daemon's sums are those of the files."""
        until(lambda: self._books_agree())

    def _books_agree(self) -> bool:
        counters = self.client.ask("stats")[4]
        return bool(counters["bytes_resident"] + counters["bytes_zombie"] == self.one.segment_bytes())


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_random_life(served: DaemonProcess, client: RawClient, divided_map: DividedMap, seed: int) -> None:
    life = Life(served, client, divided_map, seed)
    actions = [
        life.begin_reading, life.begin_reading, life.begin_reading, life.check_one, life.check_one,
        life.toggle_one, life.toggle_one, life.kill_one, life.evict, life.evict_some, life.change,
        life.change, life.check_books,
    ]  # fmt: skip
    try:
        for step in range(STEPS):
            (life.restart if step in (20, 45) else life.random.choice(actions))()
        for reader in life.readers:
            if reader.stopped:
                reader.toggle()
            reader.check()
    finally:
        for reader in life.readers:
            reader.process.end()
    client.ask("evict")
    served.until_segments(0, lambda: client.ask("stats"))
    life.check_books()
