# SPDX-License-Identifier: Apache-2.0
"""The grammar of the command line: every verb, and how wrong usage is answered."""

from __future__ import annotations

import argparse
import importlib
from collections.abc import Sequence
from typing import Final

from shmmap.cli.program import Parser
from shmmap.cli.verbs.version import installed_version

__all__ = ["NUMBER_OPTIONS", "VERBS", "build_parser", "verb_first"]

VERBS: Final = {
    "demo": "demo",
    "divide": "divide",
    "merge": "merge",
    "prepare": "prepare",
    "publish": "publish",
    "versions": "versions",
    "fetch": "fetch",
    "live": "live.group",
    "serve": "serve",
    "status": "status",
    "ls": "ls",
    "show": "show",
    "clients": "clients",
    "top": "top",
    "tail": "tail",
    "map": "map_view",
    "metrics": "metrics",
    "query": "query",
    "export": "export",
    "inspect": "inspect",
    "reload": "reload",
    "evict": "evict",
    "pin": "pin",
    "unpin": "unpin",
    "stop": "stop",
    "doctor": "doctor",
    "config": "config",
    "unit": "unit",
    "cpp": "cpp",
    "health": "health",
    "version": "version",
}
"""Modules by verb, in the order of the help; one is imported when its verb is used, all for the help."""

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
  71   the daemon cannot start now: something is full, missing or in its way
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


def verb_first(words: Sequence[str]) -> list[str]:
    """Write ``--endpoint PATH status`` as ``status --endpoint PATH``: the verbs own all options."""
    end = 0
    while end < len(words) and words[end].startswith("--") and words[end] not in _OWN_OPTIONS:
        takes_value = words[end] not in _FLAGS and "=" not in words[end]
        end += 2 if takes_value else 1
    if 0 < end < len(words):
        return [words[end], *words[:end], *words[end + 1 :]]
    return list(words)


def build_parser(words: Sequence[str] = ()) -> argparse.ArgumentParser:
    """Return the parser; the namespace it gives has ``run``, the verb's function.

    Given the words to parse, it knows only the verb they begin with, if there is such a verb.
    """
    parser = Parser(
        prog="shmmap",
        description="Serve a vehicle's point-cloud map to every process of the machine\n"
        "from one copy in shared memory.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"shmmap {installed_version()}")
    subparsers = parser.add_subparsers(title="verbs", metavar="VERB", required=True, parser_class=Parser)
    wanted = words[:1] if words and words[0] in VERBS else tuple(VERBS)
    for verb in wanted:
        importlib.import_module(f"shmmap.cli.verbs.{VERBS[verb]}").add_parser(subparsers)
    return parser
