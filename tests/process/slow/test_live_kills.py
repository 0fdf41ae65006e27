# SPDX-License-Identifier: Apache-2.0
"""Mapper, worker and daemon are killed at random times, many times: every scan is there, once.

``SHMMAP_TEST_KILLS=150`` has them killed as often as that.  The same without the undo record:
``tests/unit/chunks/test_applying.py``.
"""

from __future__ import annotations

import contextlib
import os
import random
import select
import signal
import subprocess
import sys
import time
from pathlib import Path

import shmmap
from tests.support.chunk_memory import ChunkMemory as Unbounded
from tests.support.daemon_process import ROOT, Deadline
from tests.support.live_drive import RESOLUTION, marked
from tests.support.live_mapper import marks_of
from tests.support.live_reference import LiveDaemon, held, worker_of

KILLS = int(os.environ.get("SHMMAP_TEST_KILLS", "6"))
SCANS_A_KILL = 12
LONGEST_S = 0.03


class Mapper:
    """The mapper's process, restarted after each kill, and what it has said."""

    def __init__(self, endpoint: str, last: int) -> None:
        self.endpoint, self.last = endpoint, last
        self.applied = 0
        self.done = False
        self.start()

    def start(self) -> None:
        """Begin with what has no answer."""
        self._process = subprocess.Popen(
            [
                sys.executable, "-m", "tests.support.live_mapper", self.endpoint, str(self.applied + 1),
                str(self.last),
            ],
            stdout=subprocess.PIPE, text=True, cwd=ROOT,
        )  # fmt: skip

    def _take(self, line: str) -> None:
        if line.startswith("applied "):
            number = int(line.split()[1])
            assert number == self.applied + 1
            self.applied = number
        elif line:
            self.done = line == "done\n"

    def listen(self, seconds: float) -> bool:
        """Read what it says for ``seconds``; returns whether it said anything."""
        assert self._process.stdout is not None
        said, end_s = False, time.monotonic() + seconds
        while (left_s := end_s - time.monotonic()) > 0 and not self.done:
            if select.select([self._process.stdout], [], [], left_s)[0]:
                line = self._process.stdout.readline()
                assert line, f"the mapper ended with {self._process.wait()}"
                self._take(line)
                said = True
        return said

    def until(self, number: int) -> None:
        """Listen until that many scans are applied."""
        waiting = Deadline()
        while waiting(self.applied < number and not self.done):
            self.listen(0.05)

    def kill(self) -> None:
        """SIGKILL it; what it said before counts."""
        self._process.kill()
        rest, _ = self._process.communicate()
        for line in rest.splitlines(keepends=True):
            self._take(line)

    def end(self) -> None:
        """It has ended, or is made to."""
        self._process.kill()
        self._process.communicate()


def test_any_process_is_killed_at_any_time(live_daemon: LiveDaemon, tmp_path: Path) -> None:
    rng = random.Random(KILLS)
    one = live_daemon("--live-budget", "4M", checkpoint=0.3)  # paged all the time
    mapper = Mapper(one.endpoint, KILLS * SCANS_A_KILL)
    killed = dict.fromkeys(("mapper", "worker", "daemon"), 0)
    order = [name for name in killed for _ in range(-(-KILLS // 3))]
    rng.shuffle(order)
    try:
        for name in order[:KILLS]:
            mapper.until(mapper.applied + rng.randint(1, SCANS_A_KILL // 2))
            mapper.listen(rng.uniform(0.0, LONGEST_S))
            if mapper.done:
                break
            if name == "mapper":
                mapper.kill()
                if not mapper.done:
                    mapper.start()
            elif name == "daemon":
                one.kill()
                one.start()
            else:
                with contextlib.suppress(OSError, ValueError):  # there may be none just now
                    os.kill(worker_of(one), signal.SIGKILL)
            killed[name] += 1
        waiting = Deadline()
        while waiting(not mapper.done):
            if mapper.listen(1.0):
                waiting = Deadline()
    finally:
        mapper.end()
    assert mapper.applied == mapper.last
    assert sum(killed.values()) >= KILLS // 2, killed
    all_marks = marked()
    reference = Unbounded(RESOLUTION)
    for number in range(1, mapper.last + 1):
        reference.apply(marks_of(number, all_marks), scan=number)
    with shmmap.connect(one.endpoint) as client:
        live = client.live("lidar")
        expected = reference.voxels()
        whole = shmmap.Box(-1e4, -1e4, 1e4, 1e4)
        assert held(live, "disk", whole) == expected
        assert held(live) == expected
        assert live.status().damaged == ()
    assert one.stop() == 0
    assert sorted(os.listdir(tmp_path / "lidar")) == ["map.db", "map.json"]
