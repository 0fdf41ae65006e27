# SPDX-License-Identifier: Apache-2.0
"""How long requests about live maps may take; asking again while the process that keeps them is started."""

from __future__ import annotations

import numbers
import threading
import time
from collections.abc import Callable
from typing import Final, TypeVar

from shmmap.errors import BadRequest, LiveInterrupted

__all__ = ["PAUSE_S", "checked_seconds", "until_served"]

R = TypeVar("R")

PAUSE_S: Final = 0.05
"""Between two tries: nothing tells when it is there again."""


def checked_seconds(what: str, seconds: object) -> float:
    """Return a time that may be waited for; BadRequest where there is none of that length."""
    if not isinstance(seconds, numbers.Real) or not 0 <= float(seconds) <= threading.TIMEOUT_MAX:  # nor NaN
        raise BadRequest(f"{what} must be a number of seconds, 0 or more, not {seconds!r}")
    return float(seconds)


def until_served(ask: Callable[[], R], timeout_s: float) -> R:
    """Ask until there is somebody to answer; `LiveInterrupted` when nobody was for so many seconds."""
    end_s = time.monotonic() + timeout_s
    while True:
        try:
            return ask()
        except LiveInterrupted:  # noqa: PERF203  that is what it is for
            if time.monotonic() >= end_s:
                raise
            time.sleep(PAUSE_S)
