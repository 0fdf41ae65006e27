# SPDX-License-Identifier: Apache-2.0
"""``shmmap status``: one screen about the daemon, read from its statistics segment."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from shmmap.cli.options import Subparsers, add_statistics_options, add_verb
from shmmap.cli.screens.cache_verdict import cache_verdict
from shmmap.cli.screens.output import format_bytes, format_duration, print_json, print_pairs
from shmmap.errors import DaemonUnreachable

if TYPE_CHECKING:
    from shmmap.statistics.identity import DaemonIdentity
    from shmmap.statistics.reader import Snapshot

__all__ = ["add_parser", "run"]

_JSON = """\
  {"state": "healthy" | "stopped" | "hung" | "dead", "beat_age_s": seconds since its last sign of life,
   "pid", "uptime_s", "instance", "endpoint", "epoch": hex, "version", "map_path", "map_version": hex,
   "frame_id", "shm_dir", "counters": {name: integer; bytes where the name says so}}
Exit code: 0, or 69 when the daemon is dead or was never started."""


def add_parser(subparsers: Subparsers) -> None:
    """Describe the verb."""
    parser = add_verb(
        subparsers,
        "status",
        run,
        help="one screen about the daemon",
        description="Show how the daemon is and what it holds.  Asks nobody: works while it is stopped.",
        json=_JSON,
    )
    add_statistics_options(parser)


def run(args: argparse.Namespace) -> int:
    """Print the state of the daemon."""
    import time

    from shmmap.cli.daemon_address import snapshot

    found, identity = snapshot(args)
    uptime_s = max(time.time() - identity.started_unix_ns * 1e-9, 0.0)
    if args.json:
        print_json(
            {
                "state": found.state,
                "beat_age_s": round(found.beat_age_s, 6),
                "pid": identity.pid,
                "uptime_s": round(uptime_s, 3),
                "instance": identity.instance,
                "endpoint": identity.endpoint,
                "epoch": f"{identity.epoch:016x}",
                "version": identity.library_version,
                "map_path": identity.map_path,
                "map_version": f"{identity.map_version:016x}",
                "frame_id": identity.frame_id,
                "shm_dir": identity.shm_dir,
                "counters": found.counters,
            }
        )
    else:
        print_pairs(_lines(found, identity, uptime_s))
    return DaemonUnreachable.exit_code if found.state == "dead" else 0


def _lines(found: Snapshot, identity: DaemonIdentity, uptime_s: float) -> list[tuple[str, str]]:
    count = found.counters
    used = count["bytes_resident"] + count["bytes_zombie"] + count["bytes_reserved"]
    budget = count["budget_bytes"]
    share = f" ({100 * used / budget:.0f} %)" if budget else ""
    state = {
        "healthy": f"healthy, pid {identity.pid}, up {format_duration(uptime_s)}",
        "stopped": f"STOPPED, pid {identity.pid}: continue it with `kill -CONT {identity.pid}`",
        "hung": f"HUNG, pid {identity.pid}: no sign of life for {format_duration(found.beat_age_s)}",
        "dead": f"DEAD: pid {identity.pid} ended without cleaning up; `shmmap serve` takes over",
    }[found.state]
    asked = count["hits"] + count["misses"]
    hit_rate = f", {100 * count['hits'] / asked:.0f} % from memory" if asked else ""
    lines = [
        ("daemon", state),
        ("instance", f"{identity.instance} (shmmap {identity.library_version})"),
        ("endpoint", identity.endpoint),
        ("map", f"{identity.map_path}, {count['map_cells']:,} cells, version {identity.map_version:016x}"),
        ("memory", f"{format_bytes(used)} of {format_bytes(budget)}{share} in {identity.shm_dir}"),
        ("resident", f"{count['cells_resident']:,} segments, {format_bytes(count['bytes_resident'])}"),
        ("pinned", f"{format_bytes(count['bytes_pinned'])} mapped by clients"),
    ]
    if count["stale_cells"]:
        lines.append(("stale", f"{count['stale_cells']:,} segments wait for their successor"))
    if count["zombies"]:
        lines.append(("zombies", f"{count['zombies']:,} segments, {format_bytes(count['bytes_zombie'])}"))
    if count["adopted"]:
        failed = f", {count['adoptions_failed']:,} of them damaged" if count["adoptions_failed"] else ""
        lines.append(("warm start", f"{count['adopted']:,} segments of an earlier daemon taken over{failed}"))
    if count["pin_source"]:
        source = "the locks of clients" if count["pin_source"] == 1 else "what clients say"
        lines.append(("pins", f"this system grants no leases: known from {source} only"))
    lines += [
        ("clients", f"{count['sessions']:,} now, {count['sessions_opened']:,} so far"),
        ("requests", f"{count['requests']:,}, {format_bytes(count['bytes_sent'])} sent{hit_rate}"),
        (
            "loads",
            (
                f"{count['loads_finished']:,} done, {count['load_queue']:,} queued,"
                f" {count['loads_failed']:,} failed, {count['loads_timed_out']:,} timed out,"
                f" {count['worker_crashes']:,} crashed workers"
            ),
        ),
    ]
    evicted, over_budget, quota = (
        f"{count[name]:,}" for name in ("evictions", "refused_over_budget", "refused_quota")
    )
    verdict = cache_verdict(count)
    lines.append(("cache", f"{'TOO SMALL' if verdict.too_small else 'large enough'}: {verdict.why}"))
    if verdict.hint:
        lines.append(("", verdict.hint))
    if {evicted, over_budget, quota} != {"0"}:
        text = f"{evicted} evicted, {over_budget} refused for the budget, {quota} for a quota"
        lines.append(("pressure", text))
    return lines
