# SPDX-License-Identifier: Apache-2.0
"""What looking at a daemon costs: a snapshot, the daemon's CPU while `top` looks, and the verbs' start.

    python -m tests.benchmarks.statistics_snapshot [--cells 10000] [--seconds 20]

1. A snapshot of the statistics of a live daemon, with the segment open (limit: 15 us) and with opening
   it (limit: 50 us), beside the same numbers asked for by a `stats` request, and beside the least a
   program can do (open, read 8 kB, close).
2. The daemon's CPU time while it is idle and while ``shmmap top`` looks five times a second, in
   percent of one processor (limit: what `top` adds stays below 1 %).
3. The time that ``status --help``, ``status`` and ``ls`` take from start to end (limit: 150 ms), beside
   ``python -c pass``.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import pty
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path

import shmmap
from shmmap.statistics.reader import StatisticsReader
from tests.benchmarks.make_many_cells import make_many_cells
from tests.support.daemon_process import ROOT, DaemonProcess

ROUNDS = 3000
STARTS = 15
TICK_S = 1.0 / os.sysconf("SC_CLK_TCK")


def timed_us(call: Callable[[], object], rounds: int = ROUNDS) -> tuple[float, float]:
    """Median and minimum of one call, microseconds."""
    samples = []
    for _ in range(rounds):
        start_ns = time.perf_counter_ns()
        call()
        samples.append((time.perf_counter_ns() - start_ns) * 1e-3)
    return statistics.median(samples), min(samples)


def cpu_s(pid: int) -> float:
    """CPU time of a process, user and system."""
    parts = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(parts[11]) + int(parts[12])) * TICK_S


def cpu_percent(pid: int, seconds: float) -> float:
    """Share of one processor that a process takes over a while."""
    before, start_s = cpu_s(pid), time.monotonic()
    time.sleep(seconds)
    return 100.0 * (cpu_s(pid) - before) / (time.monotonic() - start_s)


def snapshots(daemon: DaemonProcess) -> None:
    """Part 1."""
    path = f"{daemon.shm_dir}/shmmap.{daemon.instance}.statistics"

    def least() -> None:
        fd = os.open(path, os.O_RDONLY)
        os.pread(fd, 8192, 0)
        os.close(fd)

    def opened() -> object:
        with StatisticsReader(daemon.instance, daemon.shm_dir) as reader:
            return reader.snapshot(tables=False).counters

    with StatisticsReader(daemon.instance, daemon.shm_dir) as reader:
        rows = [("least possible: open, read 8 kB, close", *timed_us(least))]
        rows.append(("snapshot, segment open", *timed_us(lambda: reader.snapshot(tables=False).counters)))
        rows.append(("snapshot, with opening", *timed_us(opened)))
        rows.append(
            (
                f"with {len(reader.snapshot().cells)} cells' rows",
                *timed_us(lambda: reader.snapshot().cells, 10),
            )
        )
        with shmmap.connect(daemon.endpoint) as client:
            rows.append(("the same by a request", *timed_us(client.stats, 30)))
    for name, median, least_us in rows:
        print(f"{name:42} median {median:10.1f} us   min {least_us:10.1f} us")
    limits = {"open": (rows[1][1], 15.0), "with opening": (rows[2][1], 50.0)}
    for name, (found, limit) in limits.items():
        print(f"  {name}: {found:.1f} us, limit {limit:.0f} us: {'holds' if found < limit else 'MISSED'}")


def watching(daemon: DaemonProcess, environment: dict[str, str], seconds: float) -> None:
    """Part 2."""
    idle = [cpu_percent(daemon.pid, seconds)]
    ours, theirs = pty.openpty()
    drain = threading.Thread(target=_drain, args=(ours,), daemon=True)
    drain.start()
    with subprocess.Popen(
        [sys.executable, "-m", "shmmap.cli", "top", "--interval", "0.2"],
        env=environment | {"TERM": "xterm-256color", "COLUMNS": "100", "LINES": "40"},
        stdin=theirs, stdout=theirs, stderr=theirs,
    ) as top:  # fmt: skip
        time.sleep(2.0)
        watched, own = cpu_percent(daemon.pid, seconds), 0.0
        own = cpu_percent(top.pid, seconds / 2)
        top.send_signal(signal.SIGTERM)
    os.close(theirs)
    idle.append(cpu_percent(daemon.pid, seconds))
    rest = statistics.mean(idle)
    print(f"daemon idle {rest:.2f} %, while top looks {watched:.2f} %; top itself {own:.1f} % of a processor")
    added = watched - rest
    print(f"  top at 5 Hz adds {added:+.2f} % to the daemon, limit 1 %: {'holds' if added < 1 else 'MISSED'}")
    print(f"  the daemon altogether, limit 1 %: {'holds' if watched < 1 else 'MISSED'}")


def _drain(fd: int) -> None:
    """Take what a program writes on its terminal, until that is closed."""
    with contextlib.suppress(OSError):
        while os.read(fd, 65536):
            pass


def children_cpu_s() -> float:
    """CPU time of the processes that have ended so far."""
    times = os.times()
    return times.children_user + times.children_system


def starts(environment: dict[str, str]) -> None:
    """Part 3."""
    commands = {
        "python -c pass": ["-c", "pass"],
        "status --help": ["-m", "shmmap.cli", "status", "--help"],
        "status": ["-m", "shmmap.cli", "status"],
        "health": ["-m", "shmmap.cli", "health"],
        "ls": ["-m", "shmmap.cli", "ls"],
    }
    for name, words in commands.items():
        wall, cpu = [], []
        for _ in range(STARTS):
            before, start_s = children_cpu_s(), time.perf_counter()
            subprocess.run([sys.executable, *words], env=environment, stdout=subprocess.DEVNULL, check=True)
            wall.append(1e3 * (time.perf_counter() - start_s))
            cpu.append(1e3 * (children_cpu_s() - before))
        median = statistics.median(wall)
        print(
            f"{name:16} median {median:4.0f} ms, min {min(wall):4.0f} ms,"
            f" CPU {statistics.median(cpu):4.0f} ms"
        )
        if not name.startswith("python"):
            print(f"  limit 150 ms: {'holds' if median < 150 else 'MISSED'}")


def main() -> None:
    """Run the three parts."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cells", type=int, default=10_000)
    parser.add_argument("--seconds", type=float, default=20.0)
    arguments = parser.parse_args()
    side = round(arguments.cells**0.5)
    with tempfile.TemporaryDirectory(prefix="shmmap-many-", dir="/var/tmp") as scratch:
        make_many_cells(Path(scratch, "map"), side)
        daemon = DaemonProcess(Path(scratch, "map"), "--budget", "512M").start()
        try:
            with shmmap.connect(daemon.endpoint) as client:
                # without a wait: the daemon loads all of them, and this program maps none
                client.area(shmmap.Box(0.0, 0.0, 20.0 * side, 20.0 * side), wait=0.0)
            with StatisticsReader(daemon.instance, daemon.shm_dir) as reader:
                while reader.snapshot(tables=False).counters["cells_resident"] < side * side:
                    time.sleep(0.1)
            print(
                f"{side * side} cells resident; load average {os.getloadavg()[0]:.2f}, {os.cpu_count()} CPUs"
            )
            environment = {k: v for k, v in os.environ.items() if not k.startswith("SHMMAP_")} | {
                "PYTHONPATH": str(ROOT),
                "SHMMAP_INSTANCE": daemon.instance,
                "SHMMAP_RUNTIME_DIR": daemon.runtime_dir,
                "SHMMAP_SHM_DIR": daemon.shm_dir,
            }
            snapshots(daemon)
            watching(daemon, environment, arguments.seconds)
            starts(environment)
            daemon.stop()
        finally:
            daemon.dispose()


if __name__ == "__main__":
    main()
