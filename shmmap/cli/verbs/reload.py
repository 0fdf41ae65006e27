# SPDX-License-Identifier: Apache-2.0
"""``shmmap reload``: let the daemon read the map again."""

from __future__ import annotations

import argparse

from shmmap.cli.options import Subparsers, add_daemon_options, add_verb
from shmmap.cli.screens.output import counted, print_json, print_line

__all__ = ["add_parser", "run"]

_JSON = """\
  {"map_version": hex, "changed": cells whose file changed, "added", "removed",
   "problems": [text]}
Exit code: 0; 1 when this user may not do it, 65 bad map: the map before stays, 66 no map there, 69 when no
daemon answers."""


def add_parser(subparsers: Subparsers) -> None:
    """Describe the verb."""
    parser = add_verb(
        subparsers,
        "reload",
        run,
        help="read the map again: changed, new and deleted files",
        description="Let the daemon read the map's list of cells again, as SIGHUP does.  Clients get what "
        "changed with their next request; cells they have mapped stay readable.",
        json=_JSON,
    )
    add_daemon_options(parser)


def run(args: argparse.Namespace) -> int:
    """Print what changed."""
    from shmmap.cli.daemon_address import connect

    with connect(args) as client:
        answer = client.reload()
    if args.json:
        print_json(
            {
                "map_version": f"{answer.map_version:016x}",
                "changed": answer.changed,
                "added": answer.added,
                "removed": answer.removed,
                "problems": list(answer.problems),
            }
        )
        return 0
    print_line(
        f"{counted(answer.changed, 'cell')} changed, {answer.added:,} added, {answer.removed:,} removed;"
        f" map version {answer.map_version:016x}"
    )
    for problem in answer.problems:
        print_line(f"note: {problem}")
    return 0
