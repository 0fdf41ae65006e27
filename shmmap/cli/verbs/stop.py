# SPDX-License-Identifier: Apache-2.0
"""``shmmap stop``: end the daemon."""

from __future__ import annotations

import argparse

from shmmap.cli.options import Subparsers, add_daemon_options, add_verb
from shmmap.cli.screens.output import print_json, print_line

__all__ = ["add_parser", "run"]

_JSON = """\
  {"stopping": pid of the daemon}
Exit code: 0, or 1 when this user may not do it."""


def add_parser(subparsers: Subparsers) -> None:
    """Describe the verb."""
    parser = add_verb(
        subparsers,
        "stop",
        run,
        help="end the daemon and free its memory",
        description="End the daemon, as SIGTERM does: a cell's memory is freed as soon as no "
        "process maps it.  The daemon's user, root and members of its --admin-group may do this; unlike "
        "a signal it works for other users than the daemon's.",
        json=_JSON,
    )
    add_daemon_options(parser)


def run(args: argparse.Namespace) -> int:
    """Ask for the end."""
    from shmmap.cli.daemon_address import connect

    with connect(args) as client:
        pid = client.welcome.pid
        client.shutdown()
    if args.json:
        print_json({"stopping": pid})
    else:
        print_line(f"daemon {pid} is stopping")
    return 0
