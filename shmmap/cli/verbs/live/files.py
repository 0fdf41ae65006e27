# SPDX-License-Identifier: Apache-2.0
"""``shmmap live fsck``, ``export`` and ``reset``: work on a live map's files without its daemon."""

from __future__ import annotations

import argparse
import contextlib
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from shmmap.cli.options import Subparsers, add_json_option, add_verb, metres
from shmmap.cli.program import add_allow_empty, complain, nothing_found
from shmmap.cli.screens.output import (
    counted,
    format_bytes,
    format_duration,
    print_json,
    print_line,
    print_pairs,
)
from shmmap.cli.screens.work_progress import fields_text
from shmmap.cli.verbs.maps.divide import translation
from shmmap.errors import BadRequest, MapDataError, MapMissing, ShmmapError
from shmmap.formats.durable_file import writing_errors

if TYPE_CHECKING:
    from shmmap.live_worker.disk.exporting import ExportedVoxels, Format
    from shmmap.live_worker.disk.maintenance import CheckedMap


def _add_directory(parser: argparse.ArgumentParser) -> None:
    """Add ``DIR``."""
    parser.add_argument(
        "directory",
        metavar="DIR",
        help="the directory of the live map, or its name in the settings or in a daemon that runs",
    )


def _directory_from(args: argparse.Namespace) -> str:
    """Return the map's directory; an argument that is no directory may be the name of a map.

    Raises
    ------
    MapMissing
        There is neither a directory nor a live map of that name.
    """
    given: str = args.directory
    if os.path.isdir(given) or os.sep in given:
        return os.path.abspath(given)
    known = [(name, path) for name, path in _places() if os.path.isdir(path)]
    for name, path in known:
        if name == given:
            return path
    names = ", ".join(dict.fromkeys(name for name, _ in known))
    raise MapMissing(
        f"there is neither a directory nor a live map {given!r}",
        hint=f"live maps here: {names}"
        if names
        else "name the directory of a live map; no live map is set up",
    )


def _places() -> Iterator[tuple[str, str]]:
    """Yield names and directories of live maps: of the settings, of a daemon that runs, and default ones."""
    from shmmap.daemon.config import installed_config_file, load_config
    from shmmap.doctor.daemon_lists import DaemonLists
    from shmmap.live_settings import SERVICE_STATE, state_directory
    from shmmap.statistics.reader import read_statistics

    config = load_config({}, file=installed_config_file())
    yield from ((one.name, one.path) for one in config.live if one.path)
    with contextlib.suppress(ShmmapError, OSError):  # no daemon, which may have been given another directory
        with contextlib.closing(DaemonLists()) as lists:
            lists.add_to(served := read_statistics(config.instance, config.shm_dir))
        yield from ((row.name, row.path) for row in served.live)
    for state in filter(None, (state_directory(config.instance), f"{SERVICE_STATE}/{config.instance}")):
        with contextlib.suppress(OSError):
            yield from ((name, f"{state}/live/{name}") for name in sorted(os.listdir(f"{state}/live")))


_FSCK_EXIT = """\
Exit code: 0 all is well, 65 something is damaged, lost or cannot be read (also where that was repaired),
66 no live map there, 75 another process works with it (then --read-only looks)."""


def add_fsck(subparsers: Subparsers) -> None:
    """Add the action ``fsck``."""
    parser = add_verb(
        subparsers,
        "fsck",
        run_fsck,
        help="check the database of a live map",
        description="Read each chunk of a live map whole, and check it against its checksums and counters.\n"
        "Nothing is changed without --repair, and nothing is ever deleted.",
        output="live.outputs.checked_kind",
        epilog=_FSCK_EXIT,
    )
    _add_directory(parser)
    how = parser.add_mutually_exclusive_group()
    how.add_argument(
        "--read-only", action="store_true", help="look also while a daemon works with the map, without a lock"
    )
    how.add_argument(
        "--repair",
        action="store_true",
        help="make a database of the good chunks, and put the damaged one aside",
    )
    add_json_option(parser)


def run_fsck(args: argparse.Namespace) -> int:
    """Check the database, and repair it if requested."""
    from shmmap.live_worker.disk.maintenance import check, repair
    from shmmap.live_worker.disk.stored_map import opened_folder, opened_folder_to_read, require_database

    path = _directory_from(args)
    if args.read_only:
        with opened_folder_to_read(path) as folder:
            found = check(folder, path)
    else:
        busy = "--read-only looks at it nevertheless"
        with opened_folder(path, f"stop it; {busy}") as folder:
            require_database(folder)
            found = check(folder, path)
            if args.repair:
                with writing_errors(path):
                    repair(folder, found)
    if args.json:
        print_json(_fsck_as_json(found))
    else:
        _print_fsck(found)
    if not found.good and not args.json and not args.repair:
        advice = "bring the database back from a copy; or let --repair make one of what is good"
        complain("shmmap", f"{path}: not everything that was saved is there", advice)
    return 0 if found.good else MapDataError.exit_code


def _fsck_as_json(found: CheckedMap) -> dict[str, object]:
    import msgspec

    from shmmap.cli.verbs.live.outputs import TOTALS

    shown: dict[str, object] = msgspec.to_builtins({**msgspec.structs.asdict(found), "rows": {}})
    del shown["rows"]
    totals = {what: found.total(what) for what in TOTALS}
    return {**shown, "good": found.good, "chunks": len(found.rows), **totals}


def _print_fsck(found: CheckedMap) -> None:
    known, occupied, free = (f"{found.total(what):,}" for what in ("active", "occupied", "free"))
    lines = [
        ("map", found.path),
        ("voxels of", f"{found.resolution:g} m in frame {found.frame_id}"),
        ("good", f"{counted(len(found.rows), 'chunk')}, {format_bytes(found.total('bytes'))}"),
        ("voxels", f"{known} known: {occupied} occupied, {free} free"),
        *(("put aside", name) for name in found.aside),
    ]
    if found.rebuilt_from:
        lines.append(("repaired", f"the damaged database is kept as {found.rebuilt_from}"))
    print_pairs(lines)
    if found.damaged:
        print_line(f"damaged: {found.damaged}")
    for name, why in found.unknown.items():
        print_line(f"unknown: {name} may have had more chunks: {why}")
    for lost in found.lost:
        now = f"version {lost.found} is there" if lost.found else "nothing is there"
        print_line(f"lost: chunk {lost.chunk}: version {lost.version} was saved, {now}: {lost.reason}")


_EXPORT_EPILOG = """\
A point lies in the middle of its voxel, in metres; its field `intensity` is the probability that the voxel
is occupied.
A daemon may go on mapping meanwhile.  What it has not saved yet is in its memory alone, and left out: before
that, `shmmap live save` has everything saved.
OUT appears complete or not at all, and a damaged chunk ends the export.
Exit code: 0; 1 no such voxel (then nothing is written), 2 wrong usage or OUT exists, 65 a damaged chunk,
66 no live map there, 73 OUT cannot be written."""


def add_export(subparsers: Subparsers) -> None:
    """Add the action ``export``."""
    parser = add_verb(
        subparsers,
        "export",
        _run_export,
        help="write voxels to a cloud, or a map to serve",
        description="Write the voxels of a live map to a PLY or PCD file, or as a divided map that `shmmap "
        "serve` and Autoware read.",
        output="live.outputs.exported_kind",
        epilog=_EXPORT_EPILOG,
    )
    _add_directory(parser)
    parser.add_argument(
        "-o",
        "--output",
        metavar="OUT",
        required=True,
        help="a .ply or .pcd file, or the map directory to make",
    )
    parser.add_argument(
        "--voxels", choices=("occupied", "free", "both"), default="occupied", help="which (default: occupied)"
    )
    parser.add_argument(
        "--translate",
        metavar="X,Y,Z|auto|none",
        type=translation,
        default="auto",
        help="added to every point; auto (the default) shifts them to the origin if float32 would lose more "
        "than 0.5 mm where they are; none keeps their frame, in float64 where needed",
    )
    parser.add_argument(
        "--cell-size", metavar="METRES", type=metres, default=20.0, help="side of a map's cell (default: 20)"
    )
    parser.add_argument("--force", action="store_true", help="replace a file, or a divided map, that exists")
    add_allow_empty(parser)
    add_json_option(parser)


def _run_export(args: argparse.Namespace) -> int:
    """Export the map, and print the result."""
    from shmmap.live_worker.disk.exporting import export
    from shmmap.live_worker.disk.stored_map import opened_map

    path = _directory_from(args)
    began_s = time.monotonic()
    with opened_map(path) as stored:
        made = export(
            stored,
            args.output,
            _format(args.output),
            voxels=args.voxels,
            translate=args.translate,
            cell_size=args.cell_size,
            force=args.force,
        )
    if made is None:
        which = "known" if args.voxels == "both" else args.voxels
        return nothing_found(
            args,
            f"no {which} voxel is saved in {path}: nothing is written",
            "if a daemon maps there now, have it save first: `shmmap live save`",
        )
    seconds = time.monotonic() - began_s
    if args.json:
        from shmmap.cli.json_output import with_more

        print_json(with_more(made, seconds=seconds))
    else:
        print_pairs([*_export_lines(made), ("time", format_duration(seconds))])
    if made.lost:
        named = ", ".join(made.lost[:3]) + (", ..." if len(made.lost) > 3 else "")
        complain(
            "shmmap",
            f"left out: what is lost of {counted(len(made.lost), 'chunk')}: {named}",
            "`shmmap live fsck` says why",
        )
    return 0


def _format(out: str) -> Format:
    suffix = Path(out).suffix.lower()
    return "ply" if suffix == ".ply" else "pcd" if suffix == ".pcd" else "map"


def _export_lines(made: ExportedVoxels) -> list[tuple[str, str]]:
    lines = [
        (made.format, made.path),
        ("voxels", f"{made.voxels:,} of {counted(made.chunks, 'chunk')}, side {made.resolution:g} m"),
        ("fields", fields_text(made.fields)),
    ]
    if made.cells:
        lines.append(("cells", f"{made.cells:,}"))
    if any(made.origin):
        x, y, z = made.origin
        lines.append(("moved", f"({x:.12g}, {y:.12g}, {z:.12g}) m leads back to frame {made.frame_id}"))
    return [
        *lines,
        ("note", "as saved: not what is in a daemon's memory alone (`shmmap live save`)"),
    ]


_RESET_EXIT = """\
Exit code: 0, 2 without --yes, 66 no live map there, 73 a file cannot be moved, 75 another process works
with it."""


def add_reset(subparsers: Subparsers) -> None:
    """Add the action ``reset``."""
    parser = add_verb(
        subparsers,
        "reset",
        _run_reset,
        help="begin a new map in place of a live map",
        description="Move all files of a live map aside, into DIR/reset.1 or the next number that is free; "
        "the daemon's next start begins a new map in DIR.  What was moved is a live map as before.",
        output="live.outputs.reset_kind",
        epilog=_RESET_EXIT,
    )
    _add_directory(parser)
    parser.add_argument("--yes", action="store_true", help="apply the changes (default: dry run)")
    parser.add_argument("--delete", action="store_true", help="delete the files instead of moving them")
    add_json_option(parser)


def _run_reset(args: argparse.Namespace) -> int:
    """Move the files aside, or delete them."""
    from shmmap.live_worker.disk.maintenance import files_of_map, reset
    from shmmap.live_worker.disk.stored_map import opened_folder

    path = _directory_from(args)
    with opened_folder(path, "stop the daemon: it would go on with the files that it knows") as folder:
        if not args.yes:
            sizes = files_of_map(folder)
            what = f"{counted(len(sizes), 'file')} ({format_bytes(sum(sizes.values()))}) of the live map"
            raise BadRequest(
                f"{what} in {path} would be {'deleted' if args.delete else 'moved aside'}",
                hint="--yes does it",
            )
        with writing_errors(path):
            done = reset(folder, delete=args.delete)
    if args.json:
        print_json(done)
    else:
        where = f"moved to {done.moved_to}" if done.moved_to else "deleted"
        print_line(f"{counted(done.files, 'file')} ({format_bytes(done.bytes)}) {where}")
    return 0
