# SPDX-License-Identifier: Apache-2.0
"""The grammar of the command line: every verb, and how wrong usage is answered."""

from __future__ import annotations

import argparse
import importlib
import re
import sys
from collections.abc import Iterable, Sequence
from typing import Any, Final, NoReturn

from shmmap.cli.version import installed_version

__all__ = ["VERBS", "Parser", "build_parser", "join_negative_values", "verb_first"]

VERBS: Final = {
    "demo": "demo",
    "divide": "divide",
    "merge": "merge",
    "prepare": "prepare",
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
    "health": "health",
    "version": "version",
}
"""Modules by verb, in the order of the help; one is imported when its verb is used, all for the help."""

_OWN_OPTIONS: Final = frozenset({"--help", "--version"})
_FLAGS: Final = frozenset({"--json"})  # common options without a value
_NUMBER_OPTIONS: Final = frozenset({"--circle", "--square", "--box", "--z", "--origin", "--translate"})
_NEGATIVE_NUMBERS: Final = re.compile(r"-[\d.][\d.eE+,\-]*|-inf(,.*)?")


class Parser(argparse.ArgumentParser):
    """A parser that complains as the rest of the program does: what is wrong, then a hint."""

    def __init__(self, **settings: Any) -> None:
        # an abbreviation that works today would break with tomorrow's options
        super().__init__(**settings, allow_abbrev=False)

    def parse_known_args(  # type: ignore[override]
        self, args: Sequence[str] | None = None, namespace: argparse.Namespace | None = None
    ) -> tuple[argparse.Namespace, list[str]]:
        """Parse, and let each verb refuse what it does not know itself: so the hint names its help."""
        found, unknown = super().parse_known_args(args, namespace)
        if unknown:
            self._refuse(f"unrecognized arguments: {' '.join(unknown)}", unknown[0].split("=")[0])
        return found, unknown

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if isinstance(action, argparse._SubParsersAction) and value not in action.choices:
            self._refuse(f"there is no {str(action.metavar).lower()} {value!r}", str(value), action.choices)
        super()._check_value(action, value)

    def _refuse(self, message: str, word: str, known: Iterable[str] | None = None) -> NoReturn:
        import difflib  # 6 ms, for mistakes alone

        near = difflib.get_close_matches(word, known or self._option_string_actions, n=1)
        self.error(f"{message}; did you mean {near[0]}?" if near else message)

    def error(self, message: str) -> NoReturn:
        print(f"{self.prog}: {message}\nhint: {self.prog} --help", file=sys.stderr)
        sys.exit(2)


def join_negative_values(words: Sequence[str]) -> list[str]:
    """Write ``--circle -5,3,40`` as ``--circle=-5,3,40``.

    argparse takes a word that starts with a minus for an option unless it is a single number.
    """
    joined: list[str] = []
    for word in words:
        if joined and joined[-1] in _NUMBER_OPTIONS and _NEGATIVE_NUMBERS.fullmatch(word):
            joined[-1] = f"{joined[-1]}={word}"
        else:
            joined.append(word)
    return joined


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
        description="Serve a vehicle's point-cloud map to every process of the machine from one copy in "
        "shared memory.",
        epilog="Try `shmmap demo`: it needs no map.  `shmmap VERB --help` explains a verb and its JSON.",
    )
    parser.add_argument("--version", action="version", version=f"shmmap {installed_version()}")
    subparsers = parser.add_subparsers(title="verbs", metavar="VERB", required=True, parser_class=Parser)
    wanted = words[:1] if words and words[0] in VERBS else tuple(VERBS)
    for verb in wanted:
        importlib.import_module(f"shmmap.cli.{VERBS[verb]}").add_parser(subparsers)
    return parser
