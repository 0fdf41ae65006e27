# SPDX-License-Identifier: Apache-2.0
"""``shmmap-rolling config``: Rolling-Bonxai's parameter file as a section of the daemon's settings."""

from __future__ import annotations

import argparse
from typing import Any, Final

from shmmap_clients.command_line import add_verb, complain, output_file, write_text

__all__ = ["add_parser", "run"]

_EPILOG: Final = """\
The section makes a map like the one that the file is for: voxels, what a hit
and a miss are worth, a window of the 26 neighbours that follows at once.
Ranges, the z band and what is shown belong to whoever maps: give the same file
to `shmmap-rolling run --params`."""


def add_parser(subparsers: Any) -> None:
    """Add the verb."""
    parser = add_verb(
        subparsers,
        "config",
        run,
        help="the daemon's settings from Rolling-Bonxai's parameter file",
        description="Print the section of the daemon's settings (TOML) for a live map as a parameter file of"
        " Rolling-Bonxai, version 1, has it.  No daemon is needed.",
        epilog=_EPILOG,
    )
    parser.add_argument("params", metavar="FILE", help="Rolling-Bonxai's parameter file (YAML)")
    parser.add_argument("--name", required=True, metavar="NAME", help="name of the live map")
    parser.add_argument(
        "--path", metavar="DIR", help="directory of the map's files (default: the file's c_chunk_folder_path)"
    )
    parser.add_argument(
        "--out", type=output_file, metavar="FILE", help="write the section into this file, not to stdout"
    )


def run(args: argparse.Namespace) -> int:
    """Read, and print or write."""
    import msgspec

    from shmmap_clients.rolling_map.parameters import live_section, read_parameters

    parameters = read_parameters(args.params)
    settings = parameters.live
    if args.path is not None:
        settings = msgspec.structs.replace(settings, path=args.path)
    section = live_section(args.name, settings)
    if parameters.warning:
        complain("shmmap-rolling", f"warning: {args.params}: {parameters.warning}")
    if args.out:
        write_text(args.out, section)
    else:
        print(section, end="")
    return 0
