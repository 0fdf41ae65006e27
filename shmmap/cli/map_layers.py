# SPDX-License-Identifier: Apache-2.0
"""Options and output that `prepare` and `publish` share: both make layers of every cell of a map."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

from shmmap.cli.options import add_unit_options, at_least
from shmmap.cli.screens.output import print_line

if TYPE_CHECKING:
    from shmmap.origin.catalogue import MapOrigin
    from shmmap.prepare.run import Failure

__all__ = [
    "add_map_options",
    "failure_rows",
    "origin_at",
    "print_failures",
    "refuse_map_options",
    "worker_count",
]

_SHOWN_FAILURES: Final = 20


def add_map_options(parser: argparse.ArgumentParser) -> None:
    """Add how the map is read, and by how many processes."""
    parser.add_argument("--metadata", metavar="FILE", help="metadata YAML, if it is not with the map")
    parser.add_argument(
        "--strict", action="store_true", help="accept only what Autoware's own loader accepts"
    )
    add_unit_options(parser)
    parser.add_argument(
        "--workers",
        metavar="N",
        type=at_least(0),
        default=0,
        help="number of processes (default: one for each core)",
    )


def refuse_map_options(args: argparse.Namespace, what: str, others: Sequence[str] = ()) -> None:
    """Refuse options about reading files, and ``others``, where no file is read; ``what`` says why."""
    from shmmap.errors import BadRequest

    for option in ("metadata", "strict", "unit", "vertical_unit", *others):
        if getattr(args, option):
            raise BadRequest(f"--{option.replace('_', '-')} does not go with {what}")


def origin_at(args: argparse.Namespace, cache_dir: str) -> MapOrigin:
    """Return the map at ``args.map_path``, to be read as the options say."""
    from shmmap.dividing.served_cloud import find_origin

    return find_origin(
        args.map_path,
        metadata=args.metadata or "",
        strict=args.strict,
        cache_dir=cache_dir,
        unit=args.unit or "",
        vertical_unit=args.vertical_unit or "",
    )


def worker_count(args: argparse.Namespace) -> int:
    """Return the number of processes that the options ask for."""
    import os

    return args.workers or len(os.sched_getaffinity(0))


def failure_rows(failures: Sequence[Failure]) -> list[dict[str, str]]:
    """Return layers that could not be made, for JSON."""
    return [{"id": one.cell_id, "layer": one.layer, "message": one.message} for one in failures]


def print_failures(failures: Sequence[Failure]) -> None:
    """Print layers that could not be made; of many, only the first."""
    for failure in failures[:_SHOWN_FAILURES]:
        print_line(f"failed: {failure.cell_id} ({failure.layer}): {failure.message}")
    if len(failures) > _SHOWN_FAILURES:
        print_line(f"failed: {len(failures) - _SHOWN_FAILURES:,} more")
