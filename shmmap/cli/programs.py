# SPDX-License-Identifier: Apache-2.0
"""Names of the command line for other programs, so that their options and messages look alike.

These names, their parameters and their behaviour are stable; the rest of `shmmap.cli` may change at any time.

`Parser`
    An `argparse.ArgumentParser` with the error messages of ``shmmap``, and without abbreviations.
`add_verb`
    Add a verb's parser; texts of several lines are printed as written.
`add_daemon_options`, `add_json_option`
    Add ``--instance --endpoint --runtime-dir --shm-dir --timeout``, which select a daemon; add ``--json``.
`connect`
    Return a `shmmap.Client` of the daemon selected by those options or by ``SHMMAP_*`` variables.
`at_least`, `seconds`, `output_file`
    Types of options: whole numbers, durations, output files (refused at once if not writable).
`write_text`, `open_output`, `writing_errors`
    Write a file, or open one, not through another account's link; raise `shmmap.errors.CannotWrite` if that
    fails.
`counted`, `format_bytes`
    Return ``"1,200 points"`` or ``"4.1 MiB"``, as all screens have it.
`print_json`, `print_line`, `printable`
    Print a JSON document or a line, or return text, with control codes for terminals escaped.
`complain`
    Print an error and a hint on stderr.
`add_allow_empty`, `nothing_found`
    Add ``--allow-empty``; report that nothing was found and return the exit code.
`join_negative_values`
    Return the words of a command line with ``--pose -5,3`` joined to one word, for `argparse`.
`exit_code_of`
    Run a program; print errors with a hint on stderr and return the exit code.
"""

from __future__ import annotations

from shmmap.cli.daemon_address import connect
from shmmap.cli.options import add_daemon_options, add_json_option, add_verb, at_least, seconds
from shmmap.cli.program import (
    Parser,
    add_allow_empty,
    complain,
    exit_code_of,
    join_negative_values,
    nothing_found,
    output_file,
    write_text,
)
from shmmap.cli.screens.output import counted, format_bytes, print_json, print_line, printable
from shmmap.formats.durable_file import writing_errors
from shmmap.private_directory import open_output

__all__ = [
    "Parser",
    "add_allow_empty",
    "add_daemon_options",
    "add_json_option",
    "add_verb",
    "at_least",
    "complain",
    "connect",
    "counted",
    "exit_code_of",
    "format_bytes",
    "join_negative_values",
    "nothing_found",
    "open_output",
    "output_file",
    "print_json",
    "print_line",
    "printable",
    "seconds",
    "write_text",
    "writing_errors",
]
