# SPDX-License-Identifier: Apache-2.0
"""Log lines on stderr: journald's priorities under systemd, time and level elsewhere; defects among them."""

from __future__ import annotations

import logging
import math
import os
import sys
import time
import traceback
from collections import defaultdict, deque
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from shmmap.logfmt import escaped, log

if TYPE_CHECKING:
    from shmmap.statistics.writer import StatisticsWriter

__all__ = ["Defects", "set_up_logging"]

MAX_DEFECTS: Final = 100
WITHIN_S: Final = 10.0
"""That many exceptions of one place in this time are fatal; one of them is logged."""
_PRIORITIES: Final = {
    logging.DEBUG: 7,
    logging.INFO: 6,
    logging.WARNING: 4,
    logging.ERROR: 3,
    logging.CRITICAL: 2,
}


class _Lines(logging.Formatter):
    """One line each, whatever a message contains; only a traceback has more of them."""

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802  logging's name
        record.message = escaped(record.message)
        return super().formatMessage(record)

    def formatException(self, ei: Any) -> str:  # noqa: N802  logging's name
        return "\n".join(map(escaped, super().formatException(ei).splitlines()))


class _JournalLines(_Lines):
    """``<priority>message``: journald adds the time itself; every line carries the prefix."""

    def format(self, record: logging.LogRecord) -> str:
        prefix = f"<{_PRIORITIES.get(record.levelno, 6)}>"
        return prefix + super().format(record).replace("\n", "\n" + prefix)


def set_up_logging(level: int = logging.INFO) -> None:
    """Send the daemon's log to stderr, in the form its reader expects."""
    handler = logging.StreamHandler(sys.stderr)
    if os.environ.get("JOURNAL_STREAM"):
        handler.setFormatter(_JournalLines("%(message)s"))
    else:
        handler.setFormatter(_Lines("%(asctime)s %(levelname)-7s %(message)s", datefmt="%Y-%m-%d %H:%M:%S"))
    logging.basicConfig(level=level, handlers=[handler], force=True)


class Defects:
    """Unexpected exceptions met while serving: counted and survived, unless one place keeps raising.

    Parameters
    ----------
    clock
        Seconds.
    """

    def __init__(self, statistics: StatisticsWriter, clock: Callable[[], float] = time.monotonic) -> None:
        self._statistics = statistics
        self._now_s = clock
        self._met: defaultdict[tuple[str, int], deque[float]] = defaultdict(
            partial(deque, maxlen=MAX_DEFECTS)
        )
        self._logged_s: dict[tuple[str, int], float] = {}

    def record(self) -> bool:
        """Record the exception that is being handled; True when its place raised too often to go on.

        Its traceback is logged, unless that of the same place was just now.
        """
        self._statistics.add("defects")
        *_, (frame, line) = traceback.walk_tb(sys.exc_info()[2])
        place, now_s = (frame.f_code.co_filename, line), self._now_s()
        if now_s >= self._logged_s.get(place, -math.inf) + WITHIN_S:
            self._logged_s[place] = now_s
            log.exception("defect", place=f"{place[0]}:{place[1]}", hint="please report it")
        met = self._met[place]
        met.append(now_s)
        return len(met) == MAX_DEFECTS and now_s - met[0] <= WITHIN_S
