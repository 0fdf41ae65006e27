# SPDX-License-Identifier: Apache-2.0
"""Verbs of ``shmmap``: all of them, parsing, and errors as exit codes."""

from __future__ import annotations

import _signal as signal  # type: ignore[import-not-found]  # `signal` takes 2 ms to import
import argparse
import importlib
import sys
from collections.abc import Sequence
from typing import Any, Final

from shmmap.cli.program import Parser, exit_code_of, join_negative_values
from shmmap.cli.verbs.run.about import installed_version
from shmmap.errors import BadRequest
from shmmap.lazy_imports import needed_packages

GROUPS: Final = {
    "run a daemon": {
        "demo": "run.demo.add_parser",
        "serve": "run.serve.add_parser",
        "config": "run.config.add_parser",
        "unit": "run.unit.add_parser",
        "stop": "cells.control.add_stop",
        "version": "run.about.add_version",
        "cpp": "run.about.add_cpp",
        "completion": "run.completion.add_completion",
    },
    "look at it": {
        "status": "look.status.add_status",
        "top": "look.top.add_parser",
        "tail": "look.tail.add_parser",
        "ls": "look.cells.add_ls",
        "show": "look.cells.add_show",
        "map": "look.map_view.add_parser",
        "view": "look.view.add_parser",
        "clients": "look.status.add_clients",
        "metrics": "look.monitors.add_metrics",
        "health": "look.monitors.add_health",
        "doctor": "look.monitors.add_doctor",
    },
    "cells": {
        "query": "cells.query.add_parser",
        "export": "cells.export.add_parser",
        "inspect": "cells.inspect.add_parser",
        "pin": "cells.control.add_pin",
        "unpin": "cells.control.add_unpin",
        "evict": "cells.control.add_evict",
        "reload": "cells.control.add_reload",
    },
    "make and publish maps": {
        "divide": "maps.divide.add_divide",
        "merge": "maps.divide.add_merge",
        "prepare": "maps.prepare.add_parser",
        "publish": "maps.publish.add_parser",
        "versions": "maps.versions.add_versions",
        "fetch": "maps.versions.add_fetch",
    },
    "live maps": {"live": "live.add_parser"},
}
"""Functions that add the verbs, in the order of ``--help``; only the verb in use is imported."""
VERBS: Final = {verb: place for verbs in GROUPS.values() for verb, place in verbs.items()}
_HEADINGS: Final = {next(iter(verbs)): heading for heading, verbs in GROUPS.items()}

_EPILOG: Final = """\
Try `shmmap demo`: it needs no map.  `shmmap VERB --help` explains a verb and its JSON.

Exit codes, of every verb:
  0    done
  1    a negative answer: nothing found, a cell failed, not permitted, a `fail` of doctor
  2    wrong usage, or the output exists already
  65   bad data
  66   no such map or file
  69   no daemon answers
  70   internal error: a defect in shmmap
  71   the daemon cannot start now: a required resource is unavailable
  73   an output cannot be written
  75   another process runs this instance, or makes this output; a map's store does not answer
  76   daemon and client speak different protocol versions
  78   a mistake in the settings
  130  interrupted (128 + signal)
  141  the reader of the output went away"""

_OWN_OPTIONS: Final = frozenset({"--help", "--version"})
_FLAGS: Final = frozenset({"--json"})  # common options without a value
NUMBER_OPTIONS: Final = frozenset({"--circle", "--square", "--box", "--z", "--origin", "--translate"})
"""Options whose values may begin with a minus, see `join_negative_values`."""


class _GroupedHelp(argparse.RawDescriptionHelpFormatter):
    """Puts a heading above the first verb of each group, and the help of each verb beside it."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._action_max_length = max(map(len, VERBS)) + 2 * self._indent_increment

    def _format_action(self, action: argparse.Action) -> str:
        text = super()._format_action(action)
        heading = _HEADINGS.get(action.dest)
        return f"{' ' * (self._current_indent - 2)}{heading}:\n{text}" if heading else text


def verb_first(words: Sequence[str]) -> list[str]:
    """Write ``--endpoint PATH status`` as ``status --endpoint PATH``, since options belong to the verbs."""
    end = 0
    while end < len(words) and words[end].startswith("--") and words[end] not in _OWN_OPTIONS:
        takes_value = words[end] not in _FLAGS and "=" not in words[end]
        end += 2 if takes_value else 1
    if 0 < end < len(words):
        return [words[end], *words[:end], *words[end + 1 :]]
    return list(words)


def build_parser(words: Sequence[str] = ()) -> argparse.ArgumentParser:
    """Return the parser; its namespace has ``run``, the function of the verb.

    If ``words`` begin with a verb, the parser has that verb alone, so that the others need not be imported.
    """
    parser = Parser(
        prog="shmmap",
        description="Serve a vehicle's point-cloud map to every process of the machine\n"
        "from one copy in shared memory.",
        epilog=_EPILOG,
        formatter_class=_GroupedHelp,
    )
    parser.add_argument("--version", action="version", version=f"shmmap {installed_version()}")
    subparsers = parser.add_subparsers(title="verbs", metavar="VERB", required=True, parser_class=Parser)
    wanted = words[:1] if words and words[0] in VERBS else tuple(VERBS)
    for verb in wanted:
        module, _, add = VERBS[verb].rpartition(".")
        getattr(importlib.import_module(f"shmmap.cli.verbs.{module}"), add)(subparsers)
    return parser


def main(argv: Sequence[str]) -> int:
    """Run one verb and return the exit code; ``argv`` has the words after the program's name."""
    words = join_negative_values(verb_first(argv), NUMBER_OPTIONS)

    def run() -> int:
        if not words:
            build_parser().print_help(sys.stderr)
            return BadRequest.exit_code
        args = build_parser(words).parse_args(words)
        if signal.getsignal(signal.SIGINT) is signal.SIG_DFL:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        with needed_packages(f"shmmap {words[0]}"):
            code: int = args.run(args)
        return code

    return exit_code_of("shmmap", run)
