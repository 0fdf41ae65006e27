# SPDX-License-Identifier: Apache-2.0
"""Exceptions from signal handlers at random instants of a client's work: does anything stay behind?

    python -m tests.benchmarks.interrupts [--interrupts 100000] [--seed 1]

A timer's handler raises in the midst of requests, of attaching, of connecting, of a window's calls, of
waiting for futures and of following events, once or up to three times in a row, so that it hits what cleans
up, too.  After each, the client must answer; in the end it must close, and the process have the descriptors,
mappings of segments and threads of before.  What it has beyond them is printed by kind.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import os
import random
import re
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import shmmap
from shmmap.errors import Busy
from tests.support.daemon_process import DaemonProcess
from tests.support.divided_map import make_map

SETTLED_S = 30.0
IN_A_ROW = 3


class Interrupt(BaseException):
    """What the handler raises."""


class Interrupter:
    """Has a timer raise `Interrupt` at random instants."""

    def __init__(self, seed: int) -> None:
        self._chance = random.Random(seed)
        self._left = 0
        self.count = 0
        signal.signal(signal.SIGALRM, self._ring)

    def _ring(self, number: int, frame: FrameType | None) -> None:
        del number
        while self._left and frame is not None:
            if frame.f_code is Interrupter._again.__code__:
                self._left -= 1
                self.count += 1
                raise Interrupt
            frame = frame.f_back

    def during(self, work: Callable[[], object], longest_s: float) -> None:
        """Repeat ``work`` until it is interrupted."""
        next_s = self._chance.choice((0.0, 1e-4, 3e-4))
        self._left = IN_A_ROW if next_s else 1
        try:
            self._again(work, self._chance.uniform(2e-6, longest_s), next_s)
        except Interrupt:
            pass
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)

    def _again(self, work: Callable[[], object], first_s: float, next_s: float) -> None:
        """Only what is done in here is interrupted."""
        signal.setitimer(signal.ITIMER_REAL, first_s, next_s)
        while self._left:  # Python ignores exceptions in some places
            work()


def holdings(directory: str) -> Counter[str]:
    """Count this process's descriptors, mappings of segments, and threads, by kind."""
    gc.collect()
    kinds: Counter[str] = Counter()
    for number in os.listdir("/proc/self/fd"):
        with contextlib.suppress(FileNotFoundError):  # the one that lists them
            kinds["descriptor " + re.sub(r":\[\d+\]", "", os.readlink(f"/proc/self/fd/{number}"))] += 1
    for number in os.listdir("/proc/self/task"):
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):  # it has just ended
            kinds["thread " + Path(f"/proc/self/task/{number}/comm").read_text().strip()] += 1
    kinds["mapping"] = Path("/proc/self/maps").read_text().count(directory)
    return kinds


def settled(before: Counter[str], directory: str) -> Counter[str]:
    """Wait until nothing is left, or it is clear that it stays."""
    end_s = time.monotonic() + SETTLED_S
    while (now := holdings(directory)) != before and time.monotonic() < end_s:
        time.sleep(0.05)
    return now


def main(argv: list[str] | None = None) -> int:
    """Interrupt, count, print; returns 1 if anything stayed behind."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--interrupts", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args(argv)
    swallowed: Counter[str] = Counter()

    def swallow(seen: sys.UnraisableHookArgs) -> None:
        name = getattr(seen.object, "__qualname__", type(seen.object).__name__)
        swallowed[name] += 1

    sys.unraisablehook = swallow
    with tempfile.TemporaryDirectory() as folder, DaemonProcess(make_map(Path(folder, "map")).root) as one:
        shmmap.connect(one.endpoint).close()  # what is made once stays
        with shmmap.MapWindow(one.endpoint, 30) as first:
            first.move_to(0, 0, wait=60)
        del first
        shmmap.events.EventStream(one.endpoint).close()
        with shmmap.connect(one.endpoint) as second:
            second.futures.around(0, 0, 30).result()  # the thread that completes them stays
        begun = holdings(one.shm_dir)
        interrupter, chance = Interrupter(options.seed), random.Random(options.seed)
        client: Any = shmmap.connect(one.endpoint, timeout=20)
        window: Any = shmmap.MapWindow(client, 30, update_distance=0)
        blocking: Any = shmmap.MapWindow(client, 30, update_distance=0, background=False)

        def asked_together() -> None:
            futures = [client.futures.around(0, 0, radius) for radius in (5, 10, 30)]
            futures[0].result()
            futures[1].cancel()
            client.stats()
            futures[2].result()

        def moved(which: shmmap.MapWindow) -> None:
            which.move_to(chance.uniform(-40, 40), chance.uniform(-40, 40), wait=0.05)

        scenes: dict[str, tuple[Callable[[], object], float, int]] = {
            # what is done, the longest time before it is interrupted, its share
            "attaching": (lambda: client.around(0, 0, 30), 2e-3, 50),
            "requests": (client.stats, 1e-3, 20),
            "futures": (asked_together, 4e-3, 20),
            "window moved": (lambda: moved(window), 2e-3, 10),
            "blocking window moved": (lambda: moved(blocking), 2e-3, 15),
            "connecting": (lambda: shmmap.connect(one.endpoint), 2e-2, 4),
            "window opened": (lambda: shmmap.MapWindow(one.endpoint, 30).close(), 2e-2, 1),
            "events followed": (lambda: shmmap.events.EventStream(one.endpoint).close(), 2e-2, 1),
        }
        names, shares = list(scenes), [share for _, _, share in scenes.values()]
        refused: Counter[str] = Counter()
        worst_s = 0.0
        while interrupter.count < options.interrupts:
            name = chance.choices(names, shares)[0]
            work, longest_s, _ = scenes[name]
            try:
                interrupter.during(work, longest_s)
            except Busy:  # too many were interrupted
                pass
            except shmmap.ShmmapError as error:
                refused[f"{name}: {error}"] += 1
            asked_s = time.monotonic()
            try:
                if not client.around(0, 0, 10).complete:
                    refused[f"after {name}: not complete"] += 1
            except shmmap.ShmmapError as error:
                refused[f"after {name}: {error}"] += 1
            worst_s = max(worst_s, time.monotonic() - asked_s)
            if len(refused) > 20 or sum(refused.values()) > 50:
                break
        for opened in (window, blocking, client):
            opened.close()
        del opened, work, second
        scenes.clear()
        window = blocking = client = None
        shmmap.connect(one.endpoint).close()  # ends what was left open
        left = settled(begun, one.shm_dir)
    print(f"{interrupter.count} interrupts; the slowest request after one {worst_s:.2f} s")
    print(f"swallowed where Python ignores exceptions: {sum(swallowed.values())} {dict(swallowed)}")
    print(f"requests that failed: {sum(refused.values())} {dict(refused)}")
    print(f"descriptors, mappings, threads: {begun.total()} -> {left.total()}; left {dict(left - begun)}")
    return int(left != begun or bool(refused))


if __name__ == "__main__":
    raise SystemExit(main())
