# SPDX-License-Identifier: Apache-2.0
"""The program ``shmmap-rolling``: ``run`` a drive into a live map, ``config`` from a parameter file."""

from __future__ import annotations

import argparse
import contextlib
import sys
import time
from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final

from shmmap import BadRequest
from shmmap.errors import ConfigError
from shmmap_clients.command_line import (
    add_allow_empty,
    add_daemon_options,
    add_json_option,
    add_verb,
    complain,
    connect,
    counted,
    finite,
    not_negative,
    nothing_found,
    output_file,
    positive,
    print_json,
    print_line,
    run_program,
    seconds,
    write_text,
)
from shmmap_clients.shared_options import (
    add_poses_option,
    add_quiet_option,
    add_scans_option,
    bag_options_from,
    reader_from,
)

if TYPE_CHECKING:
    from shmmap.live import LiveMap, LiveMapper, ScanFilter
    from shmmap_clients.rolling_map.live_map import DriveStatistics
    from shmmap_clients.rolling_map.parameters import Parameters, Shown
    from shmmap_clients.scan_drive import ScanDrive

_NAME: Final = "shmmap-rolling"
_PARTS: Final = ("occupied", "free", "chunks", "usage")
_LIMITS: Final = ("min_range", "max_range", "min_z", "max_z")
_RUN_JSON: Final = """\
JSON (fields may be added, none is removed):
  {"map", "scans", "points",
   "counts": {"near": in range, "far": beyond it, "too_near", "outside_z",
              "not_finite": left out},
   "first_scan", "last_scan": their numbers, or null,
   "applied", "durable": number of the newest scan in memory, on the disk,
   "add_ms": {"p50", "p99", "max"}, or null,
   "usage": {"active": voxels that are known, "bytes", "chunks",
             "waiting_bytes"},
   "chunks": {state: how many}}

Exit code: 0; 1 when there was no scan, no point of any scan counted, or the
last scan was not on the disk after --wait."""
_CONFIG_NOTE: Final = """\
The section makes a map like the one that the file is for: voxels, what a hit
and a miss are worth, a window of the 26 neighbours that follows at once.
Ranges, the z band and what is shown belong to the program that maps: give the same file
to `shmmap-rolling run --params`."""


def _add_run(subparsers: Any) -> None:
    """Add ``run``."""
    parser = add_verb(
        subparsers,
        "run",
        _run,
        help="map scan after scan",
        description="Map scan after scan into a live map of the daemon (`shmmap serve --live NAME`).  The"
        " map's window follows the poses.",
        epilog=_RUN_JSON,
    )
    parser.add_argument("--live", required=True, metavar="NAME", help="name of the live map")
    add_scans_option(parser, min_range=False)
    add_poses_option(parser)
    parser.add_argument(
        "--params",
        metavar="FILE",
        help="Rolling-Bonxai's parameter file (YAML, version 1): ranges, z band, and what is shown; what it"
        " says of the map must be as the map is (see `shmmap-rolling config`)",
    )
    parser.add_argument(
        "--mapper",
        "--name",
        default=_NAME,
        metavar="NAME",
        help=f"name under which scans are counted: each running program needs its own (default: {_NAME})",
    )
    parser.add_argument(
        "--resume",
        action="store_true",
        help="begin after the scans of this directory that are in the map already: where a run of the same"
        " command was killed, or ended by a restart",
    )
    parser.add_argument(
        "--frame",
        metavar="ID",
        help="frame of the poses: another one than the map's is refused (default: as --params says, else the"
        " map's)",
    )
    _add_filter_options(parser)
    _add_output_options(parser)
    add_allow_empty(parser)
    add_json_option(parser)
    add_daemon_options(parser, json=False)


def _add_output_options(parser: argparse.ArgumentParser) -> None:
    out = parser.add_argument_group("output")
    out.add_argument(
        "--picture",
        type=output_file,
        metavar="FILE",
        help="write an SVG of the map at the end",
    )
    out.add_argument(
        "--show",
        type=_parts,
        metavar="LIST",
        help="what the picture shows, of occupied,free,chunks,usage with commas between them; usage: active"
        " cells and bytes, in the lines of progress, too (default: as --params says, else"
        " occupied,chunks,usage)",
    )
    out.add_argument(
        "--wait",
        type=seconds,
        default=30.0,
        metavar="SECONDS",
        help="how long to wait at the end until all scans are on the disk; 0: not at all (default: 30)",
    )
    add_quiet_option(out)


def _add_filter_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that limit which points are used."""
    group = parser.add_argument_group(
        "points that count", "In the sensor's frame; what is given here counts before what --params says."
    )
    group.add_argument(
        "--min-range", type=not_negative, metavar="M", help="nearer points are left out (default: 0.5)"
    )
    group.add_argument(
        "--max-range",
        type=positive,
        metavar="M",
        help="rays to further points are cut there, and end in nothing (default: 5)",
    )
    group.add_argument("--min-z", type=finite, metavar="M", help="lower points are left out (default: -2)")
    group.add_argument("--max-z", type=finite, metavar="M", help="higher points are left out (default: 2)")


def _parts(text: str) -> frozenset[str]:
    parts = frozenset(text.split(","))
    if not parts <= set(_PARTS):
        raise argparse.ArgumentTypeError(f"expected some of {','.join(_PARTS)}, not {text!r}")
    return parts


def _parameters_from(args: argparse.Namespace) -> Parameters | None:
    """Read the parameter file, if given, and report parameters without effect."""
    if args.params is None:
        return None
    from shmmap_clients.rolling_map.parameters import read_parameters

    parameters = read_parameters(args.params)
    if parameters.warning:
        complain(_NAME, f"warning: {args.params}: {parameters.warning}")
    return parameters


def _scan_filter_from(args: argparse.Namespace, parameters: Parameters | None) -> ScanFilter:
    """Return the filter of the points to use.

    Raises
    ------
    BadRequest
        The options exclude all points.
    """
    import msgspec

    from shmmap.live import ScanFilter

    base = parameters.scan_filter if parameters is not None else ScanFilter()
    given = {name: getattr(args, name) for name in _LIMITS if getattr(args, name) is not None}
    try:
        return ScanFilter(**{**msgspec.structs.asdict(base), **given})
    except ConfigError as error:
        said = error.message
        for name in _LIMITS:
            said = said.replace(f"{name} = ", f"--{name.replace('_', '-')} ")
        raise BadRequest(said) from None


def _shown_from(args: argparse.Namespace, parameters: Parameters | None) -> Shown:
    """Return the choice of displayed items."""
    from shmmap_clients.rolling_map.parameters import Shown

    if args.show is not None:
        return Shown(*(part in args.show for part in _PARTS))
    return parameters.shown if parameters is not None else Shown(usage=True)


def _run(args: argparse.Namespace) -> int:
    """Map the scans to their end."""
    from shmmap_clients.rolling_map.live_map import DriveStatistics, map_scan
    from shmmap_clients.scan_drive import ScanDrive
    from shmmap_clients.scans.bag import is_bag
    from shmmap_clients.streams import is_endpoint

    parameters = _parameters_from(args)
    shown = _shown_from(args, parameters)
    scan_filter = _scan_filter_from(args, parameters)
    if args.resume and (is_endpoint(args.scans) or is_bag(args.scans)):
        raise BadRequest(
            "--resume is for a directory of scans",
            hint="leave it out: scans of a publisher or a bag count as they come",
        )
    with contextlib.ExitStack() as stack:
        # the map filters and counts points by its own limits
        # rays begin at the scanner, whose frame the limits are in
        bag = bag_options_from(args, map_frame=_frame(args, parameters) or "map", frame="sensor")
        reader = reader_from(args, _NAME, min_range=None)
        drive = ScanDrive(args, _NAME, args.poses, stack, reader=reader, bag=bag)
        client = stack.enter_context(connect(args, _NAME))
        live = client.live(args.live, frame_id=_frame(args, parameters))
        if parameters is not None:
            parameters.check_map(live)
        mapper = stack.enter_context(live.mapper(args.mapper, scan_filter, resume=args.resume))
        if args.resume:
            _leave_out_mapped(args, drive, mapper)
        statistics = DriveStatistics(live if shown.usage else None)
        drive.run(lambda scan: map_scan(scan, mapper), statistics)
        code = _wait_until_saved(args, drive, mapper, statistics)
        if args.picture:
            _draw(args, live, shown, statistics)
        _report(args, live, mapper, statistics)
    return code


def _leave_out_mapped(args: argparse.Namespace, drive: ScanDrive, mapper: LiveMapper) -> None:
    """Skip the scans of the directory that are already in the map."""
    from shmmap_clients.scans.scan_sequence import ScanSequence

    scans = drive.scans
    assert isinstance(scans, ScanSequence)  # noqa: S101  # --resume is for a directory
    if mapper.applied > len(scans):
        raise BadRequest(
            f"{args.scans} has {len(scans)} scans, but {mapper.applied} of mapper {args.mapper} are"
            " in the map",
            hint="--resume is for the same directory as in the run before; leave it out for another",
        )
    scans.leave_out(mapper.applied)
    print_line(f"{mapper.applied} scans are in the map, {len(scans)} are left", file=sys.stderr)


def _frame(args: argparse.Namespace, parameters: Parameters | None) -> str:
    """Return the frame of the poses; empty for the map's frame."""
    if args.frame is not None:
        return str(args.frame)
    if parameters is not None and "map_frame" in parameters.origins:
        return parameters.live.frame_id
    return ""


def _wait_until_saved(
    args: argparse.Namespace, drive: ScanDrive, mapper: LiveMapper, statistics: DriveStatistics
) -> int:
    """Wait until all scans are applied and on disk; return the exit code."""
    from shmmap import NoAnswer

    last = statistics.last
    if last is None and args.resume and mapper.applied:
        return 0  # the previous run had processed all scans
    if last is None:
        return drive.no_scans()
    if args.wait > 0:
        end_s = time.monotonic() + args.wait
        with contextlib.suppress(NoAnswer):  # missing scans are reported below
            mapper.wait_applied(args.wait)
            mapper.wait_durable(max(0.1, end_s - time.monotonic()))
        if mapper.durable < last:
            missing = f"scan {last} is not on the disk after {args.wait:g} s, but scan {mapper.durable}"
            complain(_NAME, missing, "the daemon goes on; `shmmap live show` says how far it is")
            return 1
    if not statistics.counted:
        why = f"of {statistics.points} points {statistics.left_out}" if statistics.points else "none had any"
        return nothing_found(args, f"no point of any scan counted: {why}", name=_NAME)
    return 0


def _draw(args: argparse.Namespace, live: LiveMap, shown: Shown, statistics: DriveStatistics) -> None:
    import numpy as np

    from shmmap_clients.rolling_map.live_map import all_voxels, usage_text
    from shmmap_clients.rolling_map.picture import MapContent, map_picture

    nothing = np.empty((0, 3))
    content = MapContent(
        live.resolution,
        all_voxels(live, "occupied") if shown.occupied else nothing,
        all_voxels(live, "free") if shown.free else nothing,
        live.chunks(saved=True) if shown.chunks else (),
        statistics.path,
        usage_text(live.status()) if shown.usage else "",
    )
    note = f"{statistics.scans} scans, voxels of {live.resolution:g} m, frame {live.frame_id}"
    write_text(args.picture, map_picture(content, f"live map {live.name}", note))


def _report(args: argparse.Namespace, live: LiveMap, mapper: LiveMapper, statistics: DriveStatistics) -> None:
    from shmmap_clients.rolling_map.live_map import states_text, usage_text

    usage, chunks = live.status(), live.chunks(saved=True)
    summary = statistics.summary(applied=mapper.applied, durable=mapper.durable)
    if args.json:
        fields = ("active", "bytes", "chunks", "waiting_bytes")
        print_json(
            {
                "map": live.name,
                **summary,
                "usage": {name: getattr(usage, name) for name in fields},
                "chunks": dict(Counter(row.state for row in chunks)),
            }
        )
        return
    times = summary["add_ms"]
    spent = f"; {times['p50']:.1f} ms each (p99 {times['p99']:.1f})" if times else ""
    left_out = f"; left out: {statistics.left_out}" if statistics.left_out else ""
    read = f"{counted(statistics.scans, 'scan')}, {counted(statistics.points, 'point')}"
    print(f"{read}, {statistics.counted:,} of them used{left_out}{spent}")
    print(f"live map {live.name}: {usage_text(usage)}; {states_text(chunks)}")


def _add_config(subparsers: Any) -> None:
    """Add ``config``."""
    parser = add_verb(
        subparsers,
        "config",
        _config,
        help="the daemon's settings from Rolling-Bonxai's parameter file",
        description="Print the section of the daemon's settings (TOML) for a live map as a parameter file of"
        " Rolling-Bonxai, version 1, has it.  No daemon is needed.",
        epilog=_CONFIG_NOTE,
    )
    parser.add_argument("params", metavar="FILE", help="Rolling-Bonxai's parameter file (YAML)")
    parser.add_argument("--name", required=True, metavar="NAME", help="name of the live map")
    parser.add_argument(
        "--path", metavar="DIR", help="directory of the map's files (default: the file's c_chunk_folder_path)"
    )
    parser.add_argument(
        "--out", type=output_file, metavar="FILE", help="write the section into this file, not to stdout"
    )


def _config(args: argparse.Namespace) -> int:
    """Read the parameter file, and print or write the settings."""
    import msgspec

    from shmmap_clients.rolling_map.parameters import live_section, read_parameters

    parameters = read_parameters(args.params)
    settings = parameters.live
    if args.path is not None:
        settings = msgspec.structs.replace(settings, path=args.path)
    section = live_section(args.name, settings)
    if parameters.warning:
        complain(_NAME, f"warning: {args.params}: {parameters.warning}")
    if args.out:
        write_text(args.out, section)
    else:
        print(section, end="")
    return 0


def main(argv: Sequence[str] | None = None) -> int:
    """Run one verb and return the exit code."""
    return run_program(
        _NAME,
        "Map LiDAR scans with poses into a live map: which voxels are occupied, and which are free.",
        (_add_run, _add_config),
        argv,
    )
