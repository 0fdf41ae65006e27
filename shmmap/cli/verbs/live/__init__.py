# SPDX-License-Identifier: Apache-2.0
"""``shmmap live``: inspect, save, check, export and reset live maps."""

from __future__ import annotations

from shmmap.cli.options import Subparsers, add_verb
from shmmap.cli.verbs.live import files, served


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb ``live``."""
    parser = add_verb(
        subparsers,
        "live",
        files.run_fsck,
        help="list, save, check, export or reset live maps",
        description="Look after live maps: what programs map while they drive.",
    )
    actions = parser.add_subparsers(title="actions", metavar="ACTION", required=True)
    for add in (
        served.add_ls,
        served.add_show,
        served.add_save,
        files.add_fsck,
        files.add_export,
        files.add_reset,
    ):
        add(actions)
