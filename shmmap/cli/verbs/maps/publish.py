# SPDX-License-Identifier: Apache-2.0
"""``shmmap publish MAP URL``: upload a map to a bucket or a directory, from which vehicles fetch it.

``shmmap publish URL --join RUN`` joins the slices of a run into a version.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from shmmap.cli.options import (
    Subparsers,
    add_json_option,
    add_layer_option,
    add_verb,
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
    add_sign_option,
    add_sole_publisher_option,
    add_store_options,
    cache_directory,
    failure_rows,
    origin_at,
    print_failures,
    progress_on_stderr,
    refuse_map_options,
    signer_at,
    store_at,
    worker_count,
)
from shmmap.errors import BadRequest

if TYPE_CHECKING:
    from shmmap.publishing.publish import Published

_EPILOG = """\
URL is s3://BUCKET/PATH, gs://BUCKET/PATH, az://CONTAINER/PATH, file:///DIR or a directory, which any web
server can serve.  Credentials come from the environment, from $CREDENTIALS_DIRECTORY, or from a profile.
The store is asked first whether it writes on conditions, by five small requests: of two publishers at once,
one must be refused.  --sole-publisher does without.
Only what the current version does not have is sent.  The new version becomes current at once, at the end; a
stopped run, started again, sends only what is missing.
--sign: keys are made in KEYDIR at first; give ROOT.json to vehicles, take root.pem offline, and have the
map signed again within 7 days: `shmmap versions URL --refresh --sign KEYDIR`.
`shmmap publish URL --join RUN` adds the layers that `shmmap prepare URL --shards I/N` has made to the current
version; all slices have to be there.
Exit code: 0, 1 if a layer of some cell cannot be made (nothing is published then), 2 wrong usage, 65 bad map
or damaged version, 66 no map or bucket, or slices are missing, 69 a package is missing, 73 cannot write, or
the store cannot switch versions safely, 75 the store does not answer or refuses, or another publisher was
quicker, 78 unusable credentials or keys."""


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb ``publish``."""
    parser = add_verb(
        subparsers,
        "publish",
        run,
        help="publish a map in a bucket or a directory",
        description="Publish a map in a bucket or a directory, from where vehicles fetch what they need.\n"
        "With --join and without MAP, add layers that slices have made.",
        output="maps.outputs.PublishedMap maps.outputs.Joined",
        epilog=_EPILOG,
    )
    parser.add_argument("map_path", metavar="MAP", help="what serve takes: a divided map, or one cloud")
    url = parser.add_argument("url", metavar="URL", help="where to publish it")
    parser.add_argument(
        "--join",
        metavar="RUN",
        action=_Join,
        url=url,
        help="add the layers that the slices of this run have made to the map published at URL; without MAP",
    )
    add_layer_option(parser, "layers to publish besides points, such as 'ndt(leaf=2.0)'")
    parser.add_argument(
        "--id-prefix",
        metavar="PREFIX",
        default="",
        help="what cell ids begin with, in all versions (default: /<last part of URL>/)",
    )
    parser.add_argument(
        "--encoding",
        choices=("exact", "mm"),
        default="",
        help="mm: points are rounded to millimetres, and take half the bytes (default: as in the version"
        " before, at first exact)",
    )
    add_map_options(parser)
    parser.add_argument(
        "--resend",
        action="store_true",
        help="send every object again, also those that should be there: repairs a damaged store",
    )
    parser.add_argument(
        "--cache-dir", metavar="DIR", default="", help="where layers made by `shmmap prepare` are kept"
    )
    parser.add_argument("--quiet", action="store_true", help="no progress on stderr")
    add_sign_option(parser)
    add_store_options(parser)
    add_sole_publisher_option(parser)
    add_json_option(parser)


class _Join(argparse.Action):
    """Stores the name of a run; the only argument is then the URL, although argparse calls it MAP."""

    def __init__(self, *, url: argparse.Action, **settings: Any) -> None:
        super().__init__(**settings)
        self._url = url

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: str | Sequence[Any] | None,
        option_string: str | None = None,
    ) -> None:
        del parser, option_string
        self._url.required = False
        setattr(namespace, self.dest, values)


def run(args: argparse.Namespace) -> int:
    """Publish a map or join slices, with progress on stderr."""
    return _publish(args) if args.join is None else _join(args)


def _join(args: argparse.Namespace) -> int:
    if args.url is not None:
        raise BadRequest("--join takes no MAP", hint="shmmap publish URL --join RUN")
    refuse_map_options(args, "--join: its slices say all that", ("layer", "id_prefix", "encoding", "resend"))
    store = store_at(args.map_path, args)
    from shmmap.publishing.joining import join_slices

    began_s = time.monotonic()
    done = join_slices(
        store,
        args.join,
        signer=signer_at(store, args, make_keys=True),
        progress=progress_on_stderr(args),
    )
    seconds = time.monotonic() - began_s
    if args.json:
        from shmmap.cli.verbs.maps import outputs

        print_json(
            outputs.Joined(
                store.url,
                str(done.run),
                done.run.slices,
                done.version is not None,
                done.current,
                f"{done.map_version:016x}",
                done.root,
                done.cells,
                list(done.layers),
                done.objects,
                seconds,
            )
        )
        return 0
    changed = "" if done.version is not None else ": nothing has changed, it has these layers"
    print_pairs(
        [
            ("url", f"{store.url}, {counted(done.cells, 'cell')}"),
            ("version", f"{done.current}{changed}"),
            ("layers", " ".join(done.layers)),
            ("joined", counted(done.run.slices, "slice")),
            ("found", counted(done.objects, "object")),
            ("time", format_duration(seconds)),
        ]
    )
    return 0


def _publish(args: argparse.Namespace) -> int:
    from shmmap.layers.spec import canonical_layers

    store = store_at(args.url, args)
    from shmmap.publishing.messages import PublishSettings
    from shmmap.publishing.publish import publish_map

    layers = canonical_layers(args.layer) if args.layer else ()
    cache_dir = cache_directory(args)
    began_s = time.monotonic()
    origin = origin_at(args, cache_dir)
    catalogue = origin.load(fresh=True)
    signer = signer_at(store, args, make_keys=True)
    with hint_if_interrupted("the same command continues"):
        done = publish_map(
            catalogue,
            store,
            layers,
            settings=PublishSettings(
                store.url,
                args.insecure_http,
                args.instance_credentials,
                cache_dir if os.path.isdir(os.path.join(cache_dir, "layers")) else "",
                encoding=args.encoding,
            ),
            id_prefix=args.id_prefix,
            workers=worker_count(args),
            resend=args.resend,
            signer=signer,
            progress=progress_on_stderr(args),
        )
    notes = [*catalogue.problems, *done.notes]
    return _report(args, origin.path, store.url, done, notes, time.monotonic() - began_s)


def _report(
    args: argparse.Namespace, path: str, url: str, done: Published, problems: Sequence[str], seconds: float
) -> int:
    """Print the result of publishing; return the exit code."""
    if args.json:
        from shmmap.cli.verbs.maps import outputs

        print_json(
            outputs.PublishedMap(
                path,
                url,
                done.version is not None,
                done.current,
                f"{done.map_version:016x}",
                done.root,
                done.cells,
                list(done.layers),
                done.id_prefix,
                done.encoding,
                done.objects,
                done.bytes,
                done.sent_objects,
                done.sent_bytes,
                seconds,
                failure_rows(done.failures),
                list(problems),
            )
        )
        return 1 if done.failures else 0
    for problem in problems:
        print_line(f"note: {problem}")
    print_failures(done.failures)
    if done.failures:
        print_line("nothing is published: the current version stays as it was")
        return 1
    changed = "" if done.version is not None else ": nothing has changed"
    print_pairs(
        [
            ("map", f"{path}, {counted(done.cells, 'cell')}"),
            ("url", url),
            ("version", f"{done.current}{changed}"),
            ("layers", " ".join(done.layers)),
            ("ids", f"{done.id_prefix}..."),
            ("size", format_bytes(done.bytes)),
            ("sent", f"{counted(done.sent_objects, 'object')}, {format_bytes(done.sent_bytes)}"),
            ("time", format_duration(seconds)),
        ]
    )
    return 0
