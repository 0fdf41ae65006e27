# SPDX-License-Identifier: Apache-2.0
"""Where the programs ``shmmap`` and ``shmmapd`` start, and what becomes of their errors.

Exit codes: 0 done, 1 negative answer, 2 wrong usage, 65 bad data, 66 no map there, 69 no daemon
answers, 70 internal error, 73 an output cannot be written, 75 instance taken, 76 protocol mismatch,
78 bad configuration, 130 interrupted, 141 the reader of our output went away.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from typing import Final

from shmmap.cli.parser import build_parser, join_negative_values, verb_first
from shmmap.errors import InternalError, ShmmapError

__all__ = ["main", "serve_main"]

EXIT_INTERRUPTED: Final = 130  # 128 + SIGINT, as shells report it
EXIT_BROKEN_PIPE: Final = 141  # 128 + SIGPIPE


def main(argv: Sequence[str] | None = None) -> int:
    """Run one verb and return the exit code.

    Parameters
    ----------
    argv
        Words after the program's name; those of this process by default.
    """
    words = join_negative_values(verb_first(sys.argv[1:] if argv is None else argv))
    try:
        args = build_parser(words).parse_args(words)
        code: int = args.run(args)
        sys.stdout.flush()
    except ShmmapError as error:
        _complain(error.message, error.hint)
        return error.exit_code
    except BrokenPipeError:
        # the interpreter flushes stdout once more at exit: let that go nowhere
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_BROKEN_PIPE
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    except Exception as error:  # noqa: BLE001
        import traceback

        traceback.print_exc()
        _complain(
            f"internal error: {type(error).__name__}: {error}",
            "this is a defect in shmmap: please report it with the lines above",
        )
        return InternalError.exit_code
    return code


def serve_main() -> int:
    """Run ``shmmapd``, which is ``shmmap serve``."""
    return main(["serve", *sys.argv[1:]])


def _complain(message: str, hint: str) -> None:
    print(f"shmmap: {message}", file=sys.stderr)
    if hint:
        print(f"hint: {hint}", file=sys.stderr)
