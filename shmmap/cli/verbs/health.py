# SPDX-License-Identifier: Apache-2.0
"""``shmmap health``: is the daemon well?  For scripts and monitors: the exit code says it."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from shmmap.cli.options import Subparsers, add_statistics_options, add_verb
from shmmap.cli.screens.output import counted, format_duration, print_json, print_line
from shmmap.errors import DaemonUnreachable

if TYPE_CHECKING:
    from shmmap.statistics.snapshot import Snapshot

__all__ = ["add_parser", "run"]

_JSON = """\
  {"state": "healthy" | "starting" | "stopped": paused | "hung" | "dead", "beat_age_s", "pid", "instance",
   "defects": exceptions that the daemon survived, whose tracebacks its log has}
Exit code: 0 healthy, 1 starting, paused or hung, 69 dead or never started."""


def add_parser(subparsers: Subparsers) -> None:
    """Describe the verb."""
    parser = add_verb(
        subparsers,
        "health",
        run,
        help="is the daemon healthy? (exit code 0: yes)",
        description="Say whether the daemon is healthy, starting (it does not listen yet), paused (by SIGSTOP"
        " or a debugger), hung or dead.  Reads its statistics in shared memory, so it answers whatever the"
        " daemon does.",
        json=_JSON,
    )
    add_statistics_options(parser)


def run(args: argparse.Namespace) -> int:
    """Print one word and why; return what the exit code says."""
    from shmmap.cli.daemon_address import snapshot

    found, identity = snapshot(args)
    if args.json:
        print_json(
            {
                "state": found.state,
                "beat_age_s": round(found.beat_age_s, 6),
                "pid": identity.pid,
                "instance": identity.instance,
                "defects": found.counters.get("defects", 0),
            }
        )
    else:
        age = format_duration(found.beat_age_s)
        state = "paused" if found.state == "stopped" else found.state
        print_line(f"{state}: pid {identity.pid}, last heartbeat {age} ago{_defects(found)}")
    return {"healthy": 0, "dead": DaemonUnreachable.exit_code}.get(found.state, 1)


def _defects(found: Snapshot) -> str:
    """What the daemon survived, if anything: somebody should report it."""
    count = found.counters.get("defects", 0)
    return f"; it survived {counted(count, 'exception')}, see its log" if count else ""
