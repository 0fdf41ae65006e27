# SPDX-License-Identifier: Apache-2.0
"""The reason why a request about a live map gets no answer, as far as the daemon knows it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from shmmap.errors import NoAnswer, ShmmapError
from shmmap.protocol.live import LiveListed

PROBLEM_S: Final = 1.0
"""Time for the daemon to say why it has not answered."""


def with_problem(error: NoAnswer, name: str, ask: Callable[[], LiveListed]) -> NoAnswer:
    """Return the error, or one that names the problem that a live map has at present.

    Parameters
    ----------
    ask
        Asks the daemon for the state of its live maps.
    """
    try:
        rows = ask().maps
    except ShmmapError:
        return error
    problem = next((row.problem for row in rows if row.name == name), "")
    if not problem:
        return error
    return NoAnswer(
        f"live map {name} waits: {problem}",
        hint="it goes on when that is mended; `shmmap live ls` shows it, what was applied stays in memory",
    )
