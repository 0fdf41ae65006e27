# SPDX-License-Identifier: Apache-2.0
"""``shmmap-ndt device-check``: does a device give the same results, each time, and how fast?"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from shmmap_clients.command_line import add_verb, complain, output_file, print_line, write_text

if TYPE_CHECKING:
    from shmmap_clients.ndt_scan_matcher.backends.opencl.devices import DeviceInfo
    from shmmap_clients.ndt_scan_matcher.device_check.comparison import Check
    from shmmap_clients.ndt_scan_matcher.device_check.scenes import Scene
    from shmmap_clients.ndt_scan_matcher.matching.result import Result

__all__ = ["add_parser", "run"]

_NAME: Final = "shmmap-ndt"
_UNEQUAL, _NO_DEVICE = 1, 3
_JSON = """\
JSON (fields may be added, none is removed):
  {"shmmap", "numpy", "pyopencl": versions, "equal": bool, "devices": [{
   "device": as `devices --json` has it, "error": why it could not be used, or
     null, "precision": double or float, "memory": svm or copy, "checks": [{
     "what", "equal", "worst": {kind: difference}, "failures": [text]}],
   "latencies": {scene: {"points", "voxels", "program_ms", "map_ms",
     "set_map_ms", "evaluation_ms", "batch_ms": of 200 poses; these two as
     {"min", "p50", "p99", "max"}}}}]}
Exit code: 0 all is equal; 1 something is not; 3 there is no such device."""


def add_parser(subparsers: Any) -> None:
    """Add the verb."""
    parser = add_verb(
        subparsers,
        "device-check",
        run,
        help="compare devices with the processor, and time them",
        description="Compare what each OpenCL device computes with what numpy computes: scores and"
        " derivatives, whole alignments in a generated town, repeats bit for bit; and measure how long it"
        " takes.  The report belongs to any report of a defect on a device.",
        epilog=_JSON,
    )
    parser.add_argument(
        "--require", choices=("gpu",), help="it has to be a GPU: exit code 3 where there is none"
    )
    parser.add_argument("--device", metavar="INDEX|NAME", help="this device alone (default: all)")
    parser.add_argument("--json", type=output_file, metavar="FILE", help="write the report, JSON")
    parser.add_argument(
        "--references",
        metavar="DIR",
        help="also compare with alignments that ndt_omp and Autoware computed: reference_results.json and its"
        " clouds",
    )
    parser.add_argument(
        "--pack",
        type=output_file,
        metavar="FILE",
        help="write the scenes to this file (.npz) and end, for a machine that has numpy and pyopencl alone",
    )
    parser.add_argument("--packed", metavar="FILE", help="take the scenes from such a file")


def run(args: argparse.Namespace) -> int:
    """Compare, print, write the report."""
    from shmmap_clients.ndt_scan_matcher.device_check.scenes import (
        load_scenes,
        pack_scenes,
        reference_scenes,
        town_scenes,
    )

    if args.pack:
        scenes = town_scenes() + (reference_scenes(Path(args.references)) if args.references else [])
        pack_scenes(scenes, Path(str(args.pack)))
        print_line(f"{len(scenes)} scenes, {Path(str(args.pack)).stat().st_size / 1e6:.1f} MB: {args.pack}")
        return 0
    from shmmap_clients.ndt_scan_matcher.backends.opencl.devices import NO_DRIVER_HINT, list_devices

    chosen = [
        info
        for info in list_devices()
        if (args.require != "gpu" or info.kind == "GPU")
        and (
            args.device is None or args.device == str(info.index) or args.device.lower() in info.name.lower()
        )
    ]
    if not chosen:
        what = "GPU" if args.require == "gpu" else "device"
        complain(_NAME, f"there is no such OpenCL {what} here: {NO_DRIVER_HINT}")
        return _NO_DEVICE
    if args.packed:
        scenes = load_scenes(Path(args.packed))
    else:
        scenes = town_scenes() + (reference_scenes(Path(args.references)) if args.references else [])
    known: dict[str, Result] = {}
    entries = [entry for info in chosen for entry in _checked(info, scenes, known)]
    equal = all(not entry["error"] and all(one["equal"] for one in entry["checks"]) for entry in entries)
    if args.json:
        _write(args, entries, equal)
    print_line("all is equal" if equal else "NOT all is equal")
    return 0 if equal else _UNEQUAL


def _write(args: argparse.Namespace, entries: list[dict[str, Any]], equal: bool) -> None:
    import json
    from importlib.metadata import version

    import numpy as np

    import shmmap

    document = {
        "shmmap": shmmap.__version__,
        "numpy": np.__version__,
        "pyopencl": version("pyopencl"),
        "equal": equal,
        "devices": entries,
    }
    write_text(args.json, json.dumps(document, indent=1) + "\n")


def _checked(info: DeviceInfo, scenes: list[Scene], known: dict[str, Result]) -> list[dict[str, Any]]:
    """Check a device in every precision that it has, and every way that it reads maps."""
    from dataclasses import asdict

    from shmmap_clients.ndt_scan_matcher.backends.device_options import DeviceOptions
    from shmmap_clients.ndt_scan_matcher.backends.opencl.errors import DeviceError
    from shmmap_clients.ndt_scan_matcher.device_check.comparison import (
        check_alignments,
        check_evaluations,
        check_repeats,
    )
    from shmmap_clients.ndt_scan_matcher.device_check.latency import latencies

    print_line(info.describe())
    ways = [("double", "copy")] if info.fp64 else []
    if info.fp64 and info.svm_system:
        ways.append(("double", "svm"))
    ways.append(("float", "copy"))
    entries = []
    for precision, memory in ways:
        device = DeviceOptions(str(info.index), precision, memory)  # type: ignore[arg-type]
        entry: dict[str, Any] = {
            "device": asdict(info),
            "error": None,
            "precision": precision,
            "memory": memory,
            "checks": [],
            "latencies": {},
        }
        entries.append(entry)
        try:
            for scene in scenes:
                checks: list[Check] = check_alignments(scene, device, known)
                checks += [check_evaluations(scene, device, most) for most in (32, 2)]
                checks.append(check_repeats(scene, device))
                entry["latencies"][scene.name] = latencies(scene, device)
                for check in checks:
                    entry["checks"].append(asdict(check))
                    _print(f"{precision}, {memory}", check)
        except DeviceError as error:
            entry["error"] = str(error)
            complain(_NAME, str(error))
        for name, times in entry["latencies"].items():
            one, many = times["evaluation_ms"], times["batch_ms"]
            print_line(
                f"  {precision}, {memory}: {name}: evaluation {one['p50']:.3f} ms (p99 {one['p99']:.3f}), 200"
                f" poses {many['p50']:.2f} ms, map {times['map_ms']:.1f} ms"
            )
    return entries


def _print(how: str, check: Check) -> None:
    worst = ", ".join(f"{kind} {value:.1e}" for kind, value in check.worst.items())
    print_line(
        f"  {how}: {'equal' if check.equal else 'UNEQUAL'}: {check.what}{f' ({worst})' if worst else ''}"
    )
    for line in check.failures:
        print_line(f"    {line}")
