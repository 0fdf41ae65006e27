# SPDX-License-Identifier: Apache-2.0
"""One thing that was looked at."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

__all__ = ["Finding", "State", "fail", "ok", "skip", "warn", "worst"]

State = Literal["ok", "warn", "fail"]
_SEVERITY: Final[dict[State, int]] = {"ok": 0, "warn": 1, "fail": 2}


@dataclass(frozen=True, slots=True)
class Finding:
    """What was found, and what to do about it.

    Attributes
    ----------
    name
        What was looked at.
    state
        ``ok``; ``warn`` for what may hurt later; ``fail`` for what hinders somebody now.
    fact
        What is so.
    advice
        What to do; empty where nothing has to be done.
    skipped
        It could not be looked at, and nothing is wrong with that; ``state`` is ``ok`` then.
    """

    name: str
    state: State
    fact: str
    advice: str = ""
    skipped: bool = False


def skip(name: str, fact: str) -> Finding:
    """Return that there was nothing to look at."""
    return Finding(name, "ok", fact, skipped=True)


def ok(name: str, fact: str, advice: str = "") -> Finding:
    """Return a finding that needs nothing; ``advice`` may still point at something better."""
    return Finding(name, "ok", fact, advice)


def warn(name: str, fact: str, advice: str) -> Finding:
    """Return a finding that may hurt later."""
    return Finding(name, "warn", fact, advice)


def fail(name: str, fact: str, advice: str) -> Finding:
    """Return a finding that hinders somebody now."""
    return Finding(name, "fail", fact, advice)


def worst(findings: list[Finding]) -> State:
    """Return the most severe state among findings."""
    return max((one.state for one in findings), key=_SEVERITY.__getitem__, default="ok")
