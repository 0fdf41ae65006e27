# SPDX-License-Identifier: Apache-2.0
"""``python -m shmmap_clients.demo``: what ``shmmap demo --full`` starts to drive with the three programs.

It prints a line of JSON for each scan that it has sent, ``{"sent": n}``, and in the end one with all results,
as `shmmap demo --full --json` passes them on.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

from shmmap_clients.command_line import at_least, positive, run_command

__all__ = ["main"]


def main(argv: Sequence[str] | None = None) -> int:
    """Run the program and return the exit code."""
    return run_command(
        "shmmap_clients.demo",
        "Drive through the generated town of `shmmap demo` with localization, compare filter and elevation"
        " map on one daemon that serves it.",
        _add_options,
        _run,
        argv,
        epilog="Prints a line of JSON for each scan sent, and one with all results in the end.",
    )


def _add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--endpoint", required=True, metavar="PATH", help="request socket of the daemon")
    parser.add_argument("--shm-dir", required=True, metavar="DIR", help="directory of its segments")
    parser.add_argument(
        "--instance", required=True, metavar="NAME", help="its name, in those of its segments"
    )
    parser.add_argument("--seed", type=int, required=True, help="which town it serves")
    parser.add_argument(
        "--blocks", type=at_least(1), nargs=2, required=True, metavar=("X", "Y"), help="the town's size"
    )
    parser.add_argument(
        "--density", type=positive, required=True, help="of the town, points per square metre"
    )
    parser.add_argument("--length", type=positive, required=True, metavar="M", help="of the drive")
    parser.add_argument("--step", type=positive, required=True, metavar="M", help="between scans")
    parser.add_argument("--work", type=Path, required=True, metavar="DIR", help="for sockets and outputs")
    parser.add_argument(
        "--picture", type=Path, required=True, metavar="FILE", help="SVG of the compare filter"
    )


def _run(args: argparse.Namespace) -> int:
    from shmmap.simulation.lidar_drive import LidarDrive
    from shmmap.simulation.town import Town
    from shmmap_clients.demo.three_programs import ThreePrograms
    from shmmap_clients.demo.town_drive import drive_through_town

    def tell(so_far: ThreePrograms) -> None:
        _say({"sent": so_far.scans})

    town = Town(seed=args.seed, blocks=tuple(args.blocks), density=args.density)
    drive = LidarDrive(town, args.length, step=args.step)
    result, errors = drive_through_town(drive, args.endpoint, args.shm_dir, args.instance, args.work, tell)
    shutil.copy(args.work / "compare.svg", args.picture)
    runs = result.programs
    _say(
        {
            "scans": result.scans,
            "shm_bytes": max(result.segment_bytes, default=0),
            "programs": {name: run.document for name, run in runs.items()},
            "memory": {
                name: {
                    "own_bytes": max(run.own_bytes, default=0),
                    "growth_bytes": run.growth_bytes,
                    "shared_bytes": run.shared_bytes,
                }
                for name, run in runs.items()
            },
            "errors": dataclasses.asdict(errors),
        }
    )
    return 0


def _say(message: dict[str, object]) -> None:
    sys.stdout.write(json.dumps(message) + "\n")
    sys.stdout.flush()
