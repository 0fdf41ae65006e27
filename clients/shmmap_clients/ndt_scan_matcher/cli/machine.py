# SPDX-License-Identifier: Apache-2.0
"""Verbs about this machine: ``warmup`` of kernels, ``devices`` for ``--backend opencl``, ``device-check``.

``device-check`` is for bug reports; the program's help does not list it.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from shmmap_clients.command_line import (
    add_allow_empty,
    add_json_option,
    add_verb,
    nothing_found,
    output_file,
    print_json,
)
from shmmap_clients.shared_options import add_device_options, device_options_from

if TYPE_CHECKING:
    from shmmap_clients.ndt_scan_matcher.matching.result import Result
    from shmmap_clients.ndt_scan_matcher.matching.settings import Settings

__all__ = ["add_parser", "warmup_alignment"]

_DEVICES_JSON = """\
JSON (fields may be added, none is removed):
  [{"index", "name", "platform", "driver", "kind": GPU, accelerator, CPU or
    other, "fp64": double precision, "memory_bytes", "max_bytes": of one
    buffer, "unified": the processor's memory, "svm_system": reads shared
    memory in place, "unusable": why it cannot be used, else empty}]
Exit code: 0; 1 when there is no device that can be used."""
_CHECK = """\
Compare what each OpenCL device computes with what numpy computes: scores and
derivatives, whole alignments in a generated street, repeats bit for bit; and
measure how long it takes.  The report belongs to any report of a defect on a
device."""
_CHECK_EPILOG = """\
JSON (fields may be added, none is removed):
  {"shmmap", "numpy", "pyopencl": versions, "equal": bool, "devices": [{
   "device": as in `devices --json`, "error": why it could not be used, or
     null, "precision": double or float, "memory": svm or copy, "checks": [{
     "what", "equal", "worst": {kind: difference}, "failures": [text]}],
   "latencies": {scene: {"points", "voxels", "program_ms", "map_ms",
     "set_map_ms", "evaluation_ms", "batch_ms": of 200 poses; these two as
     {"min", "p50", "p99", "max"}}}}]}
Exit code: 0 all is equal; 1 something is not; 3 there is no such device."""


def add_parser(subparsers: Any) -> None:
    """Add the verbs."""
    parser = subparsers.add_parser(
        "warmup",
        help="compile the kernels and cache them",
        description="Compile the kernels and keep them (~/.cache/shmmap/kernels, or NUMBA_CACHE_DIR), so"
        " that no program that aligns has to wait for the compiler.  With --backend opencl, build the"
        " device's programs, which its driver keeps (PoCL in POCL_CACHE_DIR).",
    )
    parser.add_argument(
        "--backend", choices=("numba", "opencl"), default="numba", help="whose kernels (default: numba)"
    )
    add_device_options(parser)
    parser.set_defaults(run=_warm_up)
    parser = add_verb(
        subparsers,
        "devices",
        _list_devices,
        help="list the devices for --backend opencl",
        description="List the OpenCL devices of this machine: what they can do, whether they can be used.",
        epilog=_DEVICES_JSON,
    )
    add_allow_empty(parser)
    add_json_option(parser)
    parser = subparsers.add_parser(
        "device-check",
        description=_CHECK,
        epilog=_CHECK_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--require", choices=("gpu",), help="require a GPU: exit code 3 where there is none")
    parser.add_argument("--device", metavar="INDEX|NAME", help="this device alone (default: all)")
    parser.add_argument("--json", type=output_file, metavar="FILE", help="write the report, JSON")
    parser.set_defaults(run=_check_devices)


def warmup_alignment(settings: Settings | None = None) -> Result:
    """Align the walls of a room of 8 m with themselves from a guess 0.2 m away.

    This runs all code of a real alignment within milliseconds.
    """
    import numpy as np

    from shmmap_clients.ndt_scan_matcher.map.voxel_map import VoxelMap, voxel_cell
    from shmmap_clients.ndt_scan_matcher.matching.matcher import NdtMatcher

    line = np.arange(0.1, 8.0, 0.25)
    u, v = (grid.ravel() for grid in np.meshgrid(line, line))
    flat = np.full_like(u, 0.1)
    points = np.concatenate([np.stack(wall, axis=1) for wall in ((u, v, flat), (u, flat, v), (flat, u, v))])
    guess = np.eye(4)
    guess[:3, 3] = 0.2, -0.1, 0.1
    with NdtMatcher(settings) as matcher:
        matcher.set_map(matcher.prepare(VoxelMap({"room": voxel_cell(points, 2.0)})))
        return matcher.align(points, guess)


def _warm_up(args: argparse.Namespace) -> int:
    """Compile the kernels, or load them from the cache, and print the time taken."""
    begin = time.monotonic()
    if args.backend == "opencl":
        from shmmap_clients.ndt_scan_matcher.matching.settings import Settings

        device = device_options_from(args)
        for search in ("radius", "direct7", "direct1"):
            warmup_alignment(Settings(neighbors=search, backend="opencl", device=device))
        what = "programs built, or loaded from the driver's cache,"
    else:
        from shmmap_clients.ndt_scan_matcher.backends import kernels

        loaded = kernels.loaded_from_cache()
        warmup_alignment()
        what = f"kernels {'loaded from the cache' if loaded else 'compiled'}"
    print(f"{what} in {time.monotonic() - begin:.1f} s")
    return 0


def _list_devices(args: argparse.Namespace) -> int:
    """List the devices; exit code 1 if none can be used."""
    from shmmap_clients.ndt_scan_matcher.backends.opencl.devices import NO_DRIVER_HINT, list_devices

    found = list_devices()
    if args.json:
        print_json([asdict(info) for info in found])
    else:
        for info in found:
            print(info.describe())
    if any(not info.unusable for info in found):
        return 0
    return nothing_found(args, f"no OpenCL device can be used: {NO_DRIVER_HINT}", name="shmmap-ndt")


def _check_devices(args: argparse.Namespace) -> int:
    from shmmap_clients.ndt_scan_matcher.cli.device_check import run

    return run(args)
