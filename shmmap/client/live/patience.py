# SPDX-License-Identifier: Apache-2.0
"""Asking again while the process that keeps live maps is started anew."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final, TypeVar

from shmmap.errors import LiveInterrupted

__all__ = ["PAUSE_S", "until_served"]

R = TypeVar("R")

PAUSE_S: Final = 0.05
"""Between two tries: nothing tells when it is there again."""


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
