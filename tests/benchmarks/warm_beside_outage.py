# SPDX-License-Identifier: Apache-2.0
"""Warm requests while the store of a published map fails, against a bare ZeroMQ echo in turns.

    python -m tests.benchmarks.warm_beside_outage [--seconds 10]

Another client asks for 60 cells that are not here, over and over, while the store answers as it should, sends
damaged bodies, status 503, nothing at all, or refuses connections.  The request is the packed one of
`tests.benchmarks.warm_request`, and processors are shared out as in `tests.benchmarks.warm_under_load`.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import tempfile
import time
from contextlib import ExitStack
from multiprocessing.connection import Connection
from pathlib import Path

from tests.benchmarks.warm_request import Warm, pin
from tests.benchmarks.warm_under_load import LOADED, Meanwhile, Other, heavy_cells, while_loading
from tests.support.command_line import publish
from tests.support.daemon_process import DaemonProcess
from tests.support.divided_map import make_map
from tests.support.web_servers import Fault, faulty_web

FAULTS = ("corrupt", "503", "stall", "refuse")


def serve(folder: Path, pipe: Connection) -> None:
    """Serve a directory, with the faults that the pipe's other side names."""
    with faulty_web(folder) as web:
        pipe.send(web.url)
        while (fault := pipe.recv()) is not None:
            if fault == "refuse":
                web.refuse()
            elif fault:
                web.fault = of_objects(fault)
            else:
                web.listen()
                web.heal()
            pipe.send(fault)


def of_objects(fault: str) -> Fault:
    """Return a fault of objects only."""
    return lambda path: fault if path.startswith("blobs/") else ""


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=10.0)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as directory, ExitStack() as stack:
        made = make_map(Path(directory) / "map", columns=20, rows=20, points=30)
        heavy = heavy_cells(made, LOADED, 60_000, 0)
        publish(made.root, f"{directory}/www")
        context = multiprocessing.get_context("spawn")
        pipe, theirs = context.Pipe()
        web = context.Process(target=serve, args=(Path(directory) / "www", theirs))
        web.start()
        stack.callback(web.join)
        stack.callback(pipe.send, None)
        one = DaemonProcess(pipe.recv(), "--poll", "0")
        stack.callback(one.dispose)
        one.start()
        stack.callback(one.stop)
        warm, other = Warm(one), Other(one.endpoint, stack)
        echo = warm.echo(one, "packed")
        stack.callback(echo.close)
        mine, *rest = sorted(os.sched_getaffinity(0))
        for pid in (one.pid, echo.process.pid):
            pin(pid, set(rest[:1]) or {mine})
        pin(os.getpid(), {mine})
        for fault in FAULTS:
            pipe.send(fault)
            assert pipe.recv() == fault
            meanwhile, passes = Meanwhile(warm, echo), 0
            end_s = time.monotonic() + arguments.seconds
            while time.monotonic() < end_s:
                other.send("selected", heavy, ["points"], 3.0)
                meanwhile.until(other)
                assert other.answer() == 0
                passes += 1
            meanwhile.told(f"while the store does this: {fault}", passes)
        pipe.send("")
        pipe.recv()
        while other.ask("selected", heavy, ["points"], 3.0) != len(heavy):
            pass
        other.ask("evict", heavy)
        meanwhile = Meanwhile(warm, echo)
        while_loading(one, other, meanwhile, heavy, 6)
        meanwhile.told("while the store serves as it should", 6)
        warm.close()


if __name__ == "__main__":
    main()
