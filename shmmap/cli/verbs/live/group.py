# SPDX-License-Identifier: Apache-2.0
"""``shmmap live``: what is done with live maps."""

from __future__ import annotations

from shmmap.cli.options import Subparsers, add_verb
from shmmap.cli.verbs.live import export, fsck, ls, reset, save, show

__all__ = ["add_parser"]


def add_parser(subparsers: Subparsers) -> None:
    """Describe the verb."""
    parser = add_verb(
        subparsers,
        "live",
        fsck.run,
        help="look at live maps, save, check, export or reset one",
        description="Look after live maps: what programs map while they drive.",
    )
    actions = parser.add_subparsers(title="actions", metavar="ACTION", required=True)
    for action in (ls, show, save, fsck, export, reset):
        action.add_parser(actions)
