# SPDX-License-Identifier: Apache-2.0
"""``shmmap prepare MAP``: compute layers ahead of time, so that the daemon only needs to read them.

``shmmap prepare URL --shards I/N`` computes layers of a slice of a published map, for ``publish --join``.
"""

from __future__ import annotations

import argparse
import re
import time
from typing import TYPE_CHECKING

from shmmap.cli.options import (
    Subparsers,
    add_json_option,
    add_layer_option,
    add_verb,
    size_bytes,
)
from shmmap.cli.program import hint_if_interrupted
from shmmap.cli.screens.output import (
    counted,
    format_bytes,
    format_duration,
    print_json,
    print_line,
    print_pairs,
)
from shmmap.cli.verbs.maps.map_options import (
    add_map_options,
    add_sole_publisher_option,
    add_store_options,
    add_trust_option,
    cache_directory,
    failure_rows,
    origin_at,
    print_failures,
    progress_on_stderr,
    refuse_map_options,
    store_at,
    verified_at,
    worker_count,
)
from shmmap.errors import BadRequest

if TYPE_CHECKING:
    from shmmap.publishing.slicing import Sliced

_EPILOG = """\
Layers computed before are kept; a stopped run, started again, continues where it was.  After a map was
copied or its files touched, its layers are recognised by the files' contents.
Give `serve` the same --cache-dir.
With --shards MAP is the URL of a published map: the layers of slice I of N are computed and sent there, on
any machine, in any order; 1/1 is all of it.  When all slices are made, `shmmap publish URL --join RUN` adds
the layers to the map.
Exit code: 0, 1 if a layer of some cell could not be computed (the slice is then not made), 2 wrong usage,
65 bad map, 66 no map, 69 a package is missing, 73 nothing can be kept in the cache directory, or the store
does not write on conditions, 75 the store does not answer or refuses, 78 unusable credentials."""


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb ``prepare``."""
    parser = add_verb(
        subparsers,
        "prepare",
        run,
        help="compute layers of a map ahead of time",
        description="Compute layers of every cell of a map and keep them in the disk cache, using all cores."
        "\nWith --shards, compute those of a slice of a published map, and send them there.",
        output="maps.outputs.Prepared maps.outputs.Slice",
        epilog=_EPILOG,
    )
    parser.add_argument(
        "map_path", metavar="MAP", help="what serve takes: a divided map, or one cloud; with --shards a URL"
    )
    add_layer_option(parser, "layers, such as 'ndt(leaf=2.0)' or points")
    parser.add_argument(
        "--shards",
        metavar="I/N",
        type=_slice,
        help="slice I of N, from 1/N to N/N, of the map published at the URL",
    )
    add_map_options(parser)
    parser.add_argument("--cache-dir", metavar="DIR", default="", help="where layers are kept")
    parser.add_argument(
        "--cache-size",
        metavar="SIZE",
        type=size_bytes,
        default="8G",
        help="most disk space of kept layers (default: 8G; with --shards, 0 keeps none)",
    )
    parser.add_argument("--quiet", action="store_true", help="no progress on stderr")
    add_trust_option(parser)
    add_store_options(parser)
    add_sole_publisher_option(parser)
    add_json_option(parser)


def _slice(text: str) -> tuple[int, int]:
    found = re.fullmatch(r"([1-9]\d{0,5})/([1-9]\d{0,5})", text)
    if found is None or int(found[1]) > int(found[2]):
        raise argparse.ArgumentTypeError(f"expected I/N, from 1/N to N/N, not {text!r}")
    return int(found[1]), int(found[2])


def run(args: argparse.Namespace) -> int:
    """Compute the layers, with progress on stderr."""
    from shmmap.origin.remote.store import is_published

    if not args.layer:
        raise BadRequest("name at least one layer", hint="such as --layer 'ndt(leaf=2.0)' points")
    if args.shards is not None:
        refuse_map_options(args, "--shards: the map is published already")
        return _prepare_slice(args)
    if is_published(args.map_path):
        raise BadRequest(
            f"{args.map_path} is a published map: its layers are made by slices",
            hint="--shards I/N; --shards 1/1 is all of it",
        )
    if args.trust is not None:
        raise BadRequest("--trust goes with --shards")
    if args.sole_publisher:
        raise BadRequest("--sole-publisher goes with --shards")
    return _prepare_map(args)


def _prepare_map(args: argparse.Namespace) -> int:
    from shmmap.layers.spec import canonical_layers
    from shmmap.prepare.run import prepare_map

    if not args.cache_size:
        raise BadRequest("--cache-size 0 keeps no layer", hint="name a size such as 512M or 2G")
    cache_dir = cache_directory(args)
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
        progress=progress_on_stderr(args),
    )
    seconds = time.monotonic() - began_s
    if args.json:
        from shmmap.cli.verbs.maps import outputs

        print_json(
            outputs.Prepared(
                origin.path,
                done.cells,
                list(layers),
                done.kept,
                done.recognised,
                done.built,
                done.bytes,
                cache_dir,
                done.cache_bytes,
                seconds,
                failure_rows(done.failures),
            )
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


def _prepare_slice(args: argparse.Namespace) -> int:
    store = store_at(args.map_path, args)
    from shmmap.publishing.messages import SliceSettings
    from shmmap.publishing.slicing import prepare_slice

    number, slices = args.shards
    began_s = time.monotonic()
    verified = verified_at(store, args)
    with hint_if_interrupted("the same command continues"):
        done = prepare_slice(
            store,
            args.layer,
            number=number,
            slices=slices,
            settings=SliceSettings(
                store.url,
                args.insecure_http,
                args.instance_credentials,
                cache_directory(args),
                args.cache_size,
            ),
            current=verified.current if verified is not None else None,
            workers=worker_count(args),
            progress=progress_on_stderr(args),
        )
    return _report_slice(args, store.url, done, time.monotonic() - began_s)


def _report_slice(args: argparse.Namespace, url: str, done: Sliced, seconds: float) -> int:
    """Print the layers made of a slice; return the exit code."""
    number, slices = args.shards
    if args.json:
        from shmmap.cli.verbs.maps import outputs

        print_json(
            outputs.Slice(
                url,
                done.version,
                str(done.run),
                number,
                slices,
                done.shards,
                done.cells,
                list(done.layers),
                done.there,
                done.kept,
                done.made,
                done.bytes,
                done.sent_objects,
                done.sent_bytes,
                seconds,
                failure_rows(done.failures),
            )
        )
        return 1 if done.failures else 0
    print_failures(done.failures)
    if done.failures:
        print_line(f"slice {number} of {slices} is not made")
        return 1
    there = ": it had been made before" if done.there else ""
    print_pairs(
        [
            ("map", f"{url}, version {done.version}"),
            ("slice", f"{number} of {slices}, {counted(done.cells, 'cell')}{there}"),
            ("layers", " ".join(done.layers)),
            ("made", f"{done.made:,}, {format_bytes(done.bytes)}"),
            ("kept", f"{done.kept:,}"),
            ("sent", f"{counted(done.sent_objects, 'object')}, {format_bytes(done.sent_bytes)}"),
            ("time", format_duration(seconds)),
            ("run", str(done.run)),
            ("then", f"shmmap publish {args.map_path} --join {done.run}"),
        ]
    )
    return 0
