# SPDX-License-Identifier: Apache-2.0
"""The command line: related verbs share a module, which imports what a verb needs when the verb runs."""

from __future__ import annotations

import _signal as signal  # type: ignore[import-not-found]  # `signal` takes 2 ms to import
import sys
from typing import TYPE_CHECKING, NoReturn

if TYPE_CHECKING:
    from collections.abc import Sequence


def main(argv: Sequence[str] | None = None) -> int:
    """Run a verb of ``shmmap`` and return the exit code.

    Parameters
    ----------
    argv
        Words after the program's name; by default the arguments of this process, which then ends here.
    """
    if argv is None:
        _run(sys.argv[1:])
    from shmmap.cli.entry import main as run_verb

    return run_verb(argv)


def serve_main() -> NoReturn:
    """Run ``shmmapd``, the same as ``shmmap serve``."""
    _run(["serve", *sys.argv[1:]])


def _run(words: Sequence[str]) -> NoReturn:
    """Run a verb as this process; see `shmmap.processes.request_threads.leave`."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # until the verb runs: an import would print a traceback
    from shmmap.cli.entry import main as run_verb

    try:
        code: object = run_verb(words)
    except SystemExit as ended:
        code = ended.code or 0
    if (threads := sys.modules.get("shmmap.processes.request_threads")) is not None:
        threads.leave(code)
    sys.exit(code)  # type: ignore[arg-type]
