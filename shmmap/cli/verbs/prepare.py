# SPDX-License-Identifier: Apache-2.0
"""``shmmap prepare MAP``: compute layers ahead of time, so that the daemon only reads them."""

from __future__ import annotations

import argparse

from shmmap.cli.map_layers import add_map_options, failure_rows, origin_at, print_failures, worker_count
from shmmap.cli.options import (
    Subparsers,
    add_json_option,
    add_layer_option,
    add_verb,
    size_bytes,
)
from shmmap.cli.screens.output import (
    counted,
    format_bytes,
    format_duration,
    print_json,
    print_line,
    print_pairs,
)

__all__ = ["add_parser", "run"]

_EPILOG = """\
Layers computed before are kept; a stopped run, started again, continues where it was.  After a map was
copied or its files touched, its layers are recognised by the files' contents.
Give `serve` the same --cache-dir.
JSON (fields may be added, none is removed):
  {"map", "cells", "layers": [spec], "kept", "recognised": by contents, "built": layers of cells, "bytes",
   "cache_dir", "cache_bytes": disk space of the whole cache, "seconds",
   "failed": [{"id", "layer", "message"}]}
Exit code: 0, 1 if a layer of some cell could not be computed, 2 wrong usage, 65 bad map, 66 no map,
73 nothing can be kept in the cache directory."""


def add_parser(subparsers: Subparsers) -> None:
    """Describe the verb."""
    parser = add_verb(
        subparsers,
        "prepare",
        run,
        help="compute layers of a map ahead of time",
        description="Compute layers of every cell of a map and keep them in the disk cache, using all cores.",
        epilog=_EPILOG,
    )
    parser.add_argument("map_path", metavar="MAP", help="what serve takes: a divided map, or one cloud")
    add_layer_option(parser, "layers, such as 'ndt(leaf=2.0)' or points")
    add_map_options(parser)
    parser.add_argument("--cache-dir", metavar="DIR", default="", help="where layers are kept")
    parser.add_argument(
        "--cache-size",
        metavar="SIZE",
        type=size_bytes,
        default="8G",
        help="most disk space of kept layers (default: 8G)",
    )
    add_json_option(parser)


def run(args: argparse.Namespace) -> int:
    """Prepare, with progress on stderr."""
    import os
    import time

    from shmmap.cli.screens.work_progress import StageProgress
    from shmmap.errors import BadRequest
    from shmmap.layers.spec import canonical_layers
    from shmmap.origin.sidecar import default_cache_directory
    from shmmap.prepare.run import prepare_map

    if not args.layer:
        raise BadRequest("name at least one layer", hint="such as --layer 'ndt(leaf=2.0)' points")
    if not args.cache_size:
        raise BadRequest("--cache-size 0 keeps no layer", hint="name a size such as 512M or 2G")
    cache_dir = os.path.abspath(args.cache_dir or default_cache_directory())
    began_s = time.monotonic()
    origin = origin_at(args, cache_dir)
    layers = canonical_layers(args.layer)
    catalogue = origin.load(fresh=True)
    done = prepare_map(
        catalogue,
        layers,
        cache_dir=cache_dir,
        cache_bytes=args.cache_size,
        workers=worker_count(args),
        progress=StageProgress(quiet=args.json, unit="cells", scale=1.0),
    )
    seconds = time.monotonic() - began_s
    if args.json:
        print_json(
            {
                "map": origin.path,
                "cells": done.cells,
                "layers": list(layers),
                "kept": done.kept,
                "recognised": done.recognised,
                "built": done.built,
                "bytes": done.bytes,
                "cache_dir": cache_dir,
                "cache_bytes": done.cache_bytes,
                "seconds": seconds,
                "failed": failure_rows(done.failures),
            }
        )
        return 1 if done.failures else 0
    print_failures(done.failures)
    if done.bytes > args.cache_size:
        print_line("note: the layers are larger than --cache-size: some were removed from the cache again")
    print_pairs(
        [
            ("map", f"{origin.path}, {counted(done.cells, 'cell')}"),
            ("layers", " ".join(layers)),
            ("built", f"{done.built:,}"),
            ("kept", f"{done.kept + done.recognised:,}"),
            ("failed", f"{len(done.failures):,}"),
            ("size", format_bytes(done.bytes)),
            ("cache", f"{cache_dir}, {format_bytes(done.cache_bytes)}"),
            ("time", format_duration(seconds)),
        ]
    )
    return 1 if done.failures else 0
