# SPDX-License-Identifier: Apache-2.0
"""`shmmap.aio` is `shmmap` for asyncio: the same names, parameters and words, each of them described."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable
from typing import Any

import pytest

import shmmap
import shmmap.aio
from shmmap.events import EventStream

PAIRS: list[tuple[Any, Any]] = [
    (shmmap.aio.Client, shmmap.Client),
    (shmmap.aio.MapWindow, shmmap.MapWindow),
    (shmmap.aio.EventStream, EventStream),
]
THREADS = {"futures", "live", "shutdown", "client", "next", "path", "descriptor"}
"""Names that only the client for threads has."""
LOOPS = {"loop", "check_loop", "call", "run"}
"""Names that only the client for asyncio has, for its windows."""
WORDS_OF_ITS_OWN = {"close", "move_to", "wait_until_current"}
"""Methods that do something else in an event loop, and say so."""


def public(kind: type) -> dict[str, Any]:
    """Return the methods and properties of a class by their names."""
    return {name: inspect.getattr_static(kind, name) for name in dir(kind) if not name.startswith("_")}


@pytest.mark.parametrize(("ours", "theirs"), PAIRS)
def test_methods_have_the_parameters_and_the_words_of_those_of_their_names(ours: type, theirs: type) -> None:
    mine, there = public(ours), public(theirs)
    assert there.keys() - mine.keys() <= THREADS
    assert mine.keys() - there.keys() <= LOOPS
    for name in mine.keys() & there.keys():
        if inspect.isfunction(mine[name]):
            assert inspect.signature(mine[name]) == inspect.signature(there[name]), name
        if name not in WORDS_OF_ITS_OWN:
            assert inspect.getdoc(mine[name]) == inspect.getdoc(there[name]), name


def test_requests_are_coroutines() -> None:
    for name in ("around", "area", "points_around", "differential", "selected", "metadata", "stats", "close"):
        assert inspect.iscoroutinefunction(getattr(shmmap.aio.Client, name)), name


def parameters(function: Callable[..., Any], *without: str) -> dict[str, inspect.Parameter]:
    """Return the parameters of a function, as they are compared."""
    found = inspect.signature(function).parameters
    return {name: one for name, one in found.items() if name not in without}


@pytest.mark.parametrize(
    ("ours", "theirs", "without"),
    [
        (shmmap.aio.connect, shmmap.connect, ()),
        (shmmap.aio.EventStream, EventStream, ()),
        # a window is of a client; what has no thread has no other mode
        (shmmap.aio.MapWindow, shmmap.MapWindow, ("client", "background", "name", "instance")),
    ],
)
def test_what_makes_them_has_the_same_parameters(ours: Any, theirs: Any, without: tuple[str, ...]) -> None:
    assert parameters(ours, *without) == parameters(theirs, *without)


@pytest.mark.parametrize("kind", [one for pair in PAIRS for one in pair])
def test_a_list_of_parameters_is_whole(kind: type) -> None:
    """Or it names the method that has the others; every method has a docstring."""
    for name, value in public(kind).items():
        text = inspect.getdoc(value)
        assert text, name
        section = re.search(r"^Parameters\n-+\n(.*?)(?=^\w+\n-+$|\Z)", text, re.MULTILINE | re.DOTALL)
        if section is None or re.search(r"Other\s+parameters(?: and errors)? are those of `", text):
            continue
        rows = re.findall(r"^(\S.*)$", section[1], re.MULTILINE)
        described = [word.strip() for row in rows for word in row.split(",")]
        assert described == list(inspect.signature(value).parameters)[1:], name
