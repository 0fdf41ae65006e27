# SPDX-License-Identifier: Apache-2.0
"""``shmmap metrics``: the statistics in Prometheus' text format."""

from __future__ import annotations

import argparse
import sys

from shmmap.cli.options import Subparsers, add_statistics_options, add_verb
from shmmap.errors import DaemonUnreachable

__all__ = ["add_parser", "run"]

_EPILOG = """\
For node_exporter's textfile collector, from a timer:
  shmmap metrics > /var/lib/node_exporter/shmmap.prom.new
  mv /var/lib/node_exporter/shmmap.prom.new /var/lib/node_exporter/shmmap.prom
Exit code: 0, or 69 when the daemon is dead or was never started (shmmap_up is 0 then)."""


def add_parser(subparsers: Subparsers) -> None:
    """Describe the verb."""
    parser = add_verb(
        subparsers,
        "metrics",
        run,
        help="counters and latencies in Prometheus' format",
        description="Print counters, gauges and latency histograms in Prometheus' text format.  Reads the "
        "daemon's statistics: works while the daemon is paused (SIGSTOP, a debugger) or hangs; not after "
        "`shmmap stop`.",
        epilog=_EPILOG,
    )
    add_statistics_options(parser, json=False)


def run(args: argparse.Namespace) -> int:
    """Print one scrape."""
    from shmmap.cli.daemon_address import locate
    from shmmap.statistics.prometheus import exposition
    from shmmap.statistics.reader import read_statistics

    name, directory = locate(args)
    found = read_statistics(name, directory)
    sys.stdout.write(exposition(found, name))
    return DaemonUnreachable.exit_code if found.state in ("absent", "dead") else 0
