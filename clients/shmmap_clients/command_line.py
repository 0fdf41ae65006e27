# SPDX-License-Identifier: Apache-2.0
"""How the programs are run: verbs, errors, exit codes, progress.

Exit codes are those of ``shmmap``: 0 done; 1 a negative answer, or nothing found; 2 wrong usage; 65 bad data;
66 no file or no map there; 69 no daemon answers, or a package is missing; 70 internal error; 73 an output
cannot be written; 75 busy; 130 interrupted, 143 ended by SIGTERM.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import shutil
import signal
import sys
import textwrap
import threading
from collections.abc import Callable, Iterator, Sequence
from types import FrameType
from typing import Any

from shmmap.cli.programs import (
    Parser,
    add_allow_empty,
    add_daemon_options,
    add_json_option,
    add_verb,
    at_least,
    complain,
    connect,
    exit_code_of,
    join_negative_values,
    nothing_found,
    output_file,
    print_json,
    print_line,
    printable,
    seconds,
    write_text,
    writing_errors,
)
from shmmap.layers import needed_packages

__all__ = [
    "ProgressLine",
    "add_allow_empty",
    "add_daemon_options",
    "add_json_option",
    "add_verb",
    "at_least",
    "complain",
    "connect",
    "finite",
    "not_negative",
    "nothing_found",
    "output_file",
    "positive",
    "print_json",
    "print_line",
    "printable",
    "run_command",
    "run_program",
    "seconds",
    "write_text",
    "writing_errors",
]


def run_program(
    name: str, description: str, add_verbs: Sequence[Callable[[Any], None]], argv: Sequence[str] | None = None
) -> int:
    """Run a verb of a program and return the exit code, as ``shmmap`` itself has them.

    Parameters
    ----------
    name, description
        For the help.
    add_verbs
        Each adds the parser of a verb, with ``run`` as a default, to the subparsers.
    argv
        Words after the program's name; those of this process by default.
    """
    parser = Parser(prog=name, description=description)
    subparsers = parser.add_subparsers(title="verbs", metavar="VERB", required=True, parser_class=Parser)
    for add in add_verbs:
        add(subparsers)
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
        For the help; the epilog is shown as it is written.
    add_options
        Adds the options to a parser.
    run
        Does the work.
    argv
        Words after the program's name; those of this process by default.
    """
    parser = Parser(
        prog=name,
        description=textwrap.fill(description, shutil.get_terminal_size().columns - 2),
        epilog=epilog,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_options(parser)
    parser.set_defaults(run=run)
    return _guarded(name, parser, argv)


def _guarded(name: str, parser: argparse.ArgumentParser, argv: Sequence[str] | None) -> int:
    def run() -> int:
        args = parser.parse_args(join_negative_values(sys.argv[1:] if argv is None else argv))
        with needed_packages(name):
            code: int = args.run(args)
        return code

    with _ended_as_interrupted() as ended_by:
        code = exit_code_of(name, run)
    return 128 + ended_by[0] if ended_by else code


@contextlib.contextmanager
def _ended_as_interrupted() -> Iterator[list[int]]:
    """Make SIGTERM, and SIGHUP unless it is ignored, end a program as Ctrl-C does: it cleans up.

    Yields a list that holds the signal then; a second signal ends the process at once.
    """
    ended_by: list[int] = []
    handled: list[signal.Signals] = []

    def end(number: int, _frame: FrameType | None) -> None:
        for one in handled:
            signal.signal(one, signal.SIG_DFL)
        ended_by.append(number)
        raise KeyboardInterrupt

    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGTERM, signal.SIGHUP):
            if signal.getsignal(number) is signal.SIG_DFL:
                signal.signal(number, end)
                handled.append(number)
    try:
        yield ended_by
    finally:
        for number in handled:
            if signal.getsignal(number) is end:  # no other handler was installed since
                signal.signal(number, signal.SIG_DFL)


def positive(text: str) -> float:
    """Read a positive and finite number."""
    value = _number(text)
    if not 0.0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"expected a positive number, not {text!r}")
    return value


def not_negative(text: str) -> float:
    """Read a finite number that is not negative."""
    value = _number(text)
    if not 0.0 <= value < math.inf:
        raise argparse.ArgumentTypeError(f"expected a number, 0 or more, not {text!r}")
    return value


def finite(text: str) -> float:
    """Read a finite number."""
    value = _number(text)
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"expected a number, not {text!r}")
    return value


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


class ProgressLine:
    """What a program is doing, on stderr.

    Parameters
    ----------
    quiet
        Show nothing.
    written_over
        Each text takes the place of the one before, as on a terminal; else each is a line.
    """

    def __init__(self, *, quiet: bool, written_over: bool) -> None:
        self.quiet = quiet
        self.written_over = written_over
        self._shown = ""

    def __enter__(self) -> ProgressLine:
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    def show(self, text: str) -> None:
        """Show what is being done."""
        if self.quiet:
            return
        text = printable(text)
        if self.written_over:
            sys.stderr.write("\r" + text.ljust(len(self._shown)))
            self._shown = text
        else:
            sys.stderr.write(text + "\n")
        sys.stderr.flush()

    def end(self) -> None:
        """End the line, so that the next text begins one."""
        if self._shown:
            sys.stderr.write("\n")
            self._shown = ""
