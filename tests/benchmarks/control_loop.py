# SPDX-License-Identifier: Apache-2.0
"""What a control loop of 100 Hz in C++ waits for its window, whatever the daemon does: needs g++.

    python -m tests.benchmarks.control_loop [--seconds 20]

Each round moves the window's pose by 0.1 m, and sleeps once for the time that `move_to` may take (20 ms,
its default), which is what an empty loop on this machine waits.  The daemon runs, is stopped (SIGSTOP) and
goes on, is killed and started again every second, or is absent all the time.  At the end the window's
cells are compared with those of the map.
"""

from __future__ import annotations

import argparse
import signal
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np

import shmmap
from tests.support.compiled_programs import ControlLoop, Rounds, compiled_loop
from tests.support.daemon_process import DaemonProcess
from tests.support.divided_map import make_map

WAIT_S = 0.02
LIMIT_S = WAIT_S + 0.005


def stop_and_go(daemon: DaemonProcess, over: threading.Event) -> None:
    """Stop it for a second, let it go on for one."""
    while not over.wait(1.0):
        daemon.send(signal.SIGSTOP)
        over.wait(1.0)
        daemon.send(signal.SIGCONT)


def kill_and_start(daemon: DaemonProcess, over: threading.Event) -> None:
    """Kill it and start it again, a second each."""
    while not over.wait(1.0):
        daemon.kill()
        over.wait(1.0)
        daemon.start()


def report(name: str, rounds: Rounds) -> None:
    """Print a row."""
    call, sleep = (
        np.quantile(np.asarray(one) * 1e3, [0.5, 0.99, 0.999, 1.0])
        for one in (rounds.calls_s, rounds.sleeps_s)
    )
    over_ms = call[2] - (sleep[2] - WAIT_S * 1e3)
    errors = ", ".join(f"{count} {code}" for code, count in rounds.codes.items() if code != "-") or "none"
    print(
        f"{name:16} move_to p50 {call[0]:.2f} p99 {call[1]:.2f} p99.9 {call[2]:.2f} longest {call[3]:.2f} ms;"
        f" a sleep of {WAIT_S * 1e3:.0f} ms p99.9 {sleep[2]:6.2f}; less its excess {over_ms:6.2f}"
        f" (limit {LIMIT_S * 1e3:.0f}); errors: {errors}"
    )


def main() -> None:
    """Run all four, and compare."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=20.0, help="of each case (default %(default)s)")
    seconds = parser.parse_args().seconds
    cases: dict[str, Callable[[DaemonProcess, threading.Event], None] | None] = {
        "the daemon runs": None,
        "it is stopped": stop_and_go,
        "it is killed": kill_and_start,
    }
    steps = int(seconds / (2 * WAIT_S))
    with tempfile.TemporaryDirectory() as scratch:
        made = make_map(Path(scratch, "map"), columns=40, rows=6)
        program = compiled_loop(Path(scratch))
        with DaemonProcess(made.root) as daemon:
            for name, act in cases.items():
                loop = ControlLoop(program, daemon.endpoint, 40.0)
                over = threading.Event()
                loop.begin(steps, wait=WAIT_S)
                acting = threading.Thread(target=act, args=(daemon, over)) if act is not None else None
                if acting is not None:
                    acting.start()
                report(name, loop.rounds())
                over.set()
                if acting is not None:
                    acting.join()
                is_complete, x, held = loop.complete(30.0)
                with shmmap.connect(daemon.endpoint) as client:
                    cells = client.around(x, 0.0, 40.0)
                assert is_complete
                assert held == {cell.id: cell.version for cell in cells}
                assert loop.close() == 0
        loop = ControlLoop(program, str(Path(scratch, "no-daemon.sock")), 40.0)
        report("there is none", loop.go(steps, wait=WAIT_S))
        loop.close()


if __name__ == "__main__":
    main()
