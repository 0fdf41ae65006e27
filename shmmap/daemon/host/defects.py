# SPDX-License-Identifier: Apache-2.0
"""Defects met while serving: told, counted, survived; unless one comes again and again."""

from __future__ import annotations

import math
import sys
import time
import traceback
from collections import defaultdict, deque
from collections.abc import Callable
from functools import partial
from typing import Final

from shmmap.logfmt import log
from shmmap.statistics.writer import StatisticsWriter

__all__ = ["Defects"]

MOST: Final = 100
WITHIN_S: Final = 10.0
"""So many exceptions of one place in such a time are more than one can go on with; one of them is logged."""


class Defects:
    """Exceptions that nobody expected.

    Parameters
    ----------
    clock
        Seconds.
    """

    def __init__(self, statistics: StatisticsWriter, clock: Callable[[], float] = time.monotonic) -> None:
        self._statistics = statistics
        self._now_s = clock
        self._met: defaultdict[tuple[str, int], deque[float]] = defaultdict(partial(deque, maxlen=MOST))
        self._told_s: dict[tuple[str, int], float] = {}

    def met(self) -> bool:
        """Note the exception that is being handled; True when its place raised too often to go on.

        Its traceback is logged, unless that of the same place was just now.
        """
        self._statistics.add("defects")
        *_, (frame, line) = traceback.walk_tb(sys.exc_info()[2])
        place, now_s = (frame.f_code.co_filename, line), self._now_s()
        if now_s >= self._told_s.get(place, -math.inf) + WITHIN_S:
            self._told_s[place] = now_s
            log.exception("defect", place=f"{place[0]}:{place[1]}", hint="please report it")
        met = self._met[place]
        met.append(now_s)
        return len(met) == MOST and now_s - met[0] <= WITHIN_S
