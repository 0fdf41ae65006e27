# SPDX-License-Identifier: Apache-2.0
"""What a client notices of hostile clients, of very many cells, and of everything else that once held it up.

    python -m tests.benchmarks.hostile_p99 [--rounds 6] [--seconds 3]
    python -m tests.benchmarks.hostile_p99 --list
    python -m tests.benchmarks.hostile_p99 --scene A2 --scene A6
    python -m tests.benchmarks.hostile_p99 --all
    python -m tests.benchmarks.hostile_p99 --worst-five --minutes 10
    python -m tests.benchmarks.hostile_p99 --churn --minutes 10

Without options: the 99th percentile beside three hostile clients, over that beside three processes that only
compute.  The limit is at most 3.

A scene does to the daemon what once held an earlier one up.  Beside it another client asks for warm cells
every 5 ms, a third asks a bare ZeroMQ echo as often, and new clients come all the time.  Limits: the client's
longest answer took at most 50 ms more than the echo's, the daemon's own memory grew by at most 100 MiB, and
every client got in.  Exit code 1 if a limit does not hold.

On a machine that others use, too, a stall may be theirs: printed is how long the daemon's loop ran in the
client's longest wait, and how long it waited for a processor.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
import tempfile
from pathlib import Path


def main() -> int:
    """Play what was asked for, and print what came of it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=6)
    parser.add_argument("--seconds", type=float, default=3.0)
    parser.add_argument("--list", action="store_true", help="list the scenes")
    parser.add_argument("--scene", action="append", default=[], metavar="ROW", help="play a scene")
    parser.add_argument("--all", action="store_true", help="play all of them, one after the other")
    parser.add_argument("--worst-five", action="store_true", help="play the worst five at once")
    parser.add_argument("--churn", action="store_true", help="very many cells, clients, evictions, a reload")
    parser.add_argument("--minutes", type=float, default=10.0, help="of --worst-five and --churn")
    parser.add_argument("--lift", action="store_true", help="go before unrelated work (root)")
    parser.add_argument(
        "--maps", type=Path, metavar="DIR", help="keep very large maps there for the next time"
    )
    options = parser.parse_args()

    # not before: every actor's process imports this module
    from tests.benchmarks.hostile.stage import Stage, every_scene, play

    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # daemons and actors end with this process
    scenes = every_scene()
    if options.list:
        for name, one in scenes.items():
            print(f"{name:10} {one.sentence}")
        return 0
    wanted = list(options.scene)
    wanted += [name for name in scenes if options.all and name[1:].isdigit()]
    wanted += ["worst-five"] * options.worst_five + ["churn"] * options.churn
    for name in wanted:
        if name not in scenes:
            parser.error(f"there is no scene {name}; --list shows those there are")
    if wanted:
        with tempfile.TemporaryDirectory(prefix="shmmap-scenes-") as scratch:
            stage = Stage(Path(scratch), options.maps or Path(scratch), options.minutes, options.lift)
            return play([scenes[name] for name in wanted], stage)
    from tests.benchmarks.hostile.mixed import beside_hostile_and_busy

    beside_hostile_and_busy(options.rounds, options.seconds)
    return 0


if __name__ == "__main__":
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # numpy's threads would take part in every scene
    sys.exit(main())
