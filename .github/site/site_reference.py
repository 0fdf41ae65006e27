# SPDX-License-Identifier: Apache-2.0
"""Pages that are made from the code: the API from docstrings, the command line from its own help."""

from __future__ import annotations

import contextlib
import importlib
import inspect
import io
import os
import re
import signal
from collections.abc import Iterator
from typing import Any, Final

from site_contents import API, PROGRAMS, ApiPage
from site_staging import Tree, place, toctree

from shmmap.cli.entry import GROUPS
from shmmap.cli.entry import main as shmmap_main

_COLUMNS: Final = "90"


def add_reference(tree: Tree) -> None:
    """Write the pages of the API and of the command line into a staged tree."""
    pages = [page for page in API if page.described()]
    rows = []
    for page in pages:
        first = page is next(one for one in pages if one.module == page.module)
        tree.write(f"{page.path}.rst", _api_page(page, first=first))
        rows.append(
            f"| [{page.title}]({page.path}.rst) | {' '.join(f'`{name}`' for name in page.described())} |\n"
        )
    table = f"| you want to | `shmmap` has |\n|---|---|\n{''.join(rows)}"
    tree.write("api.md", f"# API\n\n{table}{toctree([page.path for page in pages], 'API')}")
    groups = {f"command-line/{heading.replace(' ', '-')}": heading for heading in GROUPS}
    there = toctree([*groups, "command-line/programs"])
    tree.write(
        "command-line.md", f"# Command line\n\n```text\n{help_text('shmmap', shmmap_main)}```\n{there}"
    )
    for path, heading in groups.items():
        verbs = [_verb("shmmap", verb, shmmap_main) for verb in GROUPS[heading]]
        tree.write(f"{path}.md", f"# shmmap: {heading}\n\n{''.join(verbs)}")
    programs = [_program(name, importlib.import_module(module).main) for name, module in PROGRAMS.items()]
    tree.write("command-line/programs.md", f"# Other programs\n\n{''.join(programs)}")


# --- the API ---------------------------------------------------------------------------------------------


def _api_page(page: ApiPage, *, first: bool) -> str:
    module = importlib.import_module(page.module)
    lines = [page.title, "=" * len(page.title), ""]
    lines += [f"Read first: :doc:`/{place(name).removesuffix('.md')}`\n" for name in page.pages]
    if page.names:
        lines += [f".. {'module' if first else 'currentmodule'}:: {page.module}", ""]
    else:
        lines += [f".. automodule:: {page.module}", "   :no-members:", ""]
    for name in page.described():
        value = getattr(module, name)
        lines += [f".. {_directive(value)}:: {page.module}.{name}", *_inherited(value), ""]
    return "\n".join(lines)


def _directive(value: Any) -> str:
    if inspect.isclass(value):
        return "autoexception" if issubclass(value, BaseException) else "autoclass"
    return "autofunction" if callable(value) and hasattr(value, "__name__") else "autodata"


def _inherited(value: Any) -> list[str]:
    """Return the option by which a class has the members of a base that is described nowhere."""
    bases = value.__mro__[1:] if inspect.isclass(value) else ()
    public = {name for page in API for name in page.described()}
    inner = [one for one in bases if one.__module__.startswith("shmmap") and one.__name__ not in public]
    others = ", ".join(one.__name__ for one in bases if one not in inner)
    return [f"   :inherited-members: {others}"] if inner else []


# --- the command line ------------------------------------------------------------------------------------


def help_text(name: str, main: Any, *words: str) -> str:
    """Return what a program prints for ``--help``.

    Parameters
    ----------
    name, main
        The program, and the function that takes its words.
    words
        A verb, or nothing.

    Raises
    ------
    ValueError
        There is no such verb.
    """
    printed = io.StringIO()
    with _as_before(), contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
        os.environ |= {"COLUMNS": _COLUMNS, "NO_COLOR": "1"}
        main([*words, "--help"])
    text = printed.getvalue()
    if not text.startswith("usage: "):
        raise ValueError(f"{name} {' '.join(words)}: no help")
    return text


@contextlib.contextmanager
def _as_before() -> Iterator[None]:
    """Restore the variables, and the signals that a program takes in hand."""
    variables = dict(os.environ)
    handlers = {one: signal.getsignal(one) for one in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    try:
        yield
    finally:
        os.environ.clear()
        os.environ |= variables
        for number, handler in handlers.items():
            signal.signal(number, handler)


def _verbs(text: str) -> list[str]:
    """Return the verbs that a help lists."""
    listed = text.partition("\n  VERB\n")[2] or text.partition("\n  ACTION\n")[2]
    return re.findall(r"^    ([a-z][\w-]*) ", listed, re.MULTILINE)


def _verb(name: str, verb: str, main: Any, depth: int = 2) -> str:
    text = help_text(name, main, *verb.split())
    section = f"{'#' * depth} {name} {verb}\n\n```text\n{text}```\n\n"
    return section + "".join(_verb(name, f"{verb} {each}", main, depth + 1) for each in _verbs(text))


def _program(name: str, main: Any) -> str:
    text = help_text(name, main)
    section = f"## {name}\n\n```text\n{text}```\n\n"
    return section + "".join(_verb(name, verb, main, 3) for verb in _verbs(text))
