# SPDX-License-Identifier: Apache-2.0
"""Where the programs ``shmmap`` and ``shmmapd`` start, and what becomes of their errors.

Exit codes: 0 done, 1 negative answer, 2 wrong usage, 65 bad data, 66 no map there, 69 no daemon
answers, 70 internal error, 71 the daemon cannot start now, 73 an output cannot be written, 75 instance
taken, 76 protocol mismatch, 78 bad configuration, 130 interrupted, 141 the reader of our output went away.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from shmmap.cli.parser import NUMBER_OPTIONS, build_parser, verb_first
from shmmap.cli.program import exit_code_of, join_negative_values
from shmmap.errors import BadRequest
from shmmap.lazy_imports import needed_packages

__all__ = ["main", "serve_main"]


def main(argv: Sequence[str] | None = None) -> int:
    """Run one verb and return the exit code.

    Parameters
    ----------
    argv
        Words after the program's name; those of this process by default.
    """
    words = join_negative_values(verb_first(sys.argv[1:] if argv is None else argv), NUMBER_OPTIONS)

    def run() -> int:
        if not words:
            build_parser().print_help(sys.stderr)
            return BadRequest.exit_code
        args = build_parser(words).parse_args(words)
        with needed_packages(f"shmmap {words[0]}"):
            code: int = args.run(args)
        return code

    return exit_code_of("shmmap", run)


def serve_main() -> int:
    """Run ``shmmapd``, which is ``shmmap serve``."""
    return main(["serve", *sys.argv[1:]])
