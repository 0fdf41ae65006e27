# SPDX-License-Identifier: Apache-2.0
"""``shmmap serve MAP``: run the daemon in the foreground."""

from __future__ import annotations

import argparse
import os

from shmmap.cli.options import Subparsers, add_unit_options, add_verb
from shmmap.cli.store_options import add_access_options, add_trust_option

__all__ = ["add_parser", "run"]

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
missing, 71 something is full, missing or in the way, or a published map that was never taken is out of
reach, 75 the instance runs already, 78 bad setting."""


def add_parser(subparsers: Subparsers) -> None:
    """Describe the verb."""
    parser = add_verb(
        subparsers,
        "serve",
        run,
        help="run the daemon: serve a map",
        description="Load map cells into shared memory and answer clients until told to stop.",
        epilog=_EPILOG,
    )
    parser.add_argument(
        "map_path", metavar="MAP", nargs="?", help="the map: a directory, a cloud, or a published map's URL"
    )
    parser.add_argument(
        "--metadata", metavar="FILE", help="the map's YAML, if it lies neither beside nor in the map"
    )
    parser.add_argument(
        "--strict", action="store_true", default=None, help="refuse what Autoware's own loader refuses"
    )
    add_unit_options(parser)
    parser.add_argument(
        "--watch",
        action="store_true",
        default=None,
        help="read the map again when its files change (not on NFS)",
    )
    parser.add_argument(
        "--live",
        metavar="NAME[=DIR]",
        action="append",
        help="keep a live map, which mappers write to, with its files in DIR (default: live/NAME in the "
        "state directory); may be given again",
    )
    parser.add_argument("--config", metavar="FILE", default="", help="TOML file of settings")
    place = parser.add_argument_group("how clients find it")
    place.add_argument(
        "--instance", metavar="NAME", help="name of this daemon among several (default: default)"
    )
    place.add_argument(
        "--endpoint",
        metavar="PATH",
        help="request socket, a path or an ipc:// URL (default: INSTANCE.sock in the runtime directory)",
    )
    place.add_argument(
        "--runtime-dir",
        metavar="DIR",
        help="directory of the request socket (default: /run/shmmap; for a user's daemon "
        "$XDG_RUNTIME_DIR/shmmap, else /tmp/shmmap-UID)",
    )
    place.add_argument("--shm-dir", metavar="DIR", help="directory of the segments (default: /dev/shm)")
    place.add_argument(
        "--live-shm-dir", metavar="DIR",
        help="directory of live maps' chunks, without huge pages (default: as --shm-dir, else /dev/shm)",
    )  # fmt: skip
    place.add_argument("--live-group", metavar="GROUP", help="group whose members may change live maps")
    place.add_argument(
        "--group",
        metavar="GROUP",
        help="group whose members may connect and read the map (default: none, only the daemon's user)",
    )
    place.add_argument(
        "--admin-group", metavar="GROUP", help="group whose members may reload, evict, pin and stop it"
    )
    published = parser.add_argument_group("a published map")
    published.add_argument(
        "--poll",
        metavar="SECONDS",
        dest="poll_s",
        help="how often to look for a new version; 0: only on `shmmap reload` (default: 60)",
    )
    published.add_argument(
        "--catalogue-budget",
        metavar="BYTES",
        help="most memory for the list of cells (default: 256M, a million cells)",
    )
    add_trust_option(published)
    published.add_argument(
        "--accept-version",
        metavar="N",
        help="accept version N although a later one was served before",
    )
    add_access_options(published, default=None)  # the configuration file may say
    limits = parser.add_argument_group("limits")
    limits.add_argument(
        "--budget",
        metavar="BYTES",
        help="most memory for cells, such as 512M or 2G (default: a quarter of the memory available at "
        "start, at most 4G)",
    )
    limits.add_argument(
        "--live-budget",
        metavar="BYTES",
        help="most memory for live maps (default: an eighth of what is free, at most 1G)",
    )
    limits.add_argument(
        "--session-quota",
        metavar="PART",
        help="what one client may keep for itself alone: a part of the budget, up to 1, or a size such as 1G "
        "(default: 0.9)",
    )
    limits.add_argument(
        "--workers", metavar="N", help="most loader processes (default: one less than processors, at most 4)"
    )
    limits.add_argument(
        "--load-timeout",
        metavar="SECONDS",
        dest="load_timeout_s",
        help="most time for loading one cell (default: 60)",
    )
    limits.add_argument(
        "--eviction",
        metavar="POLICY",
        help="which cells go first when memory is needed: time (those that clients will need last; the "
        "default), distance (farthest from all clients) or lru (longest unused)",
    )
    limits.add_argument(
        "--ride-out",
        metavar="SECONDS",
        dest="ride_out_s",
        help="for so long the map's files may be out of reach without a moving client's noticing: cells are "
        "fetched so far ahead, of a published map onto the disk where memory has no room (default: 10)",
    )
    limits.add_argument(
        "--prefetch-share",
        metavar="PART",
        help="part of the budget that cells fetched ahead may take until somebody asks for them; 0: none "
        "are (default: 0.5)",
    )
    parser.add_argument(
        "--log-level",
        metavar="LEVEL",
        help="the least that is logged: debug (each eviction, each client that left), info or warning "
        "(default: info)",
    )
    parser.add_argument(
        "--cache-dir",
        metavar="DIR",
        help="where the map's index, divided clouds and computed layers are kept between starts (default: "
        "the service's or the user's cache directory)",
    )
    parser.add_argument(
        "--cache-size",
        metavar="SIZE",
        dest="cache_bytes",
        help="most disk space for computed layers, 0: keep none (default: 8G)",
    )


def run(args: argparse.Namespace) -> int:
    """Serve until a signal says stop."""
    os.environ["OPENBLAS_NUM_THREADS"] = "1"  # numpy's threads would spin, and nobody could be forked
    from shmmap.segment.process_limits import limit_behind

    try:
        return _serve(args)
    except (OSError, RuntimeError, MemoryError, ImportError, SystemError) as error:
        if (limit := limit_behind(error)) is None:
            raise
        limit.hint += "; the daemon and a loader need about 30 threads and 1 GiB"
        raise limit from None


def _serve(args: argparse.Namespace) -> int:
    from shmmap.daemon.config import load_config
    from shmmap.daemon.main import run as serve
    from shmmap.daemon.service_manager import ServiceManager
    from shmmap.errors import ShmmapError

    settings = {name: value for name, value in vars(args).items() if name not in ("run", "config")}
    try:
        return serve(load_config(settings, file=args.config))
    except ShmmapError as error:
        ServiceManager().failed(str(error))
        raise
