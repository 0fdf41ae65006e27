# SPDX-License-Identifier: Apache-2.0
"""``shmmap version``: which versions of program, wire protocol and segment layout these are."""

from __future__ import annotations

import argparse

from shmmap.cli.options import Subparsers, add_json_option, add_verb
from shmmap.cli.screens.output import print_json, print_pairs

__all__ = ["add_parser", "installed_version", "run"]


_JSON = """\
  {"shmmap": "x.y.z", "protocol": "major.minor", "layout": "major.minor", "python": "x.y.z"}
Exit code: 0."""


def installed_version() -> str:
    """Return the version of this package."""
    from shmmap.version import __version__

    return __version__


def add_parser(subparsers: Subparsers) -> None:
    """Describe the verb."""
    parser = add_verb(
        subparsers,
        "version",
        run,
        help="versions of program, protocol and segment layout",
        description="Print the versions of the program, its wire protocol and its segment layout.",
        json=_JSON,
    )
    add_json_option(parser)


def run(args: argparse.Namespace) -> int:
    """Print the versions."""
    import platform

    from shmmap.protocol.messages import PROTOCOL_VERSION
    from shmmap.segment.layout import LAYOUT_VERSION

    versions = {
        "shmmap": installed_version(),
        "protocol": ".".join(map(str, PROTOCOL_VERSION)),
        "layout": ".".join(map(str, LAYOUT_VERSION)),
        "python": platform.python_version(),
    }
    if args.json:
        print_json(versions)
    else:
        print_pairs(list(versions.items()))
    return 0
