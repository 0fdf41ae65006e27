# SPDX-License-Identifier: Apache-2.0
"""``shmmap serve MAP``: run the daemon in the foreground."""

from __future__ import annotations

import argparse
import os

from shmmap.cli.options import Subparsers, add_verb
from shmmap.config_table import Row
from shmmap.daemon.config import DROPPED, RENAMED, ROWS, SECTIONS, load_config, option_of

_EPILOG = """\
Settings come from FILE, then from SHMMAP_* variables (SHMMAP_BUDGET=2G), then from options.
MAP is a directory in Autoware's divided format (PCD files and pointcloud_map_metadata.yaml, beside
or inside the folder of the files), or one cloud of any format that is read.  A PCD file of up to 256 MiB
is one cell as it is.  Any other cloud is first divided into the cache directory, as `shmmap divide` does
it.  A LAS or float64 cloud far from the origin is shifted close to it, and the log and `shmmap status` say
by how much.  To keep its frame: `shmmap divide --translate none`, and serve that map.
MAP may also be where `shmmap publish` has put a map: an s3://, gs://, az://, https:// or file:// URL, or a
directory.  Its cells are fetched as they are needed; a new version is taken by itself (--poll), and on
`shmmap reload`.  With --trust a version that is unsigned, older, expired, altered or signed by others is
refused; the version taken before is still served.
`shmmapd` is `shmmap serve`: the same options.
Clients find the daemon by --instance, or by --endpoint; with that alone, the instance is named as the socket.
Signals: SIGTERM and SIGINT stop it and free all memory; SIGUSR1 stops it and keeps the cells in memory for
its next start (a restart sends it first, then SIGTERM as usual; in a container: --stop-signal USR1);
SIGHUP reads the map again; where the daemon was started at a terminal it stops it, as when that is closed
(not under nohup or a service manager).
Exit code: 0 after a signal, 65 bad map, or one that --trust refuses, 66 no map there, 69 a package is
missing, or shmmap was replaced under a service, 71 a required resource is unavailable, or a published map
that was never taken is out of reach, 75 the instance runs already, 78 bad setting."""


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb ``serve``."""
    parser = add_verb(
        subparsers,
        "serve",
        run,
        help="run the daemon: serve a map",
        description="Load map cells into shared memory and answer clients until stopped.",
        epilog=_EPILOG,
    )
    parser.add_argument("--config", metavar="FILE", default="", help="TOML file of settings")
    group: argparse._ActionsContainer = parser
    for name, row in ROWS.items():
        if name in SECTIONS:
            group = parser.add_argument_group(SECTIONS[name])
        _add_option(group, row)
    group.add_argument(
        "--live",
        metavar="NAME[=DIR]",
        action="append",
        help="keep a live map, which mappers write to, with its files in DIR (default: live/NAME in the "
        "state directory); may be given again",
    )
    for name in (*DROPPED, *RENAMED):  # rejected by `load_config`
        parser.add_argument(option_of(name), dest=name, help=argparse.SUPPRESS)


def _add_option(group: argparse._ActionsContainer, row: Row) -> None:
    """Add the option of a setting; None if not given, so that the configuration file can set it."""
    words = row.option_help().replace("%", "%%")
    if row.name == "map_path":
        group.add_argument(row.name, metavar=row.metavar, nargs="?", help=words)
    elif isinstance(row.default, bool):
        group.add_argument(option_of(row.name), action="store_true", default=None, help=words)
    elif isinstance(row.default, tuple):
        group.add_argument(
            option_of(row.name),
            metavar=row.metavar,
            action="append",
            help=f"{words}; may be given again",
        )
    else:
        group.add_argument(
            option_of(row.name),
            dest=row.name,
            metavar=row.metavar or None,
            choices=None if row.metavar else row.allowed.choices,
            help=words,
        )


def run(args: argparse.Namespace) -> int:
    """Serve until a signal ends the daemon."""
    os.environ["OPENBLAS_NUM_THREADS"] = "1"  # numpy's threads waste time, and forking would fail
    from shmmap.segment.process_limits import limit_behind

    try:
        return _serve(args)
    except (OSError, RuntimeError, MemoryError, ImportError, SystemError) as error:
        if (limit := limit_behind(error)) is None:
            raise
        limit.hint += "; the daemon and a loader need about 30 threads and 1 GiB"
        raise limit from None


def _serve(args: argparse.Namespace) -> int:
    from shmmap.daemon.main import run as serve
    from shmmap.daemon.service_manager import ServiceManager
    from shmmap.errors import ShmmapError

    settings = {name: value for name, value in vars(args).items() if name not in ("run", "config")}
    try:
        return serve(load_config(settings, file=args.config))
    except ShmmapError as error:
        ServiceManager().failed(str(error))
        raise
