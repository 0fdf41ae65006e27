# SPDX-License-Identifier: Apache-2.0
"""``shmmap-ndt devices``: what ``--backend opencl`` can compute on."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from typing import Any

from shmmap_clients.command_line import add_allow_empty, add_json_option, add_verb, nothing_found, print_json

__all__ = ["add_parser", "run"]

_JSON = """\
JSON (fields may be added, none is removed):
  [{"index", "name", "platform", "driver", "kind": GPU, accelerator, CPU or
    other, "fp64": double precision, "memory_bytes", "most_bytes": of one
    buffer, "unified": the processor's memory, "svm_system": reads shared
    memory in place, "unusable": why it cannot be used, else empty}]
Exit code: 0; 1 when there is no device that can be used."""


def add_parser(subparsers: Any) -> None:
    """Add the verb."""
    parser = add_verb(
        subparsers,
        "devices",
        run,
        help="list the devices for --backend opencl",
        description="List the OpenCL devices of this machine: what they can do, whether they can be used.",
        epilog=_JSON,
    )
    add_allow_empty(parser)
    add_json_option(parser)


def run(args: argparse.Namespace) -> int:
    """List; exit code 1 where none can be used."""
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
