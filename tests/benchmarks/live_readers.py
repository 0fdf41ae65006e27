# SPDX-License-Identifier: Apache-2.0
"""Live maps under readers: the memory that a map takes, and what mapping waits for them.

    python -m tests.benchmarks.live_readers memory [--scans 96] [--readers 20] [--stopped 10]
    python -m tests.benchmarks.live_readers latency [--seconds 10] [--chunks 20000]

``memory`` (as root: it mounts a tmpfs of its own): a map of four mebibytes and points share a tmpfs.  Scans
come that change 64 chunks each; a reader maps every chunk file and lets none go, one touches what it has
mapped without end (SIGBUS ends it, and another takes its place), and readers within their limits look 512
chunks up each, stopped for some seconds wherever they are.  Every voxel of a chunk has one value at any
moment, so that a reader sees what is torn.  Limits: what the file system has given to the live map, sampled
at 50 Hz, is at most the budget, a tenth of it and a mebibyte; every cell of points is served; no reader sees
a wrong voxel or ends by a signal; `shmmap doctor` names the reader that keeps chunks within five seconds.

``latency``: the 99th percentile of a scan from its mapper to *applied*, ten a second, alone and beside 64
requests of readers in flight over that many chunks, beside readers of files on a disk that takes two seconds
for each, and beside 20 readers that move at 10 Hz.  Limit: twice as long as alone and 5 ms.

Measured beside those of BENCHMARKS.md: 99th percentile of a scan beside 64 requests in flight, 20 readers
that move, a disk of 2 s a read: 10.7, 21.3, 11.6 ms (alone 14.1 ms); 595 x 512 chunks read, none wrong.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

import shmmap
from shmmap.chunks.marks import Marks, encode_marks
from shmmap.errors import ShmmapError
from shmmap.protocol import live as messages
from shmmap.protocol.areas import BoxMessage
from shmmap.protocol.codec import encode
from tests.benchmarks.hostile.actors import Actor, Orders
from tests.support.daemon_process import ROOT, DaemonProcess
from tests.support.divided_map import make_map
from tests.support.live_bench import MAP, RESOLUTION, live_daemon, percentiles
from tests.support.raw_client import RawClient

BUDGET = 4 << 20
MAX_BYTES = BUDGET + BUDGET // 10 + (1 << 20)
CELLS = 16 << 20
SIDE_M = 64 * RESOLUTION
AHEAD = 16
"""Chunks along the path that a scan changes, and across it a quarter of that."""
PERIOD_S = 0.1


def constant_marks(keys: list[tuple[int, int, int]], bricks: int) -> Marks:
    """Hits in every voxel of the first bricks of each chunk."""
    words = np.tile(np.arange(4 * bricks, dtype=np.uint16), len(keys))
    each = np.full(len(keys), 4 * bricks, np.uint32)
    bits = np.full(len(words), np.iinfo(np.uint64).max, np.uint64)
    return Marks(np.array(keys, np.int32), each, np.zeros_like(each), bits, words)


class Mapper:
    """Sends constant scans, one at a time."""

    def __init__(self, endpoint: str, name: str = "constant") -> None:
        self._client = shmmap.connect(endpoint)
        self._session: Any = self._client.live(MAP)._session
        self._open(name)
        self.scan = self.opened.next_scan

    def _open(self, name: str) -> None:
        self.opened = self._session.ask(lambda n: messages.LiveOpen(n, MAP, name), messages.LiveOpened)

    def send(self, keys: list[tuple[int, int, int]], bricks: int) -> float:
        """Have these chunks take in a scan; returns the seconds that it took."""
        opened, scan = self.opened, self.scan
        data = encode_marks(constant_marks(keys, bricks), opened.map_id, opened.mapper, scan)
        x, y, z = ((part + 0.5) * SIDE_M for part in keys[0])
        name = f"{self._client.welcome.session:x}.{scan}"
        began = time.perf_counter()
        Path(opened.marks_dir, name).write_bytes(data)
        self._session.ask(
            lambda n: messages.LiveScan(n, MAP, opened.mapper, scan, name, len(data), (x, y, z)),
            messages.LiveApplied, quiet_s=60.0,
        )  # fmt: skip
        self.scan += 1
        return time.perf_counter() - began


def chunks_at(number: int) -> list[tuple[int, int, int]]:
    """What a scan changes: the next one moves on by a quarter of that, and comes back after 64."""
    first = number % 64 * AHEAD // 4
    return [(first + x, y, 0) for x in range(AHEAD) for y in range(AHEAD // 4)]


@contextlib.contextmanager
def mounted(size: int) -> Iterator[str]:
    """A tmpfs of this size."""
    path = tempfile.mkdtemp(prefix="live_readers.")
    try:
        subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size},mode=755", "tmpfs", path], check=True)
        yield path
    finally:
        subprocess.run(["umount", "-l", path], check=False)
        os.rmdir(path)


class Sampler:
    """What the file system has given away but to cells, the most of it, at 50 Hz."""

    def __init__(self, path: str) -> None:
        self._path, self.peak, self._ending = path, 0, threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while not self._ending.wait(0.02):
            space = os.statvfs(self._path)
            used = (space.f_blocks - space.f_bfree) * space.f_frsize
            for name in os.listdir(self._path):
                if not name.startswith("shmmap-live."):
                    with contextlib.suppress(OSError):
                        used -= os.stat(f"{self._path}/{name}").st_blocks * 512
            self.peak = max(self.peak, used)

    def end(self) -> int:
        """Stop; returns the most."""
        self._ending.set()
        self._thread.join()
        return self.peak


# --- the greedy ---------------------------------------------------------------------------------

GREEDY = """
import mmap, os, sys, time
path, touch, kept = sys.argv[1], sys.argv[2] == "touch", {}
print("ready", flush=True)
while True:
    for name in os.listdir(path):
        if name.startswith("shmmap-live.") and name not in kept and "_" in name:
            try:
                fd = os.open(f"{path}/{name}", os.O_RDONLY)
                kept[name] = fd, mmap.mmap(fd, 0, prot=mmap.PROT_READ)
            except (OSError, ValueError):
                continue
    if touch:
        for fd, data in list(kept.values()):
            sum(data[at] for at in range(0, len(data), 4096))
    time.sleep(0.001)
"""


class Greedy:
    """Keeps every chunk mapped; or touches all of it continuously, and is ended by SIGBUS."""

    def __init__(self, path: str, what: str) -> None:
        self._command = [sys.executable, "-c", GREEDY, path, what]
        self.ends, self._ending = 0, False
        self.process = self._begin()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _begin(self) -> subprocess.Popen[bytes]:
        return subprocess.Popen(self._command, stdout=subprocess.DEVNULL, start_new_session=True)

    def _run(self) -> None:
        while self.process.wait() == -signal.SIGBUS and not self._ending:
            self.ends += 1
            self.process = self._begin()

    def end(self) -> None:
        """End it."""
        self._ending = True
        self.process.kill()
        self._thread.join()


# --- honest readers -----------------------------------------------------------------------------


def honest(orders: Orders, endpoint: str, readers: int) -> tuple[int, int, list[str]]:
    """Look voxels of 512 chunks up, by some clients in turn, and list some; returns what was wrong, too."""
    maps = [shmmap.connect(endpoint).live(MAP) for _ in range(readers)]
    rng = np.random.default_rng(os.getpid())
    looks = refused = 0
    wrong: list[str] = []
    orders.say("ready")
    while orders.go_on():
        for live in maps:
            first = int(rng.integers(0, 64 * AHEAD // 4))
            keys = np.array([(first + n // 4, n % 4, 0) for n in range(512)])
            voxels = rng.integers(0, (8, 8, 4), (4, 512, 3))  # of the first brick, the same chunks four times
            points = ((keys * 64 + voxels) + 0.5) * RESOLUTION
            try:
                values = live.log_odds(points.reshape(-1, 3)).reshape(4, 512)
                looks += 1
                torn = np.flatnonzero((values != values[0]).any(axis=0))
                wrong += [f"{keys[at]}: {values[:, at]}" for at in torn[:3]]
                listed = live.voxels("occupied", shmmap.Box(first * SIDE_M, 0.0, first * SIDE_M + 5.0, 5.0))
                good = np.isin(listed.log_odds, [min(847 * n, 3476) for n in range(1, 9)])
                wrong += [f"listed {listed.log_odds[~good][:3]}"] if not good.all() else []
            except ShmmapError:
                refused += 1
    return looks, refused, wrong


class Honest:
    """Processes of honest readers, stopped for some seconds now and then."""

    def __init__(self, endpoint: str, processes: int, readers: int, stopped_s: float) -> None:
        self._all = [Actor(honest, endpoint, readers, is_bystander=True) for _ in range(processes)]
        for actor in self._all:
            actor.said()
        self._stopped_s, self._ending = stopped_s, threading.Event()
        self._thread = threading.Thread(target=self._stop_some)
        self._thread.start()

    def _stop_some(self) -> None:
        rng = np.random.default_rng(5)
        while not self._ending.wait(rng.uniform(0.05, 0.5)):
            pid = self._all[int(rng.integers(len(self._all)))].pid
            os.kill(pid, signal.SIGSTOP)
            self._ending.wait(self._stopped_s)
            os.kill(pid, signal.SIGCONT)

    def end(self) -> tuple[int, int, list[str], list[str]]:
        """End them; returns what they looked up, were refused and found wrong, and why any ended before."""
        self._ending.set()
        self._thread.join()
        found: tuple[int, int, list[str]] = 0, 0, []
        ended = []
        for actor in self._all:
            try:
                looks, refused, wrong = actor.end()
                found = found[0] + looks, found[1] + refused, found[2] + wrong
            except RuntimeError as error:  # noqa: PERF203  the others are asked, too
                ended.append(str(error))
        return *found, ended


def named_after(one: DaemonProcess, pid: int) -> float:
    """Seconds until `shmmap doctor` names a process; infinity if it does not."""
    command = [sys.executable, "-m", "shmmap.cli", "doctor", "--json", "--instance", one.instance]
    environment = {**os.environ, "SHMMAP_ENDPOINT": one.endpoint, "PYTHONPATH": str(ROOT)}
    environment["SHMMAP_SHM_DIR"] = one.shm_dir
    began = time.perf_counter()
    while time.perf_counter() < began + 20.0:
        done = subprocess.run(command, capture_output=True, text=True, env=environment)
        with contextlib.suppress(ValueError, KeyError):
            facts = {row["name"]: row["fact"] for row in json.loads(done.stdout)["findings"]}
            if f"pid {pid}:" in facts["live memory"]:
                return time.perf_counter() - began
    print(done.stdout[-2000:], done.stderr[-2000:])
    return float("inf")


def scene_of_memory(args: argparse.Namespace) -> bool:
    """Bar: one bound, whatever readers do."""
    with ExitStack() as stack:
        path = stack.enter_context(mounted(CELLS + MAX_BYTES))
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="live_readers.")))
        cells = make_map(folder / "map", columns=10, rows=10, points=2000)
        flags = ["--budget", str(CELLS), "--live-budget", str(BUDGET)]
        one = live_daemon(stack, folder / "state", cells.root, *flags, shm_dir=path)
        mapper = Mapper(one.endpoint)
        for number in range(8):
            mapper.send(chunks_at(number), 8)
        alone = [mapper.send(chunks_at(8 + number), 64) for number in range(args.scans)]
        sampler = Sampler(path)
        keeper, toucher = Greedy(path, "keep"), Greedy(path, "touch")
        stack.callback(keeper.end)
        stack.callback(toucher.end)
        readers = Honest(one.endpoint, max(1, args.readers // 5), 5, args.stopped)
        client = stack.enter_context(shmmap.connect(one.endpoint))
        beside: list[float] = []
        served, named_s = 0, float("inf")
        began = time.perf_counter()
        number = 8 + args.scans
        while len(beside) < args.scans or time.perf_counter() < began + args.stopped + 5.0:
            beside.append(mapper.send(chunks_at(number), 64))
            number += 1
            at = number * 7 % 90
            found = client.around(at % 10 * 20.0 - 95.0, at // 10 * 20.0 - 85.0, 5.0)
            served += len(found) > 0 and not found.failed and not found.pending
            if len(beside) == 10:
                named_s = named_after(one, keeper.process.pid)
        looks, refused, wrong, ended = readers.end()
        peak = sampler.end()
    met = (
        peak <= MAX_BYTES
        and served == len(beside)
        and not wrong
        and not ended
        and named_s <= 5.0
        and looks > 0
    )
    print(f"memory of the live map          {peak / 2**20:6.2f} MiB at most   limit {MAX_BYTES / 2**20:.2f}")
    print(f"scans alone                     {percentiles(alone)}")
    print(f"scans beside readers            {percentiles(beside)}")
    print(f"point cells                     {served} of {len(beside)} requests served")
    print(f"honest readers                  {looks} x 512 chunks, {refused} asked again, {len(wrong)} wrong")
    print(f"readers that ended early        {ended or 'none'}; one that touches what it maps: {toucher.ends}")
    print(f"doctor names chunks' holders    after {named_s:.1f} s   limit 5", *wrong[:3], sep="\n")
    return bool(met)


# --- latency ------------------------------------------------------------------------------------


def flooding(orders: Orders, endpoint: str, in_flight: int) -> int:
    """Keep requests in flight: pages of chunks, and lists of voxels."""
    clients = [RawClient(endpoint) for _ in range(4)]
    rng = np.random.default_rng(2)
    number = 0

    def ask(client: RawClient) -> None:
        nonlocal number
        number += 1
        if number % 2:
            after = (int(rng.integers(0, 200)), 0, 0)
            request: Any = messages.LiveChunks(number, MAP, None, 0, True, after)
        else:
            x, y = rng.uniform(0.0, 1000.0, 2)
            request = messages.LiveVoxels(number, MAP, "free", BoxMessage(x, y, x + 500.0, y + 500.0))
        client.send_bytes(encode(request))

    for client in clients:
        for _ in range(in_flight // len(clients)):
            ask(client)
    orders.say("ready")
    answers = 0
    while orders.go_on(0.0005):
        for client in clients:
            while client.readable():
                client.receive_bytes()
                answers += 1
                ask(client)
    for client in clients:
        client.close()
    return answers


def moving(orders: Orders, endpoint: str, readers: int) -> int:
    """Clients that drive, each 10 m/s somewhere else, and say so at 10 Hz."""
    maps = [shmmap.connect(endpoint).live(MAP) for _ in range(readers)]
    orders.say("ready")
    moves, step, next_s = 0, 0, time.monotonic()
    while orders.go_on(max(0.0, next_s - time.monotonic())):
        next_s = max(next_s + PERIOD_S, time.monotonic())
        step += 1
        for number, live in enumerate(maps):
            live.move_to(number * 60.0 + step, number * 55.0, 1.0)
            moves += 1
    return moves


def reading_disk(orders: Orders, endpoint: str, readers: int) -> int:
    """Clients that ask for voxels on the disk."""
    clients = [RawClient(endpoint) for _ in range(readers)]
    area = BoxMessage(0.0, 0.0, 2000.0, 2000.0)
    for number, client in enumerate(clients, 1):
        client.send_bytes(encode(messages.LiveVoxels(number, MAP, "free", area, "disk")))
    orders.say("ready")
    while orders.go_on(60.0):
        pass
    for client in clients:
        client.close()
    return 0


SLOW_DISK = """
import os, sys, time
if any("live_worker" in word for word in sys.orig_argv):
    from shmmap.live_worker.disk import map_database
    load = map_database.MapDatabase.load
    def slow(self, key, generation=0):
        if os.path.exists(__file__ + ".slow"):
            time.sleep(2.0)
        return load(self, key, generation)
    map_database.MapDatabase.load = slow
"""
"""``sitecustomize`` of the live worker: reading a chunk takes two seconds while there is a certain file."""


def measured(mapper: Mapper, seconds: float) -> list[float]:
    """Scans at 10 Hz; seconds of each."""
    found: list[float] = []
    end_s = next_s = time.monotonic()
    end_s += seconds
    while next_s < end_s:
        time.sleep(max(0.0, next_s - time.monotonic()))
        next_s = max(next_s + PERIOD_S, time.monotonic())
        first = len(found) % 20
        found.append(mapper.send([(first + x, y, 0) for x in range(6) for y in range(6)], 32))
    return found


def scene_of_latency(args: argparse.Namespace) -> bool:
    """Bar: mapping waits for no reader."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="live_readers.")))
        (hook := folder / "hook").mkdir()
        (hook / "sitecustomize.py").write_text(SLOW_DISK)
        environment = {"PYTHONPATH": f"{hook}:{ROOT}"}
        one = live_daemon(stack, folder / "state", "", "--live-budget", "1G", environment=environment)
        mapper = Mapper(one.endpoint)
        side = int(args.chunks**0.5) + 1
        keys = [(x, y, 0) for x in range(side) for y in range(side)]
        for first in range(0, len(keys), 2000):
            mapper.send(keys[first : first + 2000], 1)
        shmmap.connect(one.endpoint).live(MAP).save()
        measured(mapper, 2.0)
        good, alone = True, measured(mapper, args.seconds)
        print(f"{len(keys)} chunks; alone             {percentiles(alone)}")
        limit_s = 2 * float(np.percentile(alone, 99)) + 0.005
        for name, target, arguments in (
            ("64 requests in flight", flooding, (64,)),
            ("20 readers that move", moving, (20,)),
            ("readers of the disk", reading_disk, (20,)),
        ):
            if target is reading_disk:
                (hook / "sitecustomize.py.slow").touch()
            with Actor(target, one.endpoint, *arguments, is_bystander=True) as other:
                other.said()
                times = measured(mapper, args.seconds)
                counted = other.end()
            met = float(np.percentile(times, 99)) <= limit_s
            good &= met
            print(
                f"{name:26} {percentiles(times)}   limit {limit_s * 1000:.1f}: {'met' if met else 'MISSED'}"
                f"   ({counted})", flush=True,
            )  # fmt: skip
    return good


def main() -> int:
    """Measure and print; 1 if a limit is missed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", choices=["memory", "latency"])
    parser.add_argument("--scans", type=int, default=96)
    parser.add_argument("--readers", type=int, default=20)
    parser.add_argument("--stopped", type=float, default=10.0)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--chunks", type=int, default=20_000)
    args = parser.parse_args()
    print(f"load {os.getloadavg()[0]:.2f}")
    good = scene_of_memory(args) if args.scene == "memory" else scene_of_latency(args)
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
