# SPDX-License-Identifier: Apache-2.0
"""What the programs' command lines share: verbs, options, how errors are answered."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Protocol

from shmmap.cli.files import output_file, write_text, writing_errors
from shmmap.cli.options import at_least, seconds
from shmmap.cli.program import Parser, exit_code_of, join_negative_values
from shmmap.cli.screens.output import print_json

if TYPE_CHECKING:
    from shmmap import Client

__all__ = [
    "Verb",
    "add_daemon_options",
    "add_json_option",
    "add_scan_option",
    "at_least",
    "connect",
    "numbers",
    "output_file",
    "positive",
    "print_json",
    "run_command",
    "run_program",
    "seconds",
    "write_text",
    "writing_errors",
]


class Verb(Protocol):
    """A module with one verb of a program."""

    def add_parser(self, subparsers: Any) -> None:
        """Add the verb's parser, with ``run`` as a default."""


def numbers(count: int) -> Callable[[str], tuple[float, ...]]:
    """Return an argparse type: ``count`` finite numbers with commas between them."""

    def parse(text: str) -> tuple[float, ...]:
        try:
            values = tuple(float(word) for word in text.split(","))
        except ValueError:
            values = ()
        if len(values) != count or not all(abs(value) < float("inf") for value in values):
            raise argparse.ArgumentTypeError(f"{count} numbers with commas between them, not {text!r}")
        return values

    return parse


def positive(text: str) -> float:
    """Read a positive and finite number."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"expected a positive number, not {text!r}")
    return value


def add_daemon_options(parser: argparse.ArgumentParser) -> None:
    """Add what finds the daemon; see `connect`."""
    group = parser.add_argument_group("which daemon")
    group.add_argument(
        "--endpoint", metavar="PATH", help="request socket, a path or an ipc:// URL (default: as for shmmap)"
    )
    group.add_argument(
        "--shm-dir", metavar="DIR", help="directory of the segments (default: where the daemon says)"
    )


def connect(args: argparse.Namespace, name: str) -> Client:
    """Open a session with the daemon that the options name."""
    import shmmap

    return shmmap.connect(args.endpoint, name=name, shm_dir=args.shm_dir)


def add_scan_option(parser: argparse.ArgumentParser) -> None:
    """Add ``--scan``, a file as `shmmap_clients.scans.scan_file` reads it."""
    parser.add_argument("--scan", required=True, metavar="FILE", help="PCD, NPZ (xyz or xyz_4mm), KITTI .bin")


def add_json_option(parser: argparse.ArgumentParser | argparse._ArgumentGroup) -> None:
    """Add ``--json``."""
    parser.add_argument("--json", action="store_true", help="print one JSON document")


def run_program(name: str, description: str, verbs: Sequence[Any], argv: Sequence[str] | None = None) -> int:
    """Run a verb of a program; returns the exit code, as ``shmmap`` itself has them.

    Parameters
    ----------
    name, description
        For the help.
    verbs
        Modules as in `Verb`.
    argv
        Words after the program's name; those of this process by default.
    """
    parser = Parser(prog=name, description=description)
    subparsers = parser.add_subparsers(title="verbs", metavar="VERB", required=True, parser_class=Parser)
    for verb in verbs:
        verb.add_parser(subparsers)
    return _guarded(name, parser, argv)


def run_command(
    name: str,
    description: str,
    add_options: Callable[[argparse.ArgumentParser], None],
    run: Callable[[argparse.Namespace], int],
    argv: Sequence[str] | None = None,
    *,
    epilog: str = "",
) -> int:
    """Run a program that has no verbs; returns the exit code.

    Parameters
    ----------
    name, description, epilog
        For the help.
    add_options
        Adds the options to a parser.
    run
        Does the work.
    argv
        Words after the program's name; those of this process by default.
    """
    parser = Parser(prog=name, description=description, epilog=epilog)
    add_options(parser)
    parser.set_defaults(run=run)
    return _guarded(name, parser, argv)


def _guarded(name: str, parser: argparse.ArgumentParser, argv: Sequence[str] | None) -> int:
    def run() -> int:
        args = parser.parse_args(join_negative_values(sys.argv[1:] if argv is None else argv))
        code: int = args.run(args)
        return code

    return exit_code_of(name, run)
