# SPDX-License-Identifier: Apache-2.0
"""Options that several verbs share, and parsers of their values."""

from __future__ import annotations

import argparse
import math
import re
from _thread import TIMEOUT_MAX  # constant of `threading`, which takes 2 ms to import
from collections.abc import Callable
from typing import TypeAlias

from shmmap.errors import ConfigError

# argparse has no public name for this type
Subparsers: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"


def numbers(text: str, names: str) -> list[float]:
    """Parse ``"-5,3,40"`` as numbers, one for each of ``names`` (``"X,Y,R"``)."""
    parts = text.split(",")
    wanted = names.split(",")
    try:
        values = [float(part) for part in parts]
    except ValueError:
        values = []
    if len(values) != len(wanted) or any(math.isnan(value) for value in values):
        raise argparse.ArgumentTypeError(f"expected {len(wanted)} numbers {names}, not {text!r}")
    return values


def number_of(what: str, lowest: float = -math.inf, highest: float = math.inf) -> Callable[[str], float]:
    """Return an argparse type for numbers within these bounds; a message says that ``what`` is expected."""

    def parse(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not lowest <= value <= highest:
            raise argparse.ArgumentTypeError(f"expected {what}, not {text!r}")
        return value

    return parse


seconds = number_of("seconds", 0.0, TIMEOUT_MAX)  # a thread cannot wait longer
metres = number_of("metres")


def at_least(lowest: int) -> Callable[[str], int]:
    """Return an argparse type for whole numbers not below ``lowest``."""

    def parse(text: str) -> int:
        if not re.fullmatch(r"[+-]?\d{1,18}", text) or int(text) < lowest:
            raise argparse.ArgumentTypeError(f"expected a whole number, {lowest} or more, not {text!r}")
        return int(text)

    return parse


def size_bytes(text: str) -> int:
    """Parse a size such as ``512M``; return bytes."""
    from shmmap.config_table import parse_bytes

    try:
        return parse_bytes(text)
    except ConfigError as error:
        raise argparse.ArgumentTypeError(f"{error.message}; {error.hint}") from None


class _Prose(str):
    """Text whose lines are paragraphs: each is wrapped, those after the first with a hanging indent."""


class _HelpFormatter(argparse.RawDescriptionHelpFormatter):
    """Wraps prose and single lines to the terminal's width; of other texts only lines that are too long."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        fill = argparse.HelpFormatter._fill_text
        if isinstance(text, _Prose):
            first, *others = text.splitlines()
            hanging = [fill(self, line, width - 2, indent).replace("\n", "\n  ") for line in others]
            return "\n".join([fill(self, first, width, indent), *hanging])
        return _folded(text, width + 1) if "\n" in text else fill(self, text, width, indent)


def _folded(text: str, width: int) -> str:
    """Fold lines that are too long: indented ones (JSON, commands) hang, others are filled as sentences.

    A sentence that continues on the next line is joined with that line.
    """
    import textwrap

    lines: list[str] = []
    for line in text.splitlines():
        continues = lines and lines[-1][-1:] not in ("", ".", ":") and not lines[-1].startswith(" ")
        if continues and line and not line.startswith(" "):
            lines[-1] += " " + line
        else:
            lines.append(line)
    folded: list[str] = []
    for line in lines:
        words = line.lstrip()
        indent = " " * (len(line) - len(words))
        hanging = indent + "  " if indent else ""
        folded += textwrap.wrap(
            words,
            width,
            initial_indent=indent,
            subsequent_indent=hanging,
            break_long_words=False,
            break_on_hyphens=False,
        ) or [""]
    return "\n".join(folded)


def add_verb(
    subparsers: Subparsers,
    name: str,
    run: Callable[[argparse.Namespace], int],
    *,
    help: str,  # noqa: A002
    description: str,
    json: str = "",
    output: str = "",
    epilog: str = "",
) -> argparse.ArgumentParser:
    """Add the parser of a verb that ``run`` carries out.

    The lines of ``description`` are paragraphs.  ``epilog`` follows the options as written, with long lines
    folded.  The output of ``--json`` is described by the text ``json``, or by ``output``: names of structs as
    in `shmmap.cli.json_output.output_kinds`.
    """
    if json:
        epilog = f"JSON (fields may be added, none is removed):\n{json}"
    if output:
        epilog = f"JSON: --json-schema describes it; fields may be added, none is removed.\n{epilog}".rstrip()
    parser = subparsers.add_parser(
        name,
        help=help,
        description=_Prose(description),
        epilog=epilog,
        formatter_class=_HelpFormatter,
    )
    parser.set_defaults(run=run, **({"json_output": output} if output else {}))
    return parser


def add_json_option(parser: argparse.ArgumentParser) -> None:
    """Add ``--json``, and ``--json-schema`` if the verb names the structs that it prints."""
    parser.add_argument("--json", action="store_true", help="print JSON instead of text")
    if output := parser.get_default("json_output"):
        parser.add_argument(
            "--json-schema",
            action=_PrintSchema,
            nargs=0,
            const=output,
            default=argparse.SUPPRESS,
            help="print the JSON's schema",
        )


class _PrintSchema(argparse.Action):
    """Prints the schema and exits, whatever else is given, as ``--help`` does."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: object,
        option_string: str | None = None,
    ) -> None:
        del namespace, values, option_string
        from shmmap.cli.json_output import json_schema
        from shmmap.cli.screens.output import print_json

        print_json(json_schema(str(self.const)))
        parser.exit()


def add_statistics_options(parser: argparse.ArgumentParser, *, json: bool = True) -> None:
    """Add the options that find a daemon's statistics segment, and ``--json`` unless the verb has none."""
    group = parser.add_argument_group("which daemon to use")
    group.add_argument(
        "--instance", metavar="NAME", help="name of the daemon among several (default: default)"
    )
    group.add_argument(
        "--endpoint",
        metavar="PATH",
        help="request socket, a path or an ipc:// URL (default: SHMMAP_ENDPOINT, unless --instance or "
        "--runtime-dir is given)",
    )
    group.add_argument("--runtime-dir", metavar="DIR", help="directory of the request socket")
    group.add_argument("--shm-dir", metavar="DIR", help="directory of the segments (default: /dev/shm)")
    if json:
        add_json_option(parser)


def add_daemon_options(parser: argparse.ArgumentParser, *, json: bool = True) -> None:
    """Add the options that find a daemon and bound its replies, and ``--json`` unless the verb has none."""
    add_statistics_options(parser, json=json)
    parser.add_argument(
        "--timeout",
        metavar="SECONDS",
        type=seconds,
        help="how long to wait for the daemon (default: 5)",
    )


def add_layer_option(parser: argparse.ArgumentParser, help: str) -> None:  # noqa: A002
    """Add ``--layer``, which may be given several times."""
    parser.add_argument("--layer", metavar="SPEC", nargs="+", action="extend", default=[], help=help)


def layers_from(args: argparse.Namespace) -> list[str]:
    """Return the layers that the options name; ``points`` by default."""
    return args.layer or ["points"]


def add_cloud_options(parser: argparse.ArgumentParser | argparse._ArgumentGroup) -> None:
    """Add options for reading clouds: ``--unit``, ``--vertical-unit`` and ``--drop-noise``."""
    from shmmap.formats.coordinate_system import UNITS

    parser.add_argument(
        "--unit",
        choices=UNITS,
        help="unit of the cloud's coordinates, converted to metres: auto takes what the file says; without "
        "this option, a file that states another unit than metres is refused",
    )
    parser.add_argument(
        "--vertical-unit",
        choices=UNITS,
        help="unit of its heights, where it differs from what --unit and the file say",
    )
    parser.add_argument(
        "--drop-noise",
        action="store_true",
        help="leave out points that a LAS file classifies as noise (classes 7 and 18); those flagged "
        "withheld are always left out",
    )
