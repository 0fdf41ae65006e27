# SPDX-License-Identifier: Apache-2.0
"""``shmmap versions`` and ``shmmap fetch``: manage a published map's versions, and download one.

``versions`` lists versions, rolls back to one, removes old ones, and renews keys.
"""

from __future__ import annotations

import argparse
import contextlib
import time
from typing import TYPE_CHECKING

from shmmap.cli.options import Subparsers, add_json_option, add_verb, at_least, number_of
from shmmap.cli.screens.output import (
    Column,
    counted,
    format_bytes,
    format_duration,
    print_json,
    print_line,
    print_pairs,
    print_table,
)
from shmmap.cli.verbs.maps.map_options import (
    URL_HELP,
    add_sign_option,
    add_sole_publisher_option,
    add_store_options,
    add_trust_option,
    cache_directory,
    progress_on_stderr,
    signer_at,
    store_at,
    verified_at,
)
from shmmap.errors import BadRequest, MapMissing

if TYPE_CHECKING:
    from shmmap.origin.remote.map_versions import Current, Entry
    from shmmap.origin.remote.store import Store
    from shmmap.origin.remote.verify_apart import Verified
    from shmmap.progress import Progress
    from shmmap.publishing.signing import MapSigner

_VERSIONS_EPILOG = """\
--rollback gives an old version's content a new number: vehicles never go back to a lower one.
With a web server, versions that were never served cannot be listed.
Exit code: 0, 2 wrong usage, 65 damaged or --trust refuses, 66 no such map or version, 69 a package is
missing, 73 the store cannot switch versions safely, 75 it does not answer or refuses, or another
publisher was quicker, 78 unusable credentials or keys."""


def add_versions(subparsers: Subparsers) -> None:
    """Add the verb ``versions``."""
    parser = add_verb(
        subparsers,
        "versions",
        run_versions,
        help="a published map's versions: list, go back, remove old ones",
        description="List the versions of a published map, go back to one, or remove old ones.",
        output="maps.outputs.Versions maps.outputs.RolledBack maps.outputs.Refreshed"
        " maps.outputs.rotated_kind maps.outputs.pruned_kind",
        epilog=_VERSIONS_EPILOG,
    )
    parser.add_argument("url", metavar="URL", help=URL_HELP)
    what = parser.add_mutually_exclusive_group()
    what.add_argument(
        "--rollback", metavar="N", type=at_least(1), help="make the content of version N current again"
    )
    what.add_argument(
        "--prune",
        action="store_true",
        help="remove versions that have not been current for --keep days, and what only they have",
    )
    what.add_argument(
        "--refresh",
        action="store_true",
        help="renew a signed map's timestamp, and its snapshot when due; needs --sign",
    )
    what.add_argument(
        "--rotate",
        metavar="ROLE",
        choices=("root", "targets", "snapshot", "timestamp"),
        help="give root, targets, snapshot or timestamp another key, and remove the old one; needs root.pem",
    )
    parser.add_argument(
        "--keep",
        metavar="DAYS",
        type=number_of("days, 7 or more", 7.0, 1e6),
        default=None,
        help="with --prune: how many days, 7 or more (default: 30)",
    )
    parser.add_argument("--quiet", action="store_true", help="no progress on stderr")
    add_sign_option(parser)
    add_trust_option(parser)
    add_store_options(parser)
    add_sole_publisher_option(parser)
    add_json_option(parser)


def run_versions(args: argparse.Namespace) -> int:
    """List versions, or roll back, refresh, rotate or prune."""
    if args.keep is not None and not args.prune:
        raise BadRequest("--keep goes with --prune")
    if args.sign is not None and not (args.refresh or args.rollback or args.rotate):
        raise BadRequest("--sign goes with --refresh, --rollback or --rotate")
    if args.rotate and args.sign is None:
        raise BadRequest("--rotate needs the directory with the keys, root.pem too", hint="--sign KEYDIR")
    if args.trust is not None and (args.refresh or args.rollback or args.prune or args.rotate):
        raise BadRequest("--trust goes with the list of versions alone")
    if args.refresh and args.sign is None:
        raise BadRequest("--refresh needs the directory with online.pem and ROOT.json", hint="--sign KEYDIR")
    if args.sole_publisher and not (args.refresh or args.rollback or args.rotate):
        raise BadRequest("--sole-publisher goes with --refresh, --rollback or --rotate")
    store = store_at(args.url, args)
    signer = signer_at(store, args)
    unit = "objects" if args.prune else "cells"
    progress = progress_on_stderr(args, unit)
    if args.rollback is not None:
        _roll_back(store, args.rollback, progress, signer, as_json=args.json)
    elif signer is not None and args.rotate:
        _rotate(store, signer, args.rotate, as_json=args.json)
    elif signer is not None:
        _refresh(store, signer, as_json=args.json)
    elif args.prune:
        _prune(store, args.keep, progress, as_json=args.json)
    else:
        _list(store, verified_at(store, args), as_json=args.json)
    return 0


def _roll_back(
    store: Store, version: int, progress: Progress, signer: MapSigner | None, *, as_json: bool
) -> None:
    from shmmap.publishing.restore import restore_version

    restored = restore_version(store, version, progress, signer)
    if as_json:
        changed = restored.version is not None
        from shmmap.cli.verbs.maps import outputs

        print_json(
            outputs.RolledBack(store.url, changed, restored.current, restored.restored, restored.objects)
        )
    elif restored.version is None:
        print_line(f"version {restored.current} has that content: nothing has changed")
    else:
        print_line(f"version {restored.version} is current: the content of version {restored.restored}")


def _refresh(store: Store, signer: MapSigner, *, as_json: bool) -> None:
    refreshed = signer.refresh()
    valid = {
        "timestamp": refreshed.timestamp,
        "snapshot": refreshed.snapshot,
        "targets": refreshed.targets,
    }
    if as_json:
        until = {role: time.isoformat() for role, time in valid.items()}
        from shmmap.cli.verbs.maps import outputs

        print_json(outputs.Refreshed(store.url, refreshed.current.version, until))
        return
    print_line(f"version {refreshed.current.version} is signed")
    print_pairs([(role, f"until {until:%Y-%m-%d %H:%M} UTC") for role, until in valid.items()])


def _rotate(store: Store, signer: MapSigner, role: str, *, as_json: bool) -> None:
    rotated = signer.rotate(role)
    if as_json:
        from shmmap.cli.json_output import with_more

        print_json(with_more(rotated, url=store.url))
        return
    print_line(f"{' and '.join(rotated.roles)}: signed by a new key, as root of trust {rotated.root} says")
    print_line(f"the new key is {rotated.key}: it belongs wherever the old one was")


def _prune(store: Store, keep_days: float | None, progress: Progress, *, as_json: bool) -> None:
    from shmmap.publishing.prune import KEEP_DAYS, prune_versions

    pruned = prune_versions(store, keep_days=KEEP_DAYS if keep_days is None else keep_days, progress=progress)
    if as_json:
        from shmmap.cli.json_output import with_more

        print_json(with_more(pruned, url=store.url))
        return
    removed = f"{counted(pruned.objects, 'object')}, {format_bytes(pruned.bytes)}"
    if pruned.parts:
        removed += f"; {counted(pruned.parts, 'part')} of slices that were never joined"
    kept = f"{counted(pruned.kept_objects, 'object')}, {format_bytes(pruned.kept_bytes)}"
    print_pairs(
        [
            ("removed", f"{_numbers(pruned.versions)}; {removed}"),
            ("kept", f"{_numbers(pruned.kept_versions)}; {kept}"),
        ]
    )


def _numbers(versions: list[int]) -> str:
    return f"versions {', '.join(map(str, versions))}" if versions else "no version"


def _find_versions(store: Store, current: Current) -> tuple[list[Entry], dict[int, str]]:
    """Return the entries of all versions found, latest first, and the state of each."""
    from shmmap.origin.remote.map_versions import Entry, earlier_versions, list_entries, read_entry

    # a copied map may have no entries
    entries = {current.version: Entry(current.version, current.root, current.bytes, "")}
    entries |= {entry.version: entry for entry in earlier_versions(store, current)}
    states = {version: "current" if version == current.version else "earlier" for version in entries}
    if not store.read_only:
        for version in list_entries(store):
            if version not in entries:
                with contextlib.suppress(MapMissing):  # pruned meanwhile
                    entries[version] = read_entry(store, version)
                    states[version] = "never served"
    return sorted(entries.values(), key=lambda entry: -entry.version), states


def _list(store: Store, verified: Verified | None, *, as_json: bool) -> None:
    from shmmap.origin.remote.map_versions import require_current

    current = require_current(store) if verified is None else verified.current
    ordered, states = _find_versions(store, current)
    if as_json:
        from shmmap.cli.verbs.maps import outputs

        shown = [
            outputs.Version(
                entry.version,
                states[entry.version],
                entry.created,
                entry.root,
                entry.bytes,
                entry.before,
                entry.restored,
            )
            for entry in ordered
        ]
        expires_s = verified.expires_s if verified is not None else None
        print_json(outputs.Versions(store.url, current.version, expires_s, shown))
        return
    print_table(
        [
            Column("version", "right"),
            Column("state"),
            Column("created"),
            Column("root"),
            Column("content of"),
        ],
        [
            (
                str(entry.version),
                states[entry.version],
                f"{entry.created[:19].replace('T', ' ')} UTC" if entry.created else "",
                entry.root[:12],
                f"version {entry.restored}" if entry.restored else "",
            )
            for entry in ordered
        ],
    )
    if verified is not None:
        until = time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime(verified.expires_s))
        print_line(f"version {current.version} is signed, until {until}")


_FETCH_EPILOG = """\
Every object is compared with its hash.  DIR appears complete or not at all; a stopped run, started again,
fetches only what is missing.  What a daemon of the same user keeps on this disk is not fetched.
Exit code: 0, 2 wrong usage or DIR exists, 65 an object is damaged, or --trust refuses, 66 no such map or
version, or an object is gone, 69 a package is missing, 73 DIR cannot be written, 75 the store does not
answer or refuses, or another run is making DIR, 78 unusable credentials."""


def add_fetch(subparsers: Subparsers) -> None:
    """Add the verb ``fetch``."""
    parser = add_verb(
        subparsers,
        "fetch",
        run_fetch,
        help="write a published map as a divided map",
        description="Write a published map as a divided map, which `serve` and Autoware read.",
        output="maps.outputs.Fetched",
        epilog=_FETCH_EPILOG,
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


def run_fetch(args: argparse.Namespace) -> int:
    """Fetch a version as a divided map, with progress on stderr."""
    if args.trust is not None and args.at is not None:
        raise BadRequest("--at does not go with --trust: only the current version is signed")
    store = store_at(args.url, args)
    from shmmap.origin.remote.object_tier import ObjectTier
    from shmmap.publishing.fetch import fetch_map

    began_s = time.monotonic()
    verified = verified_at(store, args)
    progress = progress_on_stderr(args)
    cache_dir = cache_directory(args)
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
