# SPDX-License-Identifier: Apache-2.0
"""Log lines on stderr: with journald's priorities under systemd, with time and level elsewhere."""

from __future__ import annotations

import logging
import os
import sys
from typing import Any, Final

from shmmap.logfmt import escaped

__all__ = ["set_up_logging"]

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
