# SPDX-License-Identifier: Apache-2.0
"""A client beside three hostile clients, and beside three unrelated processes as busy as they.

In turns: nothing; three processes that only compute; three clients that do all they can to the daemon: one
floods it with requests and reads no reply, one sends garbage of all sizes up to frames that are too large,
one connects and disconnects, asks for the whole map and for statistics without end.  All of them run all the
time and are stopped (SIGSTOP) while it is not their turn.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from tests.support.daemon_process import DaemonProcess, LineProcess
from tests.support.divided_map import make_map
from tests.support.message_pack import pack
from tests.support.process_costs import processor_s
from tests.support.raw_client import RawClient, pack_versions

PERIOD_S = 0.005
SETTLE_S = 0.3
MEDDLERS = 3

_BUSY = """
import sys
block = bytearray(1 << 20)
print("up", flush=True)
while True:
    for _ in range(100):
        total = sum(range(1000))
    block[:] = bytes(block)
"""

_PRELUDE = """
import os, random, sys, zmq
from tests.support.message_pack import pack
from tests.support.raw_client import RawClient, circle
path = sys.argv[1]
rng = random.Random(1)
client = RawClient(path)
client.socket.sndtimeo = 100
print("up", flush=True)

def send(one, data):
    try:
        one.send(data)
    except zmq.Again:
        pass
"""

_HOSTILE = (
    """
message = pack(["area", 1, circle(0, 0, 100), ["points"], 10.0])
while True:
    send(client.socket, message)
""",
    """
def fresh():
    one = zmq.Context.instance().socket(zmq.DEALER)
    one.linger = 0
    one.sndtimeo = 100
    one.connect("ipc://" + path)
    return one
one = fresh()
while True:
    for size in (0, 3, 40, 3000, 70_000, 1 << 20, 3 << 20):
        for _ in range(20):
            send(one, rng.randbytes(size))
    send(one, bytes(8 << 20))
    one.close()
    one = fresh()
""",
    """
while True:
    for _ in range(20):
        send(client.socket, pack(["stats", 1]))
        send(client.socket, pack(["area", 1, circle(0, 0, 1e6), ["points"], None]))
        send(client.socket, pack(["metadata", 1]))
    while client.readable():
        client.receive_bytes()
    with RawClient(path, hello=False) as visitor:
        visitor.send("hello", 3, 0, "visitor")
""",
)


def start(program: str, *arguments: str) -> LineProcess:
    """Start one meddler and stop it again, until its turn comes."""
    started = LineProcess(sys.executable, "-c", program, *arguments, stderr=subprocess.DEVNULL)
    started.read()
    started.process.send_signal(signal.SIGSTOP)
    return started


@contextlib.contextmanager
def running(processes: list[LineProcess]) -> Iterator[None]:
    """Let some meddlers run."""
    for process in processes:
        process.process.send_signal(signal.SIGCONT)
    time.sleep(SETTLE_S)
    try:
        yield
    finally:
        for process in processes:
            process.process.send_signal(signal.SIGSTOP)


def paced(client: RawClient, request: bytes, seconds: float) -> list[float]:
    """Milliseconds of round trips, one every period."""
    times = []
    next_s = time.perf_counter()
    end_s = next_s + seconds
    while next_s < end_s:
        time.sleep(max(0.0, next_s - time.perf_counter()))
        begin = time.perf_counter()
        client.send_bytes(request)
        client.receive_bytes()
        times.append((time.perf_counter() - begin) * 1e3)
        next_s += PERIOD_S
    return times


def beside_hostile_and_busy(rounds: int, seconds: float) -> None:
    """Measure and print: ``rounds`` rounds of three times ``seconds`` seconds."""
    with tempfile.TemporaryDirectory() as directory:
        made = make_map(Path(directory) / "map", columns=20, rows=20, points=30)
        one = DaemonProcess(made.root, "--budget", "1G").start()
        client = RawClient(one.endpoint)
        everything = client.area(["box", -300.0, -300.0, 300.0, 300.0]).cells
        held = pack_versions([handle.version for handle in everything[:60]])
        request = pack(["differential", 1, ["box", -99.0, -99.0, 99.0, 99.0], ["points"], [], held, 10.0])
        groups = {
            "nothing": [],
            "busy processes": [start(_BUSY) for _ in range(MEDDLERS)],
            "hostile clients": [start(_PRELUDE + program, one.endpoint) for program in _HOSTILE],
        }
        times: dict[str, list[list[float]]] = {name: [] for name in groups}
        used: dict[str, float] = dict.fromkeys(groups, 0.0)
        began = dict.fromkeys(groups, 0.0)
        try:
            for _ in range(rounds):
                for name, processes in groups.items():
                    pids = [process.pid for process in processes]
                    before_s = sum(map(processor_s, pids))
                    begin_s = time.monotonic()
                    with running(processes):
                        times[name].append(paced(client, request, seconds))
                    used[name] += sum(map(processor_s, pids)) - before_s
                    began[name] += time.monotonic() - begin_s
        finally:
            for process in [p for processes in groups.values() for p in processes]:
                process.kill()
            client.close()
            one.stop()
            one.dispose()
    for name, taken in times.items():
        p50, p99 = np.percentile(np.concatenate(taken), [50, 99])
        share = used[name] / began[name]
        print(
            f"beside {name:16} p50 {p50:7.3f} ms  p99 {p99:8.3f} ms  n={sum(map(len, taken)):6}"
            f"  they used {share:.2f} processors"
        )
    paired = [
        np.percentile(hostile, 99) / np.percentile(busy, 99)
        for hostile, busy in zip(times["hostile clients"], times["busy processes"], strict=True)
    ]
    pooled = [np.percentile(np.concatenate(times[n]), 99) for n in ("hostile clients", "busy processes")]
    print(
        f"p99 beside hostile clients / beside busy processes: {np.median(paired):.2f} (median of paired"
        f" rounds), {pooled[0] / pooled[1]:.2f} (all rounds together); load {os.getloadavg()[0]:.1f}"
    )
