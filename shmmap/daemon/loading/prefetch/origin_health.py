# SPDX-License-Identifier: Apache-2.0
"""How long loads take, and whether whatever they read from answers at all; without any I/O."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from typing import Final

__all__ = ["OriginHealth"]

LOADS: Final = 64
"""Loads that the estimate of their time is made of."""
IN_A_ROW: Final = 4
"""So many loads that failed, one after the other, are no matter of single files."""
PROBE_S: Final = 0.5
"""How often it is then tried whether one succeeds."""


@dataclass(eq=False, slots=True)
class OriginHealth:
    """What loads tell of their origin.

    Attributes
    ----------
    failed_in_a_row
        Loads that failed since the last one that succeeded.
    waited_s
        The longest that one of these took, seconds: about how long nothing has answered.
    unreachable
        It is known otherwise that it does not answer.
    slow_s
        Time that few of the last loads exceeded (5 %); 0 before the first.
    """

    failed_in_a_row: int = 0
    waited_s: float = 0.0
    unreachable: bool = False
    slow_s: float = 0.0
    _took_s: deque[float] = field(default_factory=lambda: deque(maxlen=LOADS))
    _tried_s: float = -math.inf

    @property
    def is_out(self) -> bool:
        """Whether nothing can be loaded just now."""
        return self.unreachable or self.failed_in_a_row >= IN_A_ROW

    def next_try_s(self) -> float:
        """Until when nothing is tried; minus infinity unless nothing can be loaded.

        Loads may succeed although the origin does not answer: from the disk.
        """
        return self._tried_s + PROBE_S if self.is_out and self.failed_in_a_row else -math.inf

    def tried(self, now_s: float) -> None:
        """A load begins."""
        self._tried_s = now_s

    def ended(self, took_s: float, *, failed: bool) -> bool:
        """A load ended; whether that tells that loads succeed again, after they did not."""
        if failed:
            self.failed_in_a_row += 1
            self.waited_s = max(self.waited_s, took_s)
            return False
        again, self.failed_in_a_row, self.waited_s = self.is_out, 0, 0.0
        self._took_s.append(took_s)
        ordered = sorted(self._took_s)
        self.slow_s = ordered[(len(ordered) * 19) // 20]
        return again
