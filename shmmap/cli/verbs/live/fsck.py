# SPDX-License-Identifier: Apache-2.0
"""``shmmap live fsck DIR``: whether all of a live map's files are as they were written."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from shmmap.cli.options import Subparsers, add_json_option, add_verb
from shmmap.cli.program import complain
from shmmap.cli.screens.output import counted, format_bytes, print_json, print_line, print_pairs
from shmmap.cli.verbs.live.directory import add_directory, directory_from
from shmmap.errors import MapDataError

if TYPE_CHECKING:
    from shmmap.daemon.live.disk.maintenance import CheckedMap

__all__ = ["add_parser", "run"]

_JSON = """\
  {"path", "map_id", "resolution", "frame_id", "good",
   "chunks", "bytes", "active", "occupied", "free": of the good chunks; voxels that are known, and of these,
   "damaged": [{"file", "reason", "kept_as": name or ""}], "unreadable": {file: reason},
   "missing": [{"chunk", "version", "found": version or 0}],
   "manifest": "current", "stale", "absent" or "unreadable", "rewritten",
   "interim": [file], "aside": [file], "strange": [file]}
Exit code: 0 all is well, 65 a file is damaged, cannot be read or is missing (also where that was repaired),
66 no live map there, 75 somebody works with it (then --read-only looks)."""

_MANIFEST = {
    "current": "as the files are",
    "stale": "not as the files are, as after a kill; the daemon writes it anew",
    "absent": "none, so nobody can say whether chunks are missing; the daemon writes one",
    "unreadable": "cannot be read, so nobody can say whether chunks are missing",
}


def add_parser(subparsers: Subparsers) -> None:
    """Describe the action."""
    parser = add_verb(
        subparsers,
        "fsck",
        run,
        help="check the files of a live map",
        description="Read each chunk of a live map whole, and check it against its checksums and counters.\n"
        "Nothing is changed without --repair, and nothing is ever deleted.",
        json=_JSON,
    )
    add_directory(parser)
    how = parser.add_mutually_exclusive_group()
    how.add_argument(
        "--read-only", action="store_true", help="look also while a daemon works with the map, without a lock"
    )
    how.add_argument(
        "--repair",
        action="store_true",
        help="quarantine files that are damaged or cannot be read, and list the good ones in a new manifest",
    )
    add_json_option(parser)


def run(args: argparse.Namespace) -> int:
    """Check, and repair if that was asked for."""
    from shmmap.daemon.live.disk.maintenance import check, repair
    from shmmap.daemon.live.disk.stored_map import opened_folder, opened_folder_to_read
    from shmmap.formats.durable_file import writing_errors

    path = directory_from(args)
    if args.read_only:
        with opened_folder_to_read(path) as files:
            found = check(files, path)
    else:
        busy = "--read-only looks at it nevertheless"
        with opened_folder(path, f"stop it; {busy}") as folder:
            found = check(folder, path)
            if args.repair:
                with writing_errors(path):
                    repair(folder, found)
    if args.json:
        print_json(_as_json(found))
    else:
        _print(found)
    if not found.good and not args.json and not args.repair:
        complain("shmmap", f"{path}: not everything that was saved is there", _advice(found))
    return 0 if found.good else MapDataError.exit_code


def _as_json(found: CheckedMap) -> dict[str, object]:
    import msgspec

    told: dict[str, object] = msgspec.to_builtins({**msgspec.structs.asdict(found), "rows": {}})
    del told["rows"]
    totals = {what: found.total(what) for what in ("bytes", "active", "occupied", "free")}
    return {**told, "good": found.good, "chunks": len(found.rows), **totals}


def _print(found: CheckedMap) -> None:
    known, occupied, free = (f"{found.total(what):,}" for what in ("active", "occupied", "free"))
    lines = [
        ("map", found.path),
        ("voxels of", f"{found.resolution:g} m in frame {found.frame_id}"),
        ("good", f"{counted(len(found.rows), 'chunk')}, {format_bytes(found.total('bytes'))}"),
        ("voxels", f"{known} known: {occupied} occupied, {free} free"),
        ("manifest", "written anew" if found.rewritten else _MANIFEST[found.manifest]),
    ]
    for title, names in (
        ("unfinished", found.interim),
        ("put aside earlier", found.aside),
        ("not a chunk", found.strange),
    ):
        lines += [(title, name) for name in names]
    print_pairs(lines)
    for one in found.damaged:
        kept = f"; kept as {one.kept_as}" if one.kept_as else ""
        print_line(f"damaged: {one.file}: {one.reason}{kept}")
    for name, reason in found.unreadable.items():
        print_line(f"unreadable: {name}: {reason}")
    for lost in found.missing:
        now = f"version {lost.found} is there" if lost.found else "nothing is there"
        print_line(f"missing: chunk {lost.chunk}: version {lost.version} was saved, {now}")


def _advice(found: CheckedMap) -> str:
    if found.unreadable:
        return "as root it may be readable; else look at the disk; --repair quarantines what stays unreadable"
    if found.damaged:
        return "--repair puts damaged files aside: what they had is mapped anew, unless a copy is put back"
    return "put the files back from a copy, or let --repair forget them"
