# SPDX-License-Identifier: Apache-2.0
"""``shmmap tail``: print the daemon's events as they happen."""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final

from shmmap.cli.daemon_address import endpoint
from shmmap.cli.options import Subparsers, add_daemon_options, add_verb, seconds
from shmmap.cli.program import check_terminal, complain
from shmmap.cli.screens.output import (
    counted,
    format_bytes,
    format_duration,
    json_text,
    print_hanging,
    print_line,
    rows_text,
)
from shmmap.statistics.counters import TURN_KINDS

if TYPE_CHECKING:
    from shmmap.client.event_stream import Happening

_EXIT = """\
With --json, one object a line.  Live on a terminal or with --follow; else it ends after the events that
the daemon has kept.
Exit code: 0, or 69 when no daemon answers."""

HEX_FIELDS: Final = ("epoch", "version", "map_version", "replaces", "session")
DEFAULT_SINCE_S: Final = 60.0
SILENT_S: Final = 5.0


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb ``tail``."""
    parser = add_verb(
        subparsers,
        "tail",
        run,
        help="events: loads, evictions, failures, clients",
        description="Print the events of the last minute, then new ones as they happen: cells loaded, "
        "changed, evicted, failed, retried; cells refused for lack of memory; cells that a moving client had "
        "to wait for; reloads; turns of the daemon's loop that took long; clients that connect and leave; "
        "the daemon's start and end; what is wrong with live maps.  Changes of "
        "live maps, up to two a second, are printed with --json only.",
        output="look.outputs.json_events",
        epilog=_EXIT,
    )
    parser.add_argument(
        "--since",
        metavar="SECONDS",
        type=seconds,
        default=DEFAULT_SINCE_S,
        help="start with events of the last SECONDS (default: 60; the daemon keeps its last 4096)",
    )
    group = parser.add_mutually_exclusive_group()
    group.add_argument(
        "--follow",
        action="store_true",
        default=None,
        help="continue with new events; the default on a terminal",
    )
    group.add_argument("--no-follow", action="store_false", dest="follow", help="end after past events")
    add_daemon_options(parser)


def run(args: argparse.Namespace) -> int:
    """Print events until interrupted."""
    from shmmap.client.event_stream import EventStream

    on_terminal = sys.stdout.isatty()  # asked before anything is shown: afterwards it may be gone
    follow = on_terminal if args.follow is None else args.follow
    show = _print_json if args.json else _print_text
    deadlines = {} if args.timeout is None else {"timeout": args.timeout}
    with EventStream(endpoint(args), since=args.since, name="shmmap tail", **deadlines) as stream:
        while (happening := stream.next(0.0)) is not None:
            if not _is_me(happening):
                show(happening)
        sys.stdout.flush()
        said = False
        while follow:
            check_terminal(was_there=on_terminal)
            happening = stream.next(SILENT_S)
            if happening is not None:
                said = False
                if not _is_me(happening):
                    show(happening)
                sys.stdout.flush()
            elif not said and time.monotonic() - stream.last_message_s > SILENT_S:
                # the daemon sends a heartbeat every second: its silence is reported once
                complain("shmmap", "no heartbeat from the daemon", "shmmap health")
                said = True
    return 0


def _is_me(happening: Happening) -> bool:
    """Whether an event only reports that this program connected."""
    return getattr(happening, "pid", 0) == os.getpid()


def _fields(happening: Happening) -> dict[str, Any]:
    import msgspec

    from shmmap.client.event_stream import MissedEvents

    fields = msgspec.structs.asdict(happening)
    if isinstance(happening, MissedEvents):
        return {"event": "missed", **fields}
    kind = happening.__struct_config__.tag
    return {"event": kind, **fields}


def _print_json(happening: Happening) -> None:
    fields = _fields(happening)
    for name in HEX_FIELDS:
        if name in fields:
            fields[name] = f"{fields[name]:016x}"
    if "unix_ns" in fields:
        fields["time"] = fields.pop("unix_ns") / 1e9
    print_line(json_text(fields))


def _print_text(happening: Happening) -> None:
    fields = _fields(happening)
    kind = fields["event"]
    if kind == "live_changed":
        return
    at = time.strftime("%H:%M:%S", time.localtime(fields["unix_ns"] // 10**9)) if "unix_ns" in fields else ""
    millis = f".{fields['unix_ns'] // 10**6 % 1000:03d}" if at else " " * 12
    print_hanging(f"{at}{millis}  {_COLUMN.get(kind, kind):8}  ", _SENTENCES[kind](fields))


def _loaded(f: dict[str, Any]) -> str:
    took = f"in {format_duration(f['load_ns'] * 1e-9)}" if f["load_ns"] else "retired before, back in service"
    why = ", ahead of the clients" if f["ahead"] else ""
    why += ", was evicted to make room before" if f["again"] else ""
    why += ", replaces an older version" if f["replaces"] else ""
    rows = rows_text(f["points"], f["layer"])
    return f"{f['id']} {f['layer']}  {format_bytes(f['bytes'])}, {rows}, {took}{why}"


def _evicted(f: dict[str, Any]) -> str:
    why = {
        "room": "to make room",
        "request": "on request",
        "map": "it left the map",
        "damaged": "it was damaged",
    }.get(f["why"], f["why"])
    return f"{f['id']} {f['layer']}  {format_bytes(f['bytes'])}, {why}"


def _pressure(f: dict[str, Any]) -> str:
    full = {"over_budget": "the budget is full", "no_space": "the file system is full"}
    cause = full.get(f["code"], "a client's quota is used up")
    return (
        f"{counted(f['refused'], 'cell')} refused, such as {f['id']}: {cause}; "
        f"{format_bytes(f['used_bytes'])} of"
        f" {format_bytes(f['budget_bytes'])} used, {format_bytes(f['pinned_bytes'])} in use by clients"
    )


def _prefetch_miss(f: dict[str, Any]) -> str:
    client = f"{f['client'] or 'a client'}, pid {f['pid'] or '?'}"
    return f"{client} had to wait for {counted(f['cells'], 'cell')}, such as {f['id']} {f['layer']}"


def _reload(f: dict[str, Any]) -> str:
    if f["error"]:
        return f"the map could not be read again, the one served before stays: {f['error']}"
    counts = ", ".join(f"{f[how]:,} {how}" for how in ("changed", "added", "removed"))
    return f"the map was read again; cells: {counts}"


def _long_turn(f: dict[str, Any]) -> str:
    what = TURN_KINDS.get(f["kind"], f["kind"])
    return f"every client waited for {format_duration(f['cpu_ns'] * 1e-9)} while {what}"


def _epoch(f: dict[str, Any]) -> str:
    adopted = f", {f['adopted']:,} segments of the previous daemon kept" if f["adopted"] else ""
    return f"the daemon is {f['what']}: {f['cells']:,} cells in the map{adopted}"


def _live_started(f: dict[str, Any]) -> str:
    found = f", {counted(f['chunks'], 'chunk')} found in memory" if f["chunks"] else ""
    return f"{counted(f['maps'], 'live map')} served{found}"


_CHANGES: Final = {
    "changed": "its file changed",
    "moved": "its box changed",
    "added": "added to the map",
    "removed": "removed from the map",
}

_COLUMN: Final = {
    "prefetch_miss": "miss",
    **dict.fromkeys(("live_started", "live_ended", "live_problem", "live_damaged"), "live"),
}
"""Shorter names of event kinds, for the narrow column."""

_SENTENCES: Final[dict[str, Callable[[dict[str, Any]], str]]] = {
    "epoch": _epoch,
    "loaded": _loaded,
    "changed": lambda f: f"{f['id']}  {_CHANGES.get(f['how'], f['how'])}",
    "evicted": _evicted,
    "failed": lambda f: f"{f['id']} {f['layer']}  {f['code']}: {f['message']}",
    "retried": lambda f: f"{f['id']} {f['layer']}  again after {f['code']}",
    "pressure": _pressure,
    "prefetch_miss": _prefetch_miss,
    "reload": _reload,
    "long_turn": _long_turn,
    "joined": lambda f: f"{f['client'] or 'a client'}, pid {f['pid'] or '?'}, uid {f['uid']}",
    "left": lambda f: f"{f['client'] or 'a client'}, pid {f['pid'] or '?'}, held {format_bytes(f['bytes'])}",
    "live_started": _live_started,
    "live_ended": lambda f: f"the live worker ended ({counted(f['restarts'], 'time')} by now), and restarts",
    "live_problem": lambda f: f"{f['map']}: {f['problem'] or 'chunks are loaded and saved again'}",
    "live_damaged": lambda f: f"{f['map']}: {f['what']}",
    "missed": lambda f: f"events {f['first']:,} to {f['last']:,}: the daemon does not keep them any more",
}
