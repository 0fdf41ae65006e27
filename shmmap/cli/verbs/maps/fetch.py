# SPDX-License-Identifier: Apache-2.0
"""``shmmap fetch URL DIR``: a published map back into files."""

from __future__ import annotations

import argparse

from shmmap.cli.options import Subparsers, add_json_option, add_verb, at_least
from shmmap.cli.screens.output import counted, format_bytes, format_duration, print_json, print_pairs
from shmmap.cli.verbs.maps.map_options import (
    URL_HELP,
    add_store_options,
    add_trust_option,
    store_at,
    verified_at,
)

__all__ = ["add_parser", "run"]

_EPILOG = """\
Every object is compared with its hash.  DIR appears complete or not at all; a stopped run, started again,
fetches only what is missing.  What a daemon of the same user keeps on this disk is not fetched.
Exit code: 0, 2 wrong usage or DIR exists, 65 an object is damaged, or --trust refuses, 66 no such map or
version, or an object is gone, 69 a package is missing, 73 DIR cannot be written, 75 the store does not
answer or refuses, or another run is making DIR, 78 unusable credentials."""


def add_parser(subparsers: Subparsers) -> None:
    """Describe the verb."""
    parser = add_verb(
        subparsers,
        "fetch",
        run,
        help="write a published map as a divided map",
        description="Write a published map as a divided map, which `serve` and Autoware read.",
        output="maps.outputs.Fetched",
        epilog=_EPILOG,
    )
    parser.add_argument("url", metavar="URL", help=URL_HELP)
    parser.add_argument("out", metavar="DIR", help="the map directory to make")
    parser.add_argument("--at", metavar="N", type=at_least(1), help="version N instead of the current one")
    parser.add_argument("--force", action="store_true", help="replace a divided map that exists")
    parser.add_argument("--cache-dir", metavar="DIR", default="", help="where a daemon keeps what it fetched")
    parser.add_argument("--quiet", action="store_true", help="no progress on stderr")
    add_trust_option(parser)
    add_store_options(parser)
    add_json_option(parser)


def run(args: argparse.Namespace) -> int:
    """Fetch, with progress on stderr."""
    import os
    import time

    from shmmap.cli.screens.work_progress import StageProgress
    from shmmap.errors import BadRequest
    from shmmap.origin.catalogue_bytes import default_cache_directory

    if args.trust is not None and args.at is not None:
        raise BadRequest("--at does not go with --trust: only the current version is signed")
    store = store_at(args.url, args)
    from shmmap.origin.remote.object_tier import ObjectTier
    from shmmap.publishing.fetch import fetch_map

    began_s = time.monotonic()
    verified = verified_at(store, args)
    progress = StageProgress(quiet=args.quiet or args.json, unit="cells", scale=1.0)
    cache_dir = os.path.abspath(args.cache_dir or default_cache_directory())
    made = fetch_map(
        store,
        args.out,
        version=args.at,
        current=verified.current if verified is not None else None,
        force=args.force,
        tier=ObjectTier(cache_dir, limit_bytes=0),
        progress=progress,
    )
    seconds = time.monotonic() - began_s
    if args.json:
        from shmmap.cli.verbs.maps import outputs

        print_json(
            outputs.Fetched(
                store.url,
                made.path,
                made.version,
                f"{made.map_version:016x}",
                made.cells,
                made.points,
                made.fetched_cells,
                made.fetched_bytes,
                seconds,
            )
        )
        return 0
    print_pairs(
        [
            ("map", f"{made.path}, {counted(made.cells, 'cell')}, {made.points:,} points"),
            ("version", f"{made.version} of {store.url}"),
            ("fetched", f"{counted(made.fetched_cells, 'cell')}, {format_bytes(made.fetched_bytes)}"),
            ("time", format_duration(seconds)),
        ]
    )
    return 0
