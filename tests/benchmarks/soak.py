# SPDX-License-Identifier: Apache-2.0
"""A long life with clients that wander, come, go, stop and die, on a map that changes: does anything grow?

    python -m tests.benchmarks.soak [--minutes 10] [--pace 8] [--clients 16] [--seed 1]

On an ordinary day each client asks every 0.4 s, and every 8 s something happens to one of them, to the map or
to a loader; all of that comes ``--pace`` times as fast: an hour is a working day of eight.

Samples the daemon's resident memory, descriptors, threads, sessions, its loaders' memory, the names and the
bytes in its shared-memory directory (a tmpfs of its own where this user may mount one: then bytes
without a name count, too).  The first third is for warming up.  Judged are: bytes within the budget at every
sample, no client that saw a byte change, and for every series that the median of the last fifth is not
above that of the fifth after the warm-up by more than its allowance.  Exit code 1 otherwise.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np

import shmmap
from shmmap.statistics.reader import read_statistics
from tests.support.daemon_process import ROOT, DaemonProcess
from tests.support.divided_map import DividedMap, make_map, random_points

CELLS = 20
POINTS = 8000
BUDGET = 24 << 20
SAMPLE_S = 0.25
EVENT_S = 8.0
PAUSE_S = 0.4
ALLOWANCES = {
    "rss_kib": 6 << 10,
    "loaders_kib": 24 << 10,
    "descriptors": 24,
    "threads": 0,
    "sessions": 8,
    "names": 40,
}


@contextmanager
def own_tmpfs() -> Iterator[str | None]:
    """Mount a tmpfs; None where this user may not."""
    with tempfile.TemporaryDirectory(prefix="shmmap-soak-") as path:
        command = ["mount", "-t", "tmpfs", "-o", "size=128m,mode=755", "tmpfs", path]
        mounted = subprocess.run(command, capture_output=True).returncode == 0
        try:
            yield path if mounted else None
        finally:
            if mounted:
                subprocess.run(["umount", path], check=True)


def status(pid: int) -> tuple[int, int]:
    """Resident KiB and threads of a process; zeros if it has ended."""
    found = {"VmRSS": 0, "Threads": 0}
    with suppress(OSError):
        for line in Path(f"/proc/{pid}/status").read_text().splitlines():
            name, _, rest = line.partition(":")
            if name in found:
                found[name] = int(rest.split()[0])
    return found["VmRSS"], found["Threads"]


class Soak:
    """The daemon, its clients, and what was seen of them."""

    def __init__(
        self, one: DaemonProcess, made: DividedMap, clients: int, seed: int, tmpfs: bool, pace: float
    ) -> None:
        self.one = one
        self.made = made
        self.random = random.Random(seed)
        self.points = np.random.default_rng(seed)
        self.tmpfs = tmpfs
        self.pace = pace
        self.numbers = 0
        self.clients: list[subprocess.Popen[bytes]] = []
        self.stopped: set[int] = set()
        self.series: dict[str, list[int]] = {name: [] for name in ALLOWANCES}
        self.peak_bytes = 0
        self.samples = self.events = self.deaths = 0
        self.problems: list[str] = []
        for _ in range(clients):
            self.begin()

    def begin(self) -> None:
        """One more client."""
        self.numbers += 1
        command = [sys.executable, "-m", "tests.support.client_programs", "wander", self.one.endpoint]
        half = CELLS * self.made.size / 2
        self.clients.append(
            subprocess.Popen([*command, str(self.numbers), str(half), str(PAUSE_S / self.pace)], cwd=ROOT)
        )

    def count(self, name: str) -> int:
        """Return one of the daemon's counters."""
        return read_statistics(self.one.instance, self.one.shm_dir).counters[name]

    def sample(self) -> None:
        """Look at everything once."""
        self.samples += 1
        rss, threads = status(self.one.pid)
        loaders = sum(status(pid)[0] for pid in self.one.children())
        names = os.listdir(self.one.shm_dir)
        seen = {
            "sessions": self.count("sessions"),
            "rss_kib": rss, "threads": threads, "loaders_kib": loaders, "names": len(names),
            # retired segments that are still mapped are kept open, and are not what could leak
            "descriptors": len(os.listdir(f"/proc/{self.one.pid}/fd"))
            - sum(name.endswith(".zombie") for name in names),
        }  # fmt: skip
        for name, value in seen.items():
            self.series[name].append(value)
        if self.tmpfs:
            state = os.statvfs(self.one.shm_dir)
            used = (state.f_blocks - state.f_bfree) * state.f_frsize
        else:
            used = self.one.segment_bytes()
        self.peak_bytes = max(self.peak_bytes, used)
        if used > BUDGET:
            self.problems.append(f"{used} bytes in use at sample {self.samples}, the budget is {BUDGET}")
        for client in [client for client in self.clients if client.poll() is not None]:
            self.clients.remove(client)
            self.problems.append(f"a client ended by itself with {client.returncode}")
            self.begin()

    def event(self) -> None:
        """Something happens."""
        self.events += 1
        what = self.random.choice(
            [self.kill, self.kill, self.stop, self.stop, self.change, self.evict, self.lose]
        )
        what()

    def kill(self) -> None:
        """A client dies, another comes."""
        client = self.clients.pop(self.random.randrange(len(self.clients)))
        self.stopped.discard(client.pid)
        client.kill()
        client.wait()
        self.deaths += 1
        self.begin()

    def stop(self) -> None:
        """A client stands still, or one that did goes on."""
        if len(self.stopped) >= 3:
            pid = self.random.choice(sorted(self.stopped))
            self.stopped.discard(pid)
            os.kill(pid, signal.SIGCONT)
            return
        client = self.random.choice(self.clients)
        self.stopped.add(client.pid)
        os.kill(client.pid, signal.SIGSTOP)

    def change(self) -> None:
        """Some cells change."""
        for name in self.random.sample(sorted(self.made.corners), 5):
            count = int(self.points.integers(POINTS // 2, POINTS * 3 // 2))
            corner = self.made.corners[name]
            self.made.write_cell(name, corner, random_points(self.points, corner, count))
        with shmmap.connect(self.one.endpoint, timeout=60.0, connect_timeout=60.0) as client:
            client.reload()

    def evict(self) -> None:
        """Everything that no process maps goes."""
        with shmmap.connect(self.one.endpoint, timeout=60.0, connect_timeout=60.0) as client:
            client.evict()

    def lose(self) -> None:
        """A loader dies."""
        loaders = self.one.children()
        if loaders:
            with suppress(ProcessLookupError):
                os.kill(self.random.choice(loaders), signal.SIGKILL)

    def run(self, seconds: float) -> None:
        """Live."""
        end_s = time.monotonic() + seconds
        event_s = time.monotonic() + 3
        while (now_s := time.monotonic()) < end_s:
            self.sample()
            if now_s >= event_s:
                event_s = now_s + EVENT_S / self.pace
                self.event()
            time.sleep(SAMPLE_S)

    def end(self) -> None:
        """End the clients; then all memory must come back."""
        for client in self.clients:
            client.kill()
            client.wait()
        with shmmap.connect(self.one.endpoint, timeout=60.0, connect_timeout=60.0) as operator:
            began_s = time.monotonic()
            until_s, loads, evicted = began_s + 30, self.count("loads_finished"), None
            while (left := self.one.segments()) and time.monotonic() < until_s:
                evicted = operator.evict()  # more than once: loads that the dead asked for go on
                if loads != (loads := self.count("loads_finished")):
                    until_s = min(time.monotonic() + 30, began_s + 300)
                time.sleep(0.02)
        if left:
            self.problems.append(f"{left} are left that no process maps; the last evict: {evicted}")

    def judge(self) -> dict[str, list[float]]:
        """Medians after the warm-up and at the end; what grew becomes a problem."""
        medians = {}
        for name, values in self.series.items():
            settled = values[len(values) // 3 :]
            fifth = max(1, len(settled) // 5)
            first, last = statistics.median(settled[:fifth]), statistics.median(settled[-fifth:])
            medians[name] = [first, last, max(settled)]
            if last > first + ALLOWANCES[name]:
                self.problems.append(f"{name} grew from {first} to {last}")
        return medians


def main() -> int:
    """Print one line of JSON; 1 if something grew or went wrong."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--pace", type=float, default=8.0)
    parser.add_argument("--clients", type=int, default=16)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch, own_tmpfs() as tmpfs:
        made = make_map(Path(scratch, "map"), columns=CELLS, rows=CELLS, points=POINTS)
        one = DaemonProcess(made.root, "--budget", str(BUDGET), "--workers", "2", shm_dir=tmpfs)
        try:
            one.start()
            soak = Soak(one, made, options.clients, options.seed, tmpfs is not None, options.pace)
            try:
                soak.run(options.minutes * 60)
            finally:
                soak.end()
            medians = soak.judge()
            with shmmap.connect(one.endpoint) as client:
                counters = client.stats().counters
            code = one.stop()
            if code or one.leftovers():
                soak.problems.append(f"exit code {code}, left behind: {one.leftovers()}")
        finally:
            one.dispose()
    print(
        json.dumps(
            {
                "minutes": options.minutes,
                "pace": options.pace,
                "samples": soak.samples,
                "events": soak.events,
                "clients_killed": soak.deaths,
                "requests": counters["requests"],
                "loads": counters["loads_finished"],
                "evictions": counters["evictions"],
                "refused_over_budget": counters["refused_over_budget"],
                "budget_bytes": BUDGET,
                "peak_bytes": soak.peak_bytes,
                "after_warm_up_at_end_highest": medians,
                "load_average": os.getloadavg()[0],
                "problems": soak.problems,
            }
        )
    )
    return bool(soak.problems)


if __name__ == "__main__":
    sys.exit(main())
