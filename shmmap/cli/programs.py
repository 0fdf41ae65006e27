# SPDX-License-Identifier: Apache-2.0
"""What other programs may take from ``shmmap``'s command line, so that theirs is answered in the same way.

The rest of `shmmap.cli` may change at any time; these names, their parameters and what they do stay.

================== ====================================================================================
Parser             an `argparse.ArgumentParser` that complains as ``shmmap`` does, and knows no abbreviations
add_verb           a verb's parser; texts of several lines are shown as they are written
join_negative_values  words in which ``--pose -5,3`` is one option
exit_code_of       runs a program; errors go to stderr, with a hint, and become exit codes
add_daemon_options ``--instance --endpoint --runtime-dir --shm-dir --timeout``: which daemon
add_json_option    ``--json``
connect            a `shmmap.Client` of the daemon that those options, or ``SHMMAP_*`` variables, name
at_least, seconds  types of options: whole numbers, durations
output_file        type of an option: a file to be written, refused at once where it cannot be
write_text, writing_errors  write a file; `shmmap.CannotWrite` where it cannot be
print_json         prints one JSON document
================== ====================================================================================
"""

from __future__ import annotations

from shmmap.cli.daemon_address import connect
from shmmap.cli.files import output_file, write_text, writing_errors
from shmmap.cli.options import add_daemon_options, add_json_option, add_verb, at_least, seconds
from shmmap.cli.program import Parser, exit_code_of, join_negative_values
from shmmap.cli.screens.output import print_json

__all__ = [
    "Parser",
    "add_daemon_options",
    "add_json_option",
    "add_verb",
    "at_least",
    "connect",
    "exit_code_of",
    "join_negative_values",
    "output_file",
    "print_json",
    "seconds",
    "write_text",
    "writing_errors",
]
