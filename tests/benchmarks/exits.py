# SPDX-License-Identifier: Apache-2.0
"""Programs that end while a thread of theirs asks the daemon: each has to end by itself and say nothing.

Threads use the main thread's client, futures of it, one of their own, one after the other, a window, or an
event stream.  Prints, for each, how many programs ended by a signal, with another exit code, or said
anything.

    python -m tests.benchmarks.exits
"""

from __future__ import annotations

import argparse
import random
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Final, NamedTuple

from shmmap.testing.daemon_process import DaemonProcess
from tests.support.divided_map import make_map

PROGRAM: Final = """
import sys, threading, time
import shmmap
endpoint, after_s = sys.argv[1], float(sys.argv[2])
asked = threading.Event()
{setup}
def work():
    while True:
        {ask}
        asked.set()
for _ in range(2):
    threading.Thread(target=work, daemon=True).start()
asked.wait()
time.sleep(after_s)
"""

SCENES: Final = {
    "shared client": ("client = shmmap.connect(endpoint)", "client.around(0, 0, 50)"),
    "futures": ("client = shmmap.connect(endpoint)", "client.futures.around(0, 0, 50).result()"),
    "own client": (
        "from shmmap.events import EventStream; own = threading.local()",
        "own.client = getattr(own, 'client', None) or shmmap.connect(endpoint); own.client.around(0, 0, 50)",
    ),
    "client after client": ("", "shmmap.connect(endpoint).around(0, 0, 50)"),
    "closed at exit": (
        "import atexit; client = shmmap.connect(endpoint); atexit.register(client.close)",
        "client.metadata()",
    ),
    "window": (
        "window = shmmap.MapWindow(endpoint, 50.0, refresh_interval=0.001)",
        "window.move_to(time.monotonic() % 20, 0.0, wait=1.0)",
    ),
    "events": (
        "from shmmap.events import EventStream; own = threading.local()",
        "own.events = getattr(own, 'events', None) or EventStream(endpoint); own.events.next(0.01)",
    ),
}


class Ends(NamedTuple):
    """How many programs did not end as they should, and what the first of them said."""

    signals: int
    codes: int
    words: int
    first: str


def end_often(endpoint: str, setup: str, ask: str, exits: int, at_once: int = 2) -> Ends:
    """Have programs end, each after another short time."""
    code = PROGRAM.format(setup=setup, ask=ask)

    def one(after_s: float) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-c", code, endpoint, str(after_s)]
        return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)

    def times() -> Iterator[float]:
        chance = random.Random(ask)
        return (chance.random() * 0.02 for _ in range(exits))

    with ThreadPoolExecutor(at_once) as pool:
        done = list(pool.map(one, times()))
    wrong = [f"{one.returncode} {one.stdout}{one.stderr}" for one in done if one.returncode or one.stderr]
    return Ends(
        sum(one.returncode < 0 for one in done),
        sum(one.returncode > 0 for one in done),
        sum(bool(one.stdout or one.stderr) for one in done),
        wrong[0] if wrong else "",
    )


def main() -> int:
    """Measure and print; 1 if any program did not end as it should."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--exits", type=int, default=200)
    parser.add_argument("--scene", choices=SCENES, nargs="+", default=list(SCENES))
    args = parser.parse_args()
    bad = False
    with tempfile.TemporaryDirectory(prefix="shmmap-exits-") as place:
        made = make_map(Path(place) / "map", columns=2, rows=2)
        with DaemonProcess(made.root) as daemon:
            for scene in args.scene:
                ends = end_often(daemon.endpoint, *SCENES[scene], args.exits)
                bad = bad or bool(ends.first)
                print(
                    f"{scene}: {args.exits} exits, {ends.signals} by a signal,"
                    f" {ends.codes} with another code, {ends.words} said something"
                )
                if ends.first:
                    print(ends.first)
    return int(bad)


if __name__ == "__main__":
    sys.exit(main())
