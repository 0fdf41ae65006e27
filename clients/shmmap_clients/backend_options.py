# SPDX-License-Identifier: Apache-2.0
"""Options that say who computes scores: a backend, and for one on a device which device, and how."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from shmmap_clients.shared_options import Parser, add_threads_option

if TYPE_CHECKING:
    from shmmap_clients.ndt_scan_matcher import DeviceOptions

__all__ = ["add_device_options", "add_scoring_options", "device_options_from", "scoring_settings"]


def add_scoring_options(parser: Parser, *, all_processors: bool = False) -> None:
    """Add ``--backend``, ``--fallback``, ``--threads`` as `add_threads_option`, and devices' options."""
    parser.add_argument(
        "--backend",
        default="numba",
        metavar="NAME",
        help="numba; numpy: same results, slower, no compiler; or opencl: same results, on a GPU or any other"
        " device with a driver (default: numba)",
    )
    parser.add_argument(
        "--fallback",
        metavar="NAME",
        help="backend that goes on, and says so, when the device fails in the middle of the work (default:"
        " that is an error)",
    )
    add_device_options(parser)
    add_threads_option(parser, all_processors=all_processors)


def add_device_options(parser: Parser) -> None:
    """Add ``--device``, ``--precision`` and ``--memory``."""
    parser.add_argument(
        "--device",
        metavar="INDEX|NAME",
        help="device for --backend opencl, as `shmmap-ndt devices` lists them (default: SHMMAP_OPENCL_DEVICE,"
        " or the first GPU, else the first device)",
    )
    parser.add_argument(
        "--precision",
        choices=("auto", "double", "float"),
        default="auto",
        help="of a device; auto: double where it has that (default: auto)",
    )
    parser.add_argument(
        "--memory",
        choices=("auto", "svm", "copy"),
        default="auto",
        help="where the map lies for a device: svm reads shared memory in place, copy copies each map;"
        " auto: in place where the device says that it can (default: auto)",
    )


def device_options_from(args: argparse.Namespace) -> DeviceOptions:
    """Return which device is asked for, and how."""
    from shmmap_clients.ndt_scan_matcher import DeviceOptions

    return DeviceOptions(args.device, args.precision, args.memory)


def scoring_settings(args: argparse.Namespace) -> dict[str, Any]:
    """Return what `Settings` has of these options."""
    return {"backend": args.backend, "device": device_options_from(args), "fallback": args.fallback}
