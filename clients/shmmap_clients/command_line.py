# SPDX-License-Identifier: Apache-2.0
"""What the programs' command lines share: verbs, options, how errors are answered."""

from __future__ import annotations

import argparse
import json
import os
import re
import sys
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Final, Protocol

from shmmap import InternalError, ShmmapError
from shmmap.cli.parser import Parser

if TYPE_CHECKING:
    from shmmap import Client

__all__ = [
    "Verb",
    "add_daemon_options",
    "add_json_option",
    "add_scan_option",
    "connect",
    "numbers",
    "print_json",
    "run_command",
    "run_program",
]

_EXIT_INTERRUPTED: Final = 130
_EXIT_BROKEN_PIPE: Final = 141
_NEGATIVE_NUMBERS: Final = re.compile(r"-[\d.][\d.eE+,\-]*")


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


def print_json(value: object) -> None:
    """Print one JSON document; a number JSON cannot hold (NaN, infinity) is a defect."""
    indent = 2 if sys.stdout.isatty() else None
    json.dump(value, sys.stdout, indent=indent, allow_nan=False, ensure_ascii=False)
    sys.stdout.write("\n")


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
    try:
        args = parser.parse_args(_joined(sys.argv[1:] if argv is None else argv))
        code: int = args.run(args)
        sys.stdout.flush()
    except ShmmapError as error:
        _complain(name, error.message, error.hint)
        return error.exit_code
    except BrokenPipeError:
        # the interpreter flushes stdout once more at exit: let that go nowhere
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return _EXIT_BROKEN_PIPE
    except KeyboardInterrupt:
        return _EXIT_INTERRUPTED
    except Exception as error:  # noqa: BLE001
        import traceback

        traceback.print_exc()
        _complain(name, f"internal error: {type(error).__name__}: {error}", "please report the lines above")
        return InternalError.exit_code
    return code


def _joined(words: Sequence[str]) -> list[str]:
    """Write ``--guess -5,3,...`` as ``--guess=-5,3,...``: argparse takes it for an option else."""
    joined: list[str] = []
    for word in words:
        if joined and joined[-1].startswith("--") and _NEGATIVE_NUMBERS.fullmatch(word):
            joined[-1] = f"{joined[-1]}={word}"
        else:
            joined.append(word)
    return joined


def _complain(name: str, message: str, hint: str) -> None:
    print(f"{name}: {message}", file=sys.stderr)
    if hint:
        print(f"hint: {hint}", file=sys.stderr)
