# SPDX-License-Identifier: Apache-2.0
"""``shmmap status`` and ``shmmap clients``: the daemon's state on one screen, and its clients."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Final

from shmmap.cli.areas import moved_by
from shmmap.cli.daemon_address import connect, lists, snapshot
from shmmap.cli.options import Subparsers, add_daemon_options, add_statistics_options, add_verb
from shmmap.cli.screens.output import (
    Column,
    counted,
    format_bytes,
    format_duration,
    format_metres,
    print_hanging,
    print_json,
    print_line,
    print_pairs,
    print_table,
    state_style,
    user_name,
)
from shmmap.cli.screens.status_parts import (
    prefetch_words,
    prepare_words,
    published_lines,
    since,
    status_lines,
    taken_bytes,
    uptime_s,
)
from shmmap.doctor.verdicts import Finding, cache_verdict, outage_so_far, problems
from shmmap.errors import DaemonUnreachable

if TYPE_CHECKING:
    from shmmap.protocol.rows import ClientRow
    from shmmap.statistics.identity import DaemonIdentity
    from shmmap.statistics.reader import Snapshot

_STATUS_EXIT = """\
Exit code: 0, or 69 when the daemon is dead or was never started."""


def add_status(subparsers: Subparsers) -> None:
    """Add the verb ``status``."""
    parser = add_verb(
        subparsers,
        "status",
        run_status,
        help="state of the daemon: memory, clients, requests, cache size",
        description="Show the state of the daemon: memory, clients, requests, loads, live maps, whether the "
        "cache is large enough, and what was fetched ahead for moving clients.  Reads its statistics in "
        "shared memory: works while the daemon is paused (SIGSTOP, a debugger) or hangs, but for live maps; "
        "not after `shmmap stop`.",
        output="look.outputs.Status",
        epilog=_STATUS_EXIT,
    )
    add_statistics_options(parser)


def run_status(args: argparse.Namespace) -> int:
    """Print the state of the daemon."""
    found, identity = snapshot(args)
    with lists(args) as asked:
        asked.add_to(found)
    if args.json:
        from shmmap.cli.verbs.look.outputs import Status

        print_json(Status.of(found, identity))
    else:
        print_pairs([*_verdict_lines(problems(found)), *_status_lines(found, identity)])
    return DaemonUnreachable.exit_code if found.state == "dead" else 0


def _verdict_lines(known: Sequence[Finding]) -> list[tuple[str, ...]]:
    """Return one line for each problem, the worst first, with what to do; or that there is none."""
    if not known:
        return [("verdict", "ok: clients get what they ask for", state_style("ok"))]
    lines: list[tuple[str, ...]] = []
    for one in known:
        lines.append((_LABELS[one.state], one.fact, state_style(one.state)))
        if one.advice:
            lines.append(("", f"-> {one.advice}"))
    return lines


_LABELS: Final = {"fail": "PROBLEM", "warn": "warning"}


def _state_text(found: Snapshot, identity: DaemonIdentity) -> str:
    state = "paused" if found.state == "stopped" else found.state
    return f"{state}, pid {identity.pid}, up {format_duration(uptime_s(identity))}"


def _occasional_lines(count: Mapping[str, int]) -> list[tuple[str, str]]:
    """Return the lines that most daemons do not need: problems, old versions, unusual settings."""
    lines = []
    if outside := count.get("cells_outside_box", 0):
        cells = f"{counted(outside, 'cell')} with points outside the cell's box"
        lines.append(("misplaced", f"{cells}: see the daemon's log, or `shmmap inspect` the map"))
    if count["stale_cells"]:
        lines.append(("stale", f"{count['stale_cells']:,} segments whose newer version is not loaded yet"))
    if count["zombies"]:
        retired = f"{count['zombies']:,} segments, {format_bytes(count['bytes_zombie'])}"
        lines.append(("retired", f"{retired}: freed when no client maps them"))
    if count["adopted"]:
        failed = f", {count['adoptions_failed']:,} of them damaged" if count["adoptions_failed"] else ""
        lines.append(("warm start", f"{count['adopted']:,} segments kept from the previous daemon{failed}"))
    if count["pin_source"]:
        source = "the clients' locks" if count["pin_source"] == 1 else "what clients report"
        lines.append(("use", f"this system grants no leases: memory in use is known from {source} only"))
    return lines


def _status_lines(found: Snapshot, identity: DaemonIdentity) -> list[tuple[str, str]]:
    count = found.counters
    used = taken_bytes(count)
    budget = count["budget_bytes"]
    share = f" ({100 * used / budget:.0f} %)" if budget else ""
    asked = count["hits"] + count["misses"]
    lines = [
        ("daemon", _state_text(found, identity)),
        ("instance", f"{identity.instance} (shmmap {identity.library_version})"),
        ("endpoint", identity.endpoint),
        ("map", _map_text(identity, count)),
        ("memory", f"{format_bytes(used)} taken of {format_bytes(budget)}{share} in {identity.shm_dir}"),
        ("resident", f"{count['cells_resident']:,} segments, {format_bytes(count['bytes_resident'])}"),
        ("in use", f"{format_bytes(count['bytes_pinned'])} mapped by clients"),
    ]
    if (origin := moved_by(identity.id_prefix)) is not None:
        x, y, z = map(format_metres, origin)
        lines.insert(
            4, ("frame", f"add ({x}, {y}, {z}) m for the coordinates of the cloud it was divided from")
        )
    if count.get("origin_out", 0):
        kept = "in memory and on the disk" if published_lines(count) else "in memory"
        out = f"out of reach for {outage_so_far(count)}{since(count)}"
        lines.append(("origin", f"{out}: what is {kept} is served"))
    lines += published_lines(count)
    lines += _occasional_lines(count)
    lines += [
        (
            "clients",
            f"{count['sessions']:,} now, {count['sessions_opened']:,} so far, verbs of `shmmap` included",
        ),
        ("requests", f"{count['requests']:,}, {format_bytes(count['bytes_sent'])} sent"),
        ("cells asked", f"{asked:,}" + (f", {100 * count['hits'] / asked:.0f} % in memory" if asked else "")),
        (
            "loads",
            (
                f"{count['loads_finished']:,} done, {count['load_queue']:,} queued,"
                f" {count['loads_failed']:,} failed, {count['loads_timed_out']:,} timed out,"
                f" {counted(count['worker_crashes'], 'crashed loader')}"
            ),
        ),
    ]
    if count["loads_failed"]:
        lines.append(("", "`shmmap doctor` names the cells that fail"))
    if identity.live and not found.live:
        lines.append(("live", f"{', '.join(identity.live.split())}: the daemon does not answer"))
    lines += status_lines(found.live, count.get("live_restarts", 0))
    lines.append(("cache", cache_verdict(count).text))
    if words := prefetch_words(count):
        lines.append(("prefetch", ", ".join(text for text, _trouble in words)))
    if prepared := prepare_words(count, identity.prepare):
        lines.append(("prepare", prepared))
    if count["refused_quota"]:
        over = (
            f"{count['refused_quota']:,} cells refused since the start: a client asked for more than its part"
        )
        lines.append(("quota", f"{over} (--session-quota)"))
    return lines


def _map_text(identity: DaemonIdentity, count: Mapping[str, int]) -> str:
    if not identity.map_path:
        return "none: this daemon serves live maps alone"
    return f"{identity.map_path}, {counted(count['map_cells'], 'cell')}, version {identity.map_version:016x}"


_CLIENTS_EXIT = """\
Exit code: 0, or 69 when no daemon answers."""

_CLIENT_COLUMNS = (
    Column("CLIENT"),
    Column("PID", "right", spare=2),
    Column("USER", spare=5),
    Column("CELLS", "right", spare=3),
    Column("GIVEN", "right"),
    Column("MAPPED", "right", spare=1),
    Column("OUTDATED", "right", spare=4),
    Column("REQUESTS", "right", spare=7),
    Column("IDLE", "right", spare=8),
    Column("AT", spare=6),
    Column("COMMAND", spare=9),
)


_CLIENTS_LEGEND = """\
CELLS, GIVEN: cells it was given and has not returned, and their memory
MAPPED: mapped now, according to the kernel
OUTDATED: the part of MAPPED that is stale (a newer version exists) or retired (out of service; freed when \
the last client releases it)"""


def add_clients(subparsers: Subparsers) -> None:
    """Add the verb ``clients``."""
    parser = add_verb(
        subparsers,
        "clients",
        run_clients,
        help="connected clients, and the memory each uses",
        description="List connected clients, and memory mapped by unidentified processes.\n"
        + _CLIENTS_LEGEND
        + "\n"
        "IDLE: time since its last request.  AT: where it said it is, metres, map frame.",
        output="look.outputs.Clients",
        epilog=_CLIENTS_EXIT,
    )
    add_daemon_options(parser)


def run_clients(args: argparse.Namespace) -> int:
    """Print the table of clients."""
    with connect(args) as client:
        stats = client.stats()
    if args.json:
        from shmmap.cli.json_output import Client
        from shmmap.cli.verbs.look import outputs

        rows = [Client.of(row, time.monotonic_ns(), mapped=True) for row in stats.sessions]
        print_json(outputs.Clients(rows, stats.unknown_holders, stats.unknown_bytes))
        return 0
    print_table(_CLIENT_COLUMNS, [_client_row(row) for row in stats.sessions])
    if stats.unknown_holders:
        unknown = f"{stats.unknown_holders:,} segments, {format_bytes(stats.unknown_bytes)}"
        print_line(f"{unknown}: mapped by unidentified processes (not through the client library)")
    if sys.stdout.isatty():
        for line in _CLIENTS_LEGEND.splitlines():
            names, meaning = line.split(": ", 1)
            print_hanging(f"{names}: ", meaning)
    return 0


def _client_row(row: ClientRow) -> list[str]:
    return [
        row.client or "-",
        str(row.pid or "?"),
        user_name(row.uid),
        f"{row.cells:,}",
        format_bytes(row.bytes),
        format_bytes(row.mapped_bytes),
        format_bytes(row.superseded_bytes) if row.superseded else "-",
        f"{row.requests:,}",
        format_duration(row.idle_s(time.monotonic_ns())),
        "-" if row.pose is None else f"{row.pose[0]:.1f},{row.pose[1]:.1f}",
        row.command,
    ]
