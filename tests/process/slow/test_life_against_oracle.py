# SPDX-License-Identifier: Apache-2.0
"""A random life of daemon, holders and map against a pure oracle: who maps what, step by step.

The kernel says who maps which segment (``/proc/PID/maps``), the oracle says who should; what the daemon
believes has to agree after every step, nothing mapped may ever have lost its name, and the bytes
have to be those of the version they claim to be.

``SHMMAP_TEST_STEPS`` and ``SHMMAP_TEST_SEED`` choose another length and another life; a long one takes
``-o faulthandler_timeout=0``.
"""

from __future__ import annotations

import os
import random
import re
import signal
import struct
import subprocess
import sys
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from xxhash import xxh3_64_intdigest

import shmmap
from tests.process.conftest import DaemonFactory
from tests.support.client_programs import HeldRow, Holding, HoldingClient
from tests.support.daemon_process import DaemonProcess
from tests.support.divided_map import DividedMap, make_map, random_points

STEPS = int(os.environ.get("SHMMAP_TEST_STEPS", "120"))
SEED = int(os.environ.get("SHMMAP_TEST_SEED", "1"))
HOLDERS = 4
BUDGET = 1 << 20


@dataclass
class Truth:
    """What the files are: of each version that ever was, the checksum of its points; and the present one."""

    made: DividedMap
    checksums: dict[tuple[str, int], int] = field(default_factory=dict)
    current: dict[str, int] = field(default_factory=dict)

    def look(self, name: str) -> None:
        """Take note of a file's present state."""
        path = self.made.pcd_dir / name
        status = path.stat()
        cell_id, box = os.fsencode(path), self.made.box(name)
        stamp = struct.pack("<I3q", 24, status.st_size, status.st_mtime_ns, status.st_ctime_ns)
        named = struct.pack("<I", len(cell_id)) + cell_id + stamp + struct.pack("<4d", *box)
        version = xxh3_64_intdigest(named)
        points = self.made.points(name)
        xyz = np.stack([points[axis] for axis in "xyz"], axis=1)
        self.checksums[str(path), version] = zlib.crc32(np.ascontiguousarray(xyz).data)
        self.current[str(path)] = version

    def change(self, name: str, rng: np.random.Generator) -> None:
        """Rewrite a file."""
        corner = self.made.corners[name]
        points = random_points(rng, corner, int(rng.integers(500, 2500)))
        self.made.write_cell(name, corner, points)
        self.look(name)


@dataclass(eq=False)
class Holder:
    """A holder, and what the oracle says it holds: segment names to rows."""

    process: HoldingClient
    expected: dict[str, HeldRow] = field(default_factory=dict)
    stopped: bool = False
    known: bool = False
    """Whether the present run of the daemon knows it."""

    @property
    def pid(self) -> int:
        return self.process.pid


class Life:
    """All processes and the map, and the steps they may take."""

    def __init__(self, one: DaemonProcess, made: DividedMap) -> None:
        self.one = one
        self.truth = Truth(made)
        for name in made.corners:
            self.truth.look(name)
        self.random = random.Random(SEED)
        self.rng = np.random.default_rng(SEED)
        self.admin = shmmap.connect(one.endpoint, name="the test", timeout=60.0, connect_timeout=60.0)
        self.holders: list[Holder] = []
        self.nameless: set[str] = set()
        self.taken: dict[str, int] = {}

    # --- steps --------------------------------------------------------------------------------

    def request(self) -> None:
        """A holder moves: it then holds the new area, each cell in its present version, if there was room."""
        if len(self.holders) < HOLDERS:
            self.holders.append(Holder(HoldingClient(self.one.endpoint)))
        holder = self.random.choice(self.holders)
        if holder.stopped:
            return
        x, y, radius = self.random.uniform(-60, 60), self.random.uniform(-60, 60), self.random.uniform(1, 35)
        answer = holder.process.hold([x, y, radius])
        holder.known = True
        inside = {self.truth.made.id(name) for name in self.truth.made.in_circle(x, y, radius)}
        self._judge(holder, answer, inside)

    def _judge(self, holder: Holder, answer: Holding, inside: set[str]) -> None:
        before = {row.id: row for row in holder.expected.values()}
        lacking = {cell for cell, _ in answer.failed}
        assert {code for _, code in answer.failed} <= {"over_budget"}, answer.failed
        assert answer.pending == ()
        for row in answer.cells:
            assert row.id in inside
            assert row.checksum == self.truth.checksums[row.id, row.version], f"wrong bytes: {row}"
            if row.version != self.truth.current[row.id]:
                assert row.id in lacking, f"an old version without a reason: {row}"
            elif row.id in before and before[row.id].version == row.version:
                assert row.segment == before[row.id].segment, "what is held was handed out once more"
        assert {row.id for row in answer.cells} >= inside - lacking
        holder.expected = {row.segment: row for row in answer.cells}

    def drop(self) -> None:
        """A holder drops everything."""
        holder = self._one(stopped=False)
        if holder is not None:
            assert holder.process.hold([]).cells == ()
            holder.expected = {}
            holder.known = True

    def look(self) -> None:
        """A holder's bytes are the same as ever."""
        holder = self._one(stopped=False)
        if holder is not None:
            assert {row.segment: row for row in holder.process.hold(None).cells} == holder.expected

    def kill(self) -> None:
        """A holder dies, stopped or not."""
        holder = self._one()
        if holder is not None:
            self.holders.remove(holder)
            holder.process.kill()

    def stop(self) -> None:
        """A holder stands still, as under a debugger."""
        holder = self._one(stopped=False)
        if holder is not None:
            os.kill(holder.pid, signal.SIGSTOP)
            holder.stopped = True

    def go_on(self) -> None:
        """A holder that stood still goes on."""
        holder = self._one(stopped=True)
        if holder is not None:
            os.kill(holder.pid, signal.SIGCONT)
            holder.stopped = False

    def evict(self) -> None:
        """Everything is to go."""
        self.admin.evict()

    def evict_some(self) -> None:
        """A few cells are to go."""
        self.admin.evict(self.random.sample(sorted(self.truth.made.corners), 5))

    def reload(self) -> None:
        """Files change, and the map is read again."""
        names = self.random.sample(sorted(self.truth.made.corners), 3)
        for name in names:
            self.truth.change(name, self.rng)
        assert self.admin.reload().changed == 3

    def crash(self) -> None:
        """The daemon is killed and comes back; a file may have changed meanwhile."""
        self.one.kill()
        if self.random.random() < 0.5:
            self.truth.change(self.random.choice(sorted(self.truth.made.corners)), self.rng)
        self._start()

    def restart(self) -> None:
        """The daemon leaves its memory to the next run."""
        assert self.one.leave() == 0
        self._start()

    def end(self) -> None:
        """The daemon is stopped: names go, mappings stay."""
        assert self.one.stop() == 0
        assert self.one.leftovers() == []
        for holder in self.holders:
            self.nameless |= holder.expected.keys()
        self._start()

    def _start(self) -> None:
        self.one.start()
        for holder in self.holders:
            holder.known = False

    def _one(self, stopped: bool | None = None) -> Holder | None:
        among = [h for h in self.holders if stopped is None or h.stopped is stopped]
        return self.random.choice(among) if among else None

    # --- judging ------------------------------------------------------------------------------

    def maps(self, pid: int) -> dict[str, bool]:
        """Segments that a process maps by the kernel's word; whether their name is still there."""
        found: dict[str, bool] = {}
        own = re.compile(
            rf"{self.one.shm_dir}(/shmmap\.{self.one.instance}\.[0-9a-f]{{16}})(\.zombie)?( \(deleted\))?$"
        )
        for line in Path(f"/proc/{pid}/maps").read_text().splitlines():
            place = own.search(line)
            if place is not None:
                found[place[1]] = place[3] is None
        return found

    def compare(self) -> None:
        """Kernel, oracle and daemon agree on who maps what."""
        mappers: dict[str, set[Holder]] = {}
        for holder in self.holders:
            mapped = self.maps(holder.pid)
            assert mapped.keys() == holder.expected.keys(), "a holder maps other segments than it was handed"
            for segment, named in mapped.items():
                assert named or segment in self.nameless, (
                    f"{segment} was freed while pid {holder.pid} maps it"
                )
                mappers.setdefault(segment, set()).add(holder)
        believed: dict[str, set[int]] = {}
        for cell_id in self.truth.current:
            for shown in self.admin.show(cell_id).segments:
                assert shown.segment not in believed
                believed[shown.segment] = {holder.pid for holder in shown.holders}
        for segment, pids in believed.items():
            # 0 stands for those that this run of the daemon does not know yet
            expected = {holder.pid if holder.known else 0 for holder in mappers.get(segment, ())}
            assert pids == expected, segment
        unseen = mappers.keys() - believed.keys() - self.nameless
        assert not unseen, f"the daemon does not know of {unseen}"

    def end_all(self) -> None:
        """Everybody goes on, shows the bytes it has, and ends; then all memory is free."""
        while any(holder.stopped for holder in self.holders):
            self.go_on()
        for holder in self.holders:
            assert {row.segment: row for row in holder.process.hold(None).cells} == holder.expected
        self.close()
        self.admin.evict()
        self.one.until_segments(0, self.admin.stats)
        counters = self.admin.stats().counters
        assert (counters["bytes_resident"], counters["bytes_zombie"], counters["bytes_reserved"]) == (0, 0, 0)

    def close(self) -> None:
        """End the holders."""
        for holder in self.holders:
            holder.process.kill()
        self.holders.clear()


@pytest.fixture
def overload() -> Iterator[list[subprocess.Popen[bytes]]]:
    """Return a list for processes that only use the processors; they end with the test."""
    busy: list[subprocess.Popen[bytes]] = []
    yield busy
    for process in busy:
        process.kill()
        process.wait()


def test_a_life_against_the_oracle(
    daemon: DaemonFactory, tmp_path: Path, overload: list[subprocess.Popen[bytes]]
) -> None:
    made = make_map(tmp_path / "map", points=2000)
    one = daemon(made.root, "--budget", str(BUDGET), "--session-quota", "1")
    life = Life(one, made)
    steps = [
        *[life.request] * 10, *[life.drop] * 2, *[life.look] * 3, *[life.kill] * 1, *[life.stop] * 2,
        *[life.go_on] * 3, *[life.evict] * 2, *[life.evict_some] * 2, *[life.reload] * 2,
    ]  # fmt: skip
    rare = [life.crash, life.crash, life.restart, life.end]
    try:
        for number in range(STEPS):
            if number == 19 * STEPS // 20:  # from here on all are starved of processors
                overload += [
                    subprocess.Popen([sys.executable, "-c", "while True: pass"])
                    for _ in range(2 * len(os.sched_getaffinity(0)))
                ]
            step = life.random.choice(rare if number % 20 == 19 else steps)
            life.taken[step.__name__] = life.taken.get(step.__name__, 0) + 1
            step()
            life.compare()
            assert one.segment_bytes() <= BUDGET
        for process in overload:
            process.kill()
        life.end_all()
    except BaseException:
        print(f"seed {SEED}, steps taken: {life.taken}\n{one.log[-3000:]}")
        raise
    finally:
        for holder in life.holders:
            os.kill(holder.pid, signal.SIGCONT)
        life.close()
        life.admin.close()
