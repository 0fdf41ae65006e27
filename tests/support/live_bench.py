# SPDX-License-Identifier: Apache-2.0
"""What benchmarks of live maps share: scans of one size, a daemon, and processes beside it."""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Callable
from contextlib import ExitStack
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import shmmap
from shmmap.chunks.occupancy import ScanFilter
from tests.benchmarks.street_data import street
from tests.support.daemon_process import DaemonProcess

POINTS = 120_000
"""Of each scan: a recorded one that has fewer has some of them twice."""
RESOLUTION = 0.2
FILTER = ScanFilter(0.0, 30.0, -1000.0, 1000.0)
MAP = "drive"

Scan = tuple[NDArray[np.float32], NDArray[np.float64]]


def scans_of_the_street() -> list[Scan]:
    """All scans of the street, in the sensor's frame, with its poses."""
    there = street()
    poses = there.T_map_scans
    return [
        (np.resize(np.ascontiguousarray(there.scan(number), np.float32), (POINTS, 3)), pose)
        for number, pose in enumerate(poses)
    ]


def live_daemon(
    stack: ExitStack,
    state: Path,
    map_path: Path | str,
    *flags: str,
    linger_s: float = 2.0,
    **options: Any,
) -> DaemonProcess:
    """Start a daemon that keeps a live map in a directory; it is stopped and removed with the stack."""
    state.mkdir(parents=True, exist_ok=True)
    settings = state / "shmmap.toml"
    settings.write_text(
        f'[live.{MAP}]\nresolution = {RESOLUTION}\nlinger_s = {linger_s}\npath = "{state}/map"\n'
    )
    one = DaemonProcess(map_path, "--config", str(settings), *flags, **options)
    return stack.enter_context(one)


def percentiles(seconds: list[float]) -> str:
    """Median and 99th percentile, for people."""
    p50, p99 = np.percentile(np.array(seconds) * 1000.0, [50, 99])
    return f"p50 {p50:8.2f} ms   p99 {p99:8.2f} ms   of {len(seconds)}"


class Beside:
    """A process that repeats something until it is stopped.

    Parameters
    ----------
    begin
        Called in the process with the endpoint; returns what is done, and how many seconds that took.
    period_s
        From one time to the next.
    """

    def __init__(
        self, stack: ExitStack, begin: Callable[[str], Callable[[], float]], endpoint: str, period_s: float
    ) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_run, args=(begin, endpoint, period_s, theirs))
        self._process.start()
        stack.callback(self._process.join)
        stack.callback(self._pipe.send, None)
        self._pipe.recv()

    def start(self) -> None:
        """Have it begin."""
        self._pipe.send("start")

    def stop(self) -> list[float]:
        """Have it stop; returns the seconds of each time."""
        self._pipe.send("stop")
        found: list[float] = self._pipe.recv()
        return found


def _run(
    begin: Callable[[str], Callable[[], float]], endpoint: str, period_s: float, pipe: Connection
) -> None:
    work = begin(endpoint)
    pipe.send("ready")
    while pipe.recv() is not None:
        found: list[float] = []
        next_s = time.perf_counter()
        while not pipe.poll(max(0.0, next_s - time.perf_counter())):
            next_s = max(next_s + period_s, time.perf_counter())
            found.append(work())
        if pipe.recv() is None:
            return
        pipe.send(found)


def mapping(endpoint: str) -> Callable[[], float]:
    """Send the street's scans, one each time, and wait until each is applied."""
    scans = scans_of_the_street()
    mapper = shmmap.connect(endpoint).live(MAP).mapper("benchmark", FILTER)
    sent = 0

    def work() -> float:
        nonlocal sent
        points, pose = scans[sent % len(scans)]
        sent += 1
        began = time.perf_counter()
        mapper.add(points, pose)
        mapper.wait_applied()
        return time.perf_counter() - began

    work()  # kernels
    return work


def reading(endpoint: str) -> Callable[[], float]:
    """Look up some points around the scans' places in chunks, wherever they are now."""
    live: Any = shmmap.connect(endpoint).live(MAP)
    rng = np.random.default_rng(3)
    poses = street().T_map_scans

    def work() -> float:
        place = poses[rng.integers(len(poses)), :3, 3]
        points = place + rng.uniform(-5.0, 5.0, (1000, 3))
        began = time.perf_counter()
        live.log_odds(points)
        return time.perf_counter() - began

    work()
    return work
