# SPDX-License-Identifier: Apache-2.0
"""What making room costs, whatever there is in memory.

    python -m tests.benchmarks.eviction [--few 1000] [--many 100000] [--cells 4000] [--steps 1000000]

First the daemon's parts alone, without files: the time of one step of making room with so many segments
in memory, while 300 clients with routes of 64 vertices drive.  Then a daemon whose budget is full of tiny
cells, few and many of them: cold cells a second, the serving loop's processor time for each, and how long
two clients wait meanwhile that ask every 5 ms: one for warm cells, and one a process that echoes.  The
limit is at least 0.8 times as many cells a second with many in memory as with few.
"""

from __future__ import annotations

import argparse
import gc
import json
import math
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from shmmap.daemon.cache.evictor import Evictor
from shmmap.daemon.cache.ledger import Ledger
from shmmap.daemon.cache.reclaimer import TICK_S, Reclaimer
from shmmap.daemon.pins.probe import PinSource
from shmmap.daemon.records import Key, Resident
from shmmap.daemon.transport.sessions import Sessions
from shmmap.protocol.messages import Intent
from shmmap.statistics.cell_rows import CELL_ROW_BYTES
from shmmap.statistics.reader import read_statistics
from tests.benchmarks.make_many_cells import CELL_METRES, make_many_cells
from tests.support import connections
from tests.support.daemon_process import ROOT, DaemonProcess
from tests.support.moving import says
from tests.support.raw_client import RawClient

CLIENTS = 300
VERTICES = 64
SEGMENT_BYTES = 8192
AT_ONCE = 10
PERIOD_S = 0.005

_ECHO = """
import sys, zmq
socket = zmq.Context().socket(zmq.ROUTER)
socket.bind("ipc://" + sys.argv[1])
print("up", flush=True)
while True:
    socket.send_multipart(socket.recv_multipart())
"""

_ASK = """
import json, sys, time, zmq
from tests.support.message_pack import pack
from tests.support.raw_client import RawClient
path, what, until = sys.argv[1], sys.argv[2], sys.argv[3]
client = RawClient(path, hello=what == "daemon")
request = pack(["differential", 1, ["box", 5.0, 5.0, 95.0, 95.0], ["points"], [], b"", 10.0])
times = []
for _ in range(3):
    client.send_bytes(request)
    client.receive_bytes()
print("up", flush=True)
sys.stdin.readline()
import os
next_s = time.perf_counter()
while not os.path.exists(until):
    time.sleep(max(0.0, next_s - time.perf_counter()))
    begin = time.perf_counter()
    client.send_bytes(request)
    client.receive_bytes()
    times.append((time.perf_counter() - begin) * 1e3)
    next_s = max(next_s + 0.005, time.perf_counter() - 0.1)
json.dump(times, sys.stdout)
"""


def percentiles(times: Sequence[float]) -> str:
    """Describe times, in their own unit."""
    p50, p99 = np.percentile(times, [50, 99])
    return f"p50 {p50:8.3f}  p99 {p99:8.3f}  longest {max(times):8.3f}"


def steps(count: int) -> None:
    """Make room 2000 times with ``count`` segments in memory, and print how long a step takes."""
    nothing = SimpleNamespace(
        rename=lambda *_: True, unlink=lambda *_: True, keep=lambda *_: True, keeps=lambda *_: False,
        release=lambda *_: None, tell_once=lambda *_: None, is_used=lambda *_: False,
        source=PinSource.LEASES,
    )  # fmt: skip
    ledger, sessions = Ledger(count * SEGMENT_BYTES), Sessions()
    observer = SimpleNamespace(segment_retired=lambda *_: None, segment_gone=lambda *_: None)
    reclaimer = Reclaimer(ledger, cast("Any", nothing), sessions, cast("Any", nothing), cast("Any", observer))
    evictor = Evictor(reclaimer)
    side = math.isqrt(count - 1) + 1

    def appear(number: int, now_s: float) -> None:
        x, y = 20.0 * (number % side), 20.0 * (number // side % side)
        box = (x, y, x + 20.0, y + 20.0)
        key = Key(f"/{number}.pcd", "points")
        ledger.enter(Resident(f"/{number}", key, number, SEGMENT_BYTES, 1, box, 0.0, 1.0, last_use_s=now_s))

    now_s = 0.0
    for number in range(count):
        appear(number, now_s)
    while not ledger.order.settled:
        evictor.turn(now_s := now_s + 1.0)
    gc.disable()  # as the daemon does
    drivers = [sessions.open(connections.of(), "", 0.0) for _ in range(CLIENTS)]
    number, made, refreshed = count, list[float](), list[float]()
    for turn in range(2000):
        now_s += TICK_S
        driver = drivers[turn % CLIENTS]
        x, y = 20.0 * side * (turn % 17) / 17, 20.0 * side * (turn % 13) / 13
        says(driver, Intent(x, y, route=tuple((x + 90.0 * n, y + 50.0 * n) for n in range(VERTICES))), now_s)
        sessions.follow_moves()
        begin = time.thread_time()
        evictor.free(ledger.shortage(SEGMENT_BYTES), now_s)
        middle, scored = time.thread_time(), ledger.order.scored
        evictor.turn(now_s)
        end = time.thread_time()
        made.append((middle - begin) * 1e3)
        if ledger.order.scored > scored:
            refreshed.append((end - middle) * 1e3)
        reclaimer.sweep(now_s + TICK_S)
        number += 1
        appear(number, now_s)
    print(f"{count:8} segments: one step of making room {percentiles(made)} ms")
    print(f"{'':18} some scores brought up to date {percentiles(refreshed)} ms", flush=True)
    reclaimer.closer.end()


def main_thread_s(pid: int) -> float:
    """Processor time of a process's main thread, seconds."""
    return int(Path(f"/proc/{pid}/task/{pid}/schedstat").read_text().split()[0]) / 1e9


def churn(root: Path, side: int, resident: int, cells: int) -> float:
    """Load cold cells where as many as fit are in memory; returns how many a second."""
    budget = resident * (SEGMENT_BYTES + CELL_ROW_BYTES) + (1 << 20)
    one = DaemonProcess(root, "--budget", str(budget), "--session-quota", "1").start()
    until = f"{one.scratch_dir}/stop"
    helpers: list[subprocess.Popen[str]] = []

    def start(program: str, *arguments: str) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, "-c", program, *arguments],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT,
        )  # fmt: skip
        helpers.append(process)
        assert process.stdout is not None
        assert process.stdout.readline() == "up\n"
        return process

    def box(column: int, row: int, columns: int, rows: int) -> list[Any]:
        low_x, low_y = column * CELL_METRES + 1.0, row * CELL_METRES + 1.0
        return ["box", low_x, low_y, low_x + columns * CELL_METRES - 2.0, low_y + rows * CELL_METRES - 2.0]

    try:
        client = RawClient(one.endpoint, timeout=600.0)
        filled, row = 0, AT_ONCE
        while filled < resident + 1000:  # more than fit: from here on each load needs room
            filled += len(client.area(box(0, row, side, 4), wait=600.0).cells)
            client.release()
            row += 4
        echo = f"{one.scratch_dir}/echo"
        start(_ECHO, echo)
        asking = {what: start(_ASK, path, what, until) for what, path in
                  (("daemon", one.endpoint), ("echo", echo))}  # fmt: skip
        for process in asking.values():
            assert process.stdin is not None
            process.stdin.write("\n")
            process.stdin.flush()
        evicted = read_statistics(one.instance, one.shm_dir).counters["evictions"]
        loaded, begin_s, before_s = 0, time.perf_counter(), main_thread_s(one.pid)
        for number in range(cells // AT_ONCE**2):
            column = AT_ONCE * (number % (side // AT_ONCE))
            at = row + AT_ONCE * (1 + number // (side // AT_ONCE))
            loaded += len(client.area(box(column, at, AT_ONCE, AT_ONCE), wait=60.0).cells)
            client.release()
        end_s, after_s = time.perf_counter(), main_thread_s(one.pid)
        Path(until).touch()
        times = {what: json.load(process.stdout) for what, process in asking.items() if process.stdout}
        time.sleep(0.3)  # the next beat
        seen = read_statistics(one.instance, one.shm_dir).counters
        evicted = seen["evictions"] - evicted
        print(
            f"{seen['cells_resident']} in memory: {loaded / (end_s - begin_s):.0f} cold cells a second,"
            f" {evicted} evictions, {(after_s - before_s) / loaded * 1e6:.0f} us of the loop for each"
        )
        for what, found in times.items():
            print(f"    {what:6} meanwhile {percentiles(found)} ms, n={len(found)}", flush=True)
        client.close()
        return loaded / (end_s - begin_s)
    finally:
        for process in helpers:
            process.kill()
            process.communicate()
        one.stop()
        one.dispose()


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--few", type=int, default=1000)
    parser.add_argument("--many", type=int, default=100_000)
    parser.add_argument("--cells", type=int, default=4000, help="cold cells to load")
    parser.add_argument("--steps", type=int, default=1_000_000, help="segments for the parts alone, at most")
    arguments = parser.parse_args()
    for count in (1000, 100_000, 1_000_000):
        if count <= arguments.steps:
            steps(count)
    side = 10 * math.ceil(math.sqrt(arguments.many + arguments.cells + 20_000) / 10)
    with tempfile.TemporaryDirectory() as directory:
        root = Path(directory) / "map"
        make_many_cells(root, side)
        few, many = (churn(root, side, n, arguments.cells) for n in (arguments.few, arguments.many))
    print(f"cells a second, many in memory to few: {many / few:.2f}")


if __name__ == "__main__":
    main()
