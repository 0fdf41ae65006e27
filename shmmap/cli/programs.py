# SPDX-License-Identifier: Apache-2.0
"""What other programs may take from ``shmmap``'s command line, so that theirs is answered in the same way.

The rest of `shmmap.cli` may change at any time; these names, their parameters and what they do stay.

`Parser`
    An `argparse.ArgumentParser` that complains as ``shmmap`` does and knows no abbreviations.
`add_verb`
    A verb's parser; texts of several lines are shown as they are written.
`add_daemon_options`, `add_json_option`
    ``--instance --endpoint --runtime-dir --shm-dir --timeout``: which daemon; ``--json``.
`connect`
    A `shmmap.Client` of the daemon that those options, or ``SHMMAP_*`` variables, name.
`at_least`, `seconds`, `output_file`
    Types of options: whole numbers, durations, files to be written (refused at once where they cannot be).
`write_text`, `writing_errors`
    Write a file; `shmmap.errors.CannotWrite` where it cannot be.
`print_json`, `print_line`, `printable`
    One JSON document; a line of text, and text, with nothing in it that a terminal would obey.
`complain`
    Says on stderr what is wrong, and a hint.
`add_allow_empty`, `nothing_found`
    ``--allow-empty``; says that nothing was found, and returns the exit code.
`join_negative_values`
    Words in which ``--pose -5,3`` is one option, for `argparse`.
`exit_code_of`
    Run a program: errors go to stderr, with a hint, and become exit codes.
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
    writing_errors,
)
from shmmap.cli.screens.output import print_json, print_line, printable

__all__ = [
    "Parser",
    "add_allow_empty",
    "add_daemon_options",
    "add_json_option",
    "add_verb",
    "at_least",
    "complain",
    "connect",
    "exit_code_of",
    "join_negative_values",
    "nothing_found",
    "output_file",
    "print_json",
    "print_line",
    "printable",
    "seconds",
    "write_text",
    "writing_errors",
]
