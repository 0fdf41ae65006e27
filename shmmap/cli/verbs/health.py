# SPDX-License-Identifier: Apache-2.0
"""``shmmap health``: is the daemon well?  For scripts and monitors: the exit code says it."""

from __future__ import annotations

import argparse
import time
from typing import TYPE_CHECKING

from shmmap.cli.options import Subparsers, add_statistics_options, add_verb
from shmmap.cli.screens.output import counted, format_duration, print_json, print_line
from shmmap.doctor.signed_map import trust_problems
from shmmap.errors import DaemonUnreachable

if TYPE_CHECKING:
    from shmmap.statistics.snapshot import Snapshot

__all__ = ["add_parser", "run"]

_JSON = """\
  {"state": "healthy" | "starting" | "unreachable": its socket was removed | "stopped": paused | "hung" |
   "dead", "beat_age_s", "pid", "instance",
   "defects": exceptions that the daemon survived, whose tracebacks its log has,
   "troubles": [text], what --strict counts}
Exit code: 0 healthy, 1 starting, unreachable, paused or hung, 69 dead or never started; with --strict
also 1 while clients lack something: cells were refused in the last minute, the map's files are out of
reach, the map could not be read again or has problems, its signature has expired, the version that its origin
offers is refused, or a live map has a problem."""


def add_parser(subparsers: Subparsers) -> None:
    """Describe the verb."""
    parser = add_verb(
        subparsers,
        "health",
        run,
        help="is the daemon healthy? (exit code 0: yes)",
        description="Say whether the daemon is healthy, starting (it does not listen yet), unreachable (its"
        " socket was removed), paused (by SIGSTOP or a debugger), hung or dead.  Reads its statistics in"
        " shared memory, so it answers whatever the daemon does.",
        json=_JSON,
    )
    parser.add_argument(
        "--strict", action="store_true", help="unhealthy, too, while clients lack something (exit code 1)"
    )
    add_statistics_options(parser)


def run(args: argparse.Namespace) -> int:
    """Print one word and why; return what the exit code says."""
    from shmmap.cli.daemon_address import has_lost_socket, snapshot

    found, identity = snapshot(args)
    troubles = _troubles(found)
    lost = found.state == "healthy" and has_lost_socket(found)
    state = "unreachable" if lost else found.state
    if args.json:
        print_json(
            {
                "state": state,
                "beat_age_s": round(found.beat_age_s, 6),
                "pid": identity.pid,
                "instance": identity.instance,
                "defects": found.counters.get("defects", 0),
                "troubles": troubles,
            }
        )
    else:
        age = format_duration(found.beat_age_s)
        told = "paused" if state == "stopped" else state
        print_line(f"{told}: pid {identity.pid}, last heartbeat {age} ago{_defects(found)}")
        if lost:
            print_line(
                f"another program removed its socket {identity.endpoint}: it makes it again within seconds,"
                " or its log says what is in the way"
            )
        if args.strict:
            for trouble in troubles:
                print_line(f"  {trouble}")
    if args.strict and troubles and state == "healthy":
        return 1
    return {"healthy": 0, "dead": DaemonUnreachable.exit_code}.get(state, 1)


def _troubles(found: Snapshot) -> list[str]:
    """What clients lack although the daemon answers."""
    counts = found.counters
    counted_troubles = (
        (counts.get("refused_over_budget_1min", 0), "cells refused for lack of memory in the last minute"),
        (counts.get("map_problems", 0), "problems in the map (`shmmap doctor`)"),
        (sum(bool(row.problem) for row in found.live), "live maps with a problem (`shmmap live ls`)"),
    )
    troubles = [f"{count:,} {text}" for count, text in counted_troubles if count]
    if counts.get("origin_out", 0):
        troubles.append("no load succeeds: the map's files are out of reach (`shmmap doctor`)")
    troubles += trust_problems(counts, time.time())
    if counts.get("last_reload_failed", 0) and not counts.get("published_refusal", 0):
        troubles.append("the map could not be read again: its old state is served")
    return troubles


def _defects(found: Snapshot) -> str:
    """What the daemon survived, if anything: somebody should report it."""
    count = found.counters.get("defects", 0)
    return f"; it survived {counted(count, 'exception')}, see its log" if count else ""
