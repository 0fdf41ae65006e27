# SPDX-License-Identifier: Apache-2.0
"""Common parts of running the programs: verbs, errors, exit codes, progress.

Exit codes are those of ``shmmap``: 0 done; 1 a negative answer, or nothing found; 2 wrong usage; 65 bad data;
66 no such file or map; 69 no daemon answers, or a package is missing; 70 internal error; 73 an output
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
    counted,
    exit_code_of,
    format_bytes,
    join_negative_values,
    nothing_found,
    open_output,
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
    "counted",
    "finite",
    "format_bytes",
    "not_negative",
    "nothing_found",
    "open_output",
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
    """Run a verb of a program and return the exit code, with the codes of ``shmmap``.

    Parameters
    ----------
    name, description
        Texts of the help.
    add_verbs
        Functions that each add the parser of a verb, with ``run`` as a default, to the subparsers.
    argv
        Arguments after the program's name; by default those of this process.
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
    """Run a program without verbs and return the exit code.

    Parameters
    ----------
    name, description, epilog
        Texts of the help; the epilog is shown verbatim.
    add_options
        Adds the options to a parser.
    run
        Runs the program with the parsed options.
    argv
        Arguments after the program's name; by default those of this process.
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
    """Make SIGTERM, and SIGHUP unless ignored, end a program with cleanup, as Ctrl-C does.

    Yields a list to which the signal is added.  A second signal ends the process at once.
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
            if signal.getsignal(number) is end:  # no other handler has been installed since
                signal.signal(number, signal.SIG_DFL)


def positive(text: str) -> float:
    """Parse a positive, finite number."""
    value = _number(text)
    if not 0.0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"expected a positive number, not {text!r}")
    return value


def not_negative(text: str) -> float:
    """Parse a finite number that is not negative."""
    value = _number(text)
    if not 0.0 <= value < math.inf:
        raise argparse.ArgumentTypeError(f"expected a number, 0 or more, not {text!r}")
    return value


def finite(text: str) -> float:
    """Parse a finite number."""
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
    """Progress of a program on stderr.

    Parameters
    ----------
    quiet
        Whether to show nothing.
    written_over
        Whether each text overwrites the one before, as on a terminal; else each text is a line.
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
        """Show a progress text."""
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
        """End the line, so that the next text begins a new one."""
        if self._shown:
            sys.stderr.write("\n")
            self._shown = ""
