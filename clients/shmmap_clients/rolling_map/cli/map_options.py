# SPDX-License-Identifier: Apache-2.0
"""Options that say which points count and what is shown; they count before the parameter file."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Final

from shmmap import BadRequest, ConfigError
from shmmap_clients.command_line import complain, finite, not_negative, positive

if TYPE_CHECKING:
    from shmmap import ScanFilter
    from shmmap_clients.rolling_map.parameters import Parameters, Shown

__all__ = [
    "add_filter_options",
    "add_params_option",
    "add_show_option",
    "parameters_from",
    "scan_filter_from",
    "shown_from",
]

Parser = argparse.ArgumentParser | argparse._ArgumentGroup

_PARTS: Final = ("occupied", "free", "chunks", "usage")
_LIMITS: Final = ("min_range", "max_range", "min_z", "max_z")


def add_params_option(parser: Parser) -> None:
    """Add ``--params``."""
    parser.add_argument(
        "--params",
        metavar="FILE",
        help="Rolling-Bonxai's parameter file (YAML, version 1): ranges, z band, and what is shown; what it"
        " says of the map must be as the map is (see `shmmap-rolling config`)",
    )


def add_filter_options(parser: argparse.ArgumentParser) -> None:
    """Add the limits of the points that count."""
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


def add_show_option(parser: Parser) -> None:
    """Add ``--show``."""
    parser.add_argument(
        "--show",
        type=_parts,
        metavar="LIST",
        help="what the picture shows, of occupied,free,chunks,usage with commas between them; usage: active"
        " cells and bytes, in the lines of progress, too (default: as --params says, else"
        " occupied,chunks,usage)",
    )


def _parts(text: str) -> frozenset[str]:
    parts = frozenset(text.split(","))
    if not parts <= set(_PARTS):
        raise argparse.ArgumentTypeError(f"expected some of {','.join(_PARTS)}, not {text!r}")
    return parts


def parameters_from(args: argparse.Namespace) -> Parameters | None:
    """Read the parameter file, if one is given, and say what of it has no effect."""
    if args.params is None:
        return None
    from shmmap_clients.rolling_map.parameters import read_parameters

    parameters = read_parameters(args.params)
    if parameters.warning:
        complain("shmmap-rolling", f"warning: {args.params}: {parameters.warning}")
    return parameters


def scan_filter_from(args: argparse.Namespace, parameters: Parameters | None) -> ScanFilter:
    """Return which points count.

    Raises
    ------
    BadRequest
        The options leave no point.
    """
    import msgspec

    from shmmap import ScanFilter

    base = parameters.scan_filter if parameters is not None else ScanFilter()
    given = {name: getattr(args, name) for name in _LIMITS if getattr(args, name) is not None}
    try:
        return ScanFilter(**{**msgspec.structs.asdict(base), **given})
    except ConfigError as error:
        said = error.message
        for name in _LIMITS:
            said = said.replace(f"{name} = ", f"--{name.replace('_', '-')} ")
        raise BadRequest(said) from None


def shown_from(args: argparse.Namespace, parameters: Parameters | None) -> Shown:
    """Return what is shown."""
    from shmmap_clients.rolling_map.parameters import Shown

    if args.show is not None:
        return Shown(*(part in args.show for part in _PARTS))
    return parameters.shown if parameters is not None else Shown(usage=True)
