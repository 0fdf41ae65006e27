# SPDX-License-Identifier: Apache-2.0
"""``shmmap health``, ``metrics`` and ``doctor``: for scripts, for monitoring, and for finding faults."""

from __future__ import annotations

import argparse
import contextlib
import sys
import threading
from typing import TYPE_CHECKING

from shmmap.cli.daemon_address import (
    endpoint,
    has_lost_socket,
    instance,
    lists,
    locate,
    shm_dir,
    snapshot,
)
from shmmap.cli.options import Subparsers, add_statistics_options, add_verb
from shmmap.cli.screens.output import (
    counted,
    format_duration,
    print_hanging,
    print_json,
    print_line,
    print_styled,
    state_style,
)
from shmmap.doctor.verdicts import troubles, worst
from shmmap.errors import DaemonUnreachable, NoSocket, ProtocolMismatch, ShmmapError

if TYPE_CHECKING:
    from shmmap.doctor.verdicts import Finding
    from shmmap.statistics.identity import DaemonIdentity
    from shmmap.statistics.reader import Snapshot

_HEALTH_EXIT = """\
Exit code: 0 healthy, 1 starting, unreachable, paused or hung, 69 dead or never started; with --strict
also 1, and `unhealthy`, while clients lack something: shmmap was replaced under the daemon, cells were
refused in the last minute, cells that were asked for cannot be loaded (they are named if the daemon
answers), the map's files are out of reach, the map could not be read again or has problems, its signature
has expired, the version that its origin offers is refused, or a live map has a problem or a
lost chunk."""


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
    if args.strict or args.json:
        with lists(args, "shmmap health") as asked:
            asked.add_to(found)
    lacking = [f"{one.fact} ({one.advice})" for one in troubles(found)]
    if found.state == "healthy" and (args.strict or args.json):
        lacking += _unloadable(found, identity)
    lost = found.state == "healthy" and has_lost_socket(found)
    state = "unreachable" if lost else found.state
    if args.json:
        from shmmap.cli.verbs.look.outputs import Health

        beat_age_s, defects = round(found.beat_age_s, 6), found.counters.get("defects", 0)
        print_json(Health(state, beat_age_s, identity.pid, identity.instance, defects, lacking))
    else:
        age = format_duration(found.beat_age_s)
        unhealthy = bool(args.strict and lacking and state == "healthy")
        shown = "unhealthy" if unhealthy else "paused" if state == "stopped" else state
        print_line(f"{shown}: pid {identity.pid}, last heartbeat {age} ago{_defects(found)}")
        if lost:
            print_line(
                f"another program removed its socket {identity.endpoint}: it makes it again within seconds,"
                " or its log says what is in the way"
            )
        if args.strict:
            for trouble in lacking:
                print_line(f"  {trouble}")
    if args.strict and lacking and state == "healthy":
        return 1
    return {"healthy": 0, "dead": DaemonUnreachable.exit_code}.get(state, 1)


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
With --listen, in prometheus.yml:
  scrape_configs: [{job_name: shmmap, static_configs: [{targets: ["127.0.0.1:9731"]}]}]
Exit code: 0, or 69 when the daemon is dead or was never started (shmmap_up is 0 then); with --listen 75 when
another program listens there, 71 when that is not permitted."""


def add_metrics(subparsers: Subparsers) -> None:
    """Add the verb ``metrics``."""
    parser = add_verb(
        subparsers,
        "metrics",
        run_metrics,
        help="counters and latencies in Prometheus' format",
        description="Print counters, gauges and latency histograms in Prometheus' text format.  Reads the "
        "daemon's statistics: works while the daemon is paused (SIGSTOP, a debugger) or hangs, but for those "
        "of live maps; not after `shmmap stop`.\n"
        "With --listen, answer Prometheus' scrapes until Ctrl-C, also before the daemon starts and after it "
        "ends: then shmmap_up is 0.",
        epilog=_METRICS_EPILOG,
    )
    parser.add_argument(
        "--listen",
        metavar="ADDRESS",
        help="serve http://ADDRESS/metrics; a port of 127.0.0.1, or HOST:PORT, which others may reach",
    )
    add_statistics_options(parser, json=False)


def run_metrics(args: argparse.Namespace) -> int:
    """Print the metrics once, or serve them."""
    from shmmap.statistics.prometheus import exposition
    from shmmap.statistics.reader import read_statistics

    if args.listen is not None:
        return _serve_metrics(args)
    name, directory = locate(args)
    found = read_statistics(name, directory)
    with lists(args, "shmmap metrics") as asked:
        asked.add_to(found)
    sys.stdout.write(exposition(found, name))
    return DaemonUnreachable.exit_code if found.state in ("absent", "dead") else 0


def _serve_metrics(args: argparse.Namespace) -> int:
    """Answer scrapes until a signal; the daemon may come, hang and go meanwhile."""
    from shmmap.cli.listening import listen_address, listening_at
    from shmmap.cli.verbs.look.metrics_server import MetricsServer
    from shmmap.statistics.prometheus import exposition
    from shmmap.statistics.reader import read_statistics

    place: tuple[str, str] | None = None
    asking = threading.Lock()  # each scrape has a thread

    def scrape() -> str:
        nonlocal place
        if place is None:
            with contextlib.suppress(ShmmapError):  # no daemon yet
                place = locate(args)
        name, directory = place or (instance(args), shm_dir(args))
        found = read_statistics(name, directory)
        if found.identity is None:
            place = None  # the next one may keep its segments elsewhere
        with asking:
            asked.add_to(found)
        return exposition(found, name)

    server = MetricsServer(listening_at(*listen_address(args.listen)), scrape)
    with server, lists(args, "shmmap metrics") as asked:
        print_line(f"serving {server.url}", flush=True)
        server.serve_forever()
    return 0


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
        "maps, where a published map comes from, the bridge to ROS, and what was left behind: what is wrong "
        "first, equal causes once.  Changes nothing.  Run it as the user whose program has a problem.",
        output="look.outputs.Diagnosis",
        epilog=_DOCTOR_EXIT,
    )
    parser.add_argument(
        "--config",
        metavar="FILE",
        default="",
        help="the daemon's settings (default: the installed service's)",
    )
    parser.add_argument("--all", action="store_true", help="show what is in order, too, not its names alone")
    add_statistics_options(parser)


def run_doctor(args: argparse.Namespace) -> int:
    """Print all findings."""
    from shmmap.daemon.config import installed_config_file, load_config
    from shmmap.doctor.checks import diagnose, examine

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
        _print_findings(findings, everything=args.all)
    return 1 if worst(findings) == "fail" else 0


_STATES = ("fail", "warn", "ok", "skip")  # in the order of the output
_DIM = "bright_black"


def _print_findings(findings: list[Finding], *, everything: bool) -> None:
    """Print how many there are of each state, then the findings, worst first; fold what needs nothing."""
    by_state: dict[str, list[Finding]] = {state: [] for state in _STATES}
    for one in findings:
        by_state["skip" if one.skipped else one.state].append(one)
    counts = [
        counted(len(by_state["fail"]), "problem"),
        counted(len(by_state["warn"]), "warning"),
        f"{len(by_state['ok'])} ok",
        f"{len(by_state['skip'])} not applicable",
    ]
    verdict = worst(findings)
    print_styled([(f"{verdict}:", state_style(verdict)), (f" {', '.join(counts)}", "")])
    shown: list[tuple[str, str, Finding]] = []
    folded: list[tuple[str, str]] = []
    for state, ones in by_state.items():
        open_ones = [one for one in ones if everything or one.advice or state in ("fail", "warn")]
        shown += [(state, names, one) for names, one in _by_cause(open_ones)]
        rest = [one.name for one in ones if one not in open_ones]
        if rest:
            folded.append((state, f"{len(rest)}: {', '.join(rest)}"))
    width = max((len(names) for _, names, _ in shown), default=0)
    for state, names, one in shown:
        style = _DIM if state == "skip" else state_style(state)
        print_hanging([(f"{state:4}", style), (f"  {names:{width}}  ", "")], one.fact)
        if one.advice:
            print_hanging(f"{' ' * (width + 6)}  -> ", one.advice)
    for state, text in folded:
        print_hanging(
            [(f"{state:4}", _DIM if state == "skip" else state_style(state)), ("  ", "")], text, _DIM
        )
    if folded:
        print_line("--all shows these, too")


def _by_cause(findings: list[Finding]) -> list[tuple[str, Finding]]:
    """Return findings with the names of all that say the same, each once."""
    names: dict[tuple[str, str], list[Finding]] = {}
    for one in findings:
        names.setdefault((one.fact, one.advice), []).append(one)
    return [(", ".join(one.name for one in same), same[0]) for same in names.values()]
