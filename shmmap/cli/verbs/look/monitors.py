# SPDX-License-Identifier: Apache-2.0
"""``shmmap health``, ``metrics`` and ``doctor``: for scripts, for monitoring, and for finding faults."""

from __future__ import annotations

import argparse
import contextlib
import sys
import time
from typing import TYPE_CHECKING

from shmmap.cli.daemon_address import endpoint, has_lost_socket, locate, snapshot
from shmmap.cli.options import Subparsers, add_statistics_options, add_verb
from shmmap.cli.screens.output import counted, format_duration, print_hanging, print_json, print_line
from shmmap.doctor.verdicts import trust_problems
from shmmap.errors import DaemonUnreachable, NoSocket, ProtocolMismatch, ShmmapError
from shmmap.installed import RESTART

if TYPE_CHECKING:
    from shmmap.doctor.verdicts import Finding
    from shmmap.statistics.identity import DaemonIdentity
    from shmmap.statistics.reader import Snapshot

__all__ = ["add_doctor", "add_health", "add_metrics", "run_doctor", "run_health", "run_metrics"]

_HEALTH_EXIT = """\
Exit code: 0 healthy, 1 starting, unreachable, paused or hung, 69 dead or never started; with --strict
also 1, and `unhealthy`, while clients lack something: shmmap was replaced under the daemon, cells were
refused in the last minute, cells that were asked for cannot be loaded (they are named if the daemon
answers), the map's files are out of reach, the map could not be read again or has problems, its signature
has expired, the version that its origin offers is refused, or a live map has a problem, a damaged file or a
missing chunk."""


_NAMED = 3
"""Damaged files that are named, at most."""


def add_health(subparsers: Subparsers) -> None:
    """Add the verb ``health``."""
    parser = add_verb(
        subparsers,
        "health",
        run_health,
        help="is the daemon healthy? (exit code 0: yes)",
        description="Say whether the daemon is healthy, starting (it does not listen yet), unreachable (its"
        " socket was removed), paused (by SIGSTOP or a debugger), hung or dead.  Reads its statistics in"
        " shared memory, so it answers whatever the daemon does.",
        output="look.outputs.Health",
        epilog=_HEALTH_EXIT,
    )
    parser.add_argument(
        "--strict", action="store_true", help="unhealthy, too, while clients lack something (exit code 1)"
    )
    add_statistics_options(parser)


def run_health(args: argparse.Namespace) -> int:
    """Print the health in one word, with reasons; return the exit code."""
    found, identity = snapshot(args)
    troubles = _troubles(found)
    if found.state == "healthy" and (args.strict or args.json):
        troubles += _unloadable(found, identity)
    lost = found.state == "healthy" and has_lost_socket(found)
    state = "unreachable" if lost else found.state
    if args.json:
        from shmmap.cli.verbs.look.outputs import Health

        beat_age_s, defects = round(found.beat_age_s, 6), found.counters.get("defects", 0)
        print_json(Health(state, beat_age_s, identity.pid, identity.instance, defects, troubles))
    else:
        age = format_duration(found.beat_age_s)
        lacking = bool(args.strict and troubles and state == "healthy")
        shown = "unhealthy" if lacking else "paused" if state == "stopped" else state
        print_line(f"{shown}: pid {identity.pid}, last heartbeat {age} ago{_defects(found)}")
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
    """Return problems that clients have although the daemon replies."""
    counts = found.counters
    counted_troubles = (
        (counts.get("refused_over_budget_1min", 0), "cells refused for lack of memory in the last minute"),
        (counts.get("map_problems", 0), "problems in the map (`shmmap doctor`)"),
        (sum(bool(row.problem) for row in found.live), "live maps with a problem (`shmmap live ls`)"),
    )
    troubles = [f"{count:,} {text}" for count, text in counted_troubles if count]
    troubles += [
        f"live map {row.name}: {row.damaged_count:,} damaged files or missing chunks: "
        + ("; ".join(row.damaged[:_NAMED]) or "`shmmap live ls` names them")
        for row in found.live
        if row.damaged_count
    ]
    if counts.get("package_replaced", 0):
        troubles.append(f"{RESTART} (it keeps what is in memory)")
    if counts.get("origin_out", 0):
        troubles.append("no load succeeds: the map's files are out of reach (`shmmap doctor`)")
    troubles += trust_problems(counts, time.time())
    if counts.get("last_reload_failed", 0) and not counts.get("published_refusal", 0):
        troubles.append("the map could not be read again: its old state is served")
    return troubles


def _unloadable(found: Snapshot, identity: DaemonIdentity) -> list[str]:
    """Name the cells that could not be loaded when clients asked for them."""
    count = found.counters.get("unloadable", 0)
    if not count:
        return []
    from shmmap.doctor.cells import causes, failing_cells

    with contextlib.suppress(ShmmapError):
        if failing := failing_cells(identity.endpoint, identity, "shmmap health"):
            cells = counted(len({cell for cell, _ in failing}), "cell")
            return [f"{cells} cannot be loaded: {causes(failing)}"]
    return [f"{counted(count, 'layer')} of cells cannot be loaded: the daemon's log names them"]


def _defects(found: Snapshot) -> str:
    """Return a line about internal errors that the daemon survived and that should be reported."""
    count = found.counters.get("defects", 0)
    return f"; it survived {counted(count, 'exception')}, see its log" if count else ""


_METRICS_EPILOG = """\
For node_exporter's textfile collector, from a timer:
  shmmap metrics > /var/lib/node_exporter/shmmap.prom.new
  mv /var/lib/node_exporter/shmmap.prom.new /var/lib/node_exporter/shmmap.prom
Exit code: 0, or 69 when the daemon is dead or was never started (shmmap_up is 0 then)."""


def add_metrics(subparsers: Subparsers) -> None:
    """Add the verb ``metrics``."""
    parser = add_verb(
        subparsers,
        "metrics",
        run_metrics,
        help="counters and latencies in Prometheus' format",
        description="Print counters, gauges and latency histograms in Prometheus' text format.  Reads the "
        "daemon's statistics: works while the daemon is paused (SIGSTOP, a debugger) or hangs; not after "
        "`shmmap stop`.",
        epilog=_METRICS_EPILOG,
    )
    add_statistics_options(parser, json=False)


def run_metrics(args: argparse.Namespace) -> int:
    """Print the metrics once."""
    from shmmap.statistics.prometheus import exposition
    from shmmap.statistics.reader import read_statistics

    name, directory = locate(args)
    found = read_statistics(name, directory)
    sys.stdout.write(exposition(found, name))
    return DaemonUnreachable.exit_code if found.state in ("absent", "dead") else 0


_DOCTOR_EXIT = """\
Exit code: 0 no finding is `fail`, 1 one is, 78 the configuration has a mistake."""


def add_doctor(subparsers: Subparsers) -> None:
    """Add the verb ``doctor``."""
    parser = add_verb(
        subparsers,
        "doctor",
        run_doctor,
        help="find problems and suggest fixes",
        description="Check the daemon, its socket and group, the map, shared memory and its limits, live "
        "maps, where a published map comes from, the bridge to ROS, and what was left behind.  Changes "
        "nothing.  Run it as the user whose program has a problem.",
        output="look.outputs.Diagnosis",
        epilog=_DOCTOR_EXIT,
    )
    parser.add_argument(
        "--config",
        metavar="FILE",
        default="",
        help="the daemon's settings (default: the installed service's)",
    )
    add_statistics_options(parser)


def run_doctor(args: argparse.Namespace) -> int:
    """Print all findings."""
    from shmmap.daemon.config import installed_config_file, load_config
    from shmmap.doctor.checks import diagnose, examine
    from shmmap.doctor.verdicts import worst

    file = args.config or installed_config_file()
    flags = {"instance": args.instance, "endpoint": endpoint(args), "shm_dir": args.shm_dir}
    if flags["endpoint"]:
        with contextlib.suppress(NoSocket, ProtocolMismatch):
            flags["instance"], flags["shm_dir"] = locate(args)
    findings = diagnose(examine(load_config(flags, file=file), file))
    if args.json:
        from shmmap.cli.verbs.look import outputs

        print_json(outputs.Diagnosis(worst(findings), findings))
    else:
        _print_findings(findings)
    return 1 if worst(findings) == "fail" else 0


def _print_findings(findings: list[Finding]) -> None:
    width = max(len(one.name) for one in findings)
    for one in findings:
        state = "skip" if one.skipped else one.state
        print_hanging(f"{state.ljust(4)}  {one.name.ljust(width)}  ", one.fact)
        if one.advice:
            print_hanging(f"{' ' * (width + 6)}  -> ", one.advice)
