# SPDX-License-Identifier: Apache-2.0
"""A limit for loops that ask until something has happened: a defect fails one test, not the whole run."""

from __future__ import annotations

import time

LIMIT_S = 240.0


class Patience:
    """``while waiting(not_yet): ask()``, with ``waiting = Patience()`` before the loop."""

    def __init__(self) -> None:
        self._end_s = time.monotonic() + LIMIT_S

    def __call__(self, not_yet: bool) -> bool:
        """Return ``not_yet``; AssertionError once that has been so for too long."""
        assert not not_yet or time.monotonic() < self._end_s, f"it did not happen within {LIMIT_S:.0f} s"
        return not_yet
