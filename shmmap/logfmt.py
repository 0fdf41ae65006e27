# SPDX-License-Identifier: Apache-2.0
"""Log lines for people and programs: the event, then ``key=value`` for each detail.

::

    evicted cell=city/20_40.pcd layer=points bytes=1261568 reason=room
    load failed cell="north gate.pcd" code=load_failed message="points are missing"

Names of files and clients are untrusted: characters that could move a terminal's cursor or begin another line
are escaped.

The daemon's log goes to stderr: with journald's priorities under systemd, with time and level elsewhere.
"""

from __future__ import annotations

import logging
import os
import sys
from typing import Any, Final

__all__ = ["escaped", "log", "logfmt", "set_up_logging"]

_ESCAPES = {"\n": "\\n", "\t": "\\t", "\r": "\\r"}


def escaped(text: str) -> str:
    """Return a text with every character that is not printable as a backslash escape."""
    if text.isprintable():
        return text
    return "".join(char if char.isprintable() else _ESCAPES.get(char, _number(char)) for char in text)


def logfmt(event: str, **details: object) -> str:
    """Return a log line.

    Parameters
    ----------
    event
        The event, in constant words without details.
    **details
        Written in this order; floats to three decimals, None is left out, and a value is quoted where
        it has blanks, quotes, ``=`` or characters that are not printable, or is empty.
    """
    return " ".join(
        [event, *(f"{key}={_value(value)}" for key, value in details.items() if value is not None)]
    )


def _value(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return f"{value:.3f}"
    text = str(value)
    if text and text.isprintable() and not any(char in text for char in ' "=\\'):
        return text
    return '"' + escaped(text.replace("\\", "\\\\").replace('"', '\\"')) + '"'


def _number(char: str) -> str:
    code = ord(char)
    if code < 0x100:
        return f"\\x{code:02x}"
    return f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"


class _Log:
    """The package's log: an event and its details make a line, see `logfmt`."""

    def __init__(self) -> None:
        self._logger = logging.getLogger("shmmap")

    def debug(self, event: str, **details: object) -> None:
        """Log details for debugging."""
        if self._logger.isEnabledFor(logging.DEBUG):
            self._logger.debug(logfmt(event, **details))

    def info(self, event: str, **details: object) -> None:
        """Log a normal event."""
        if self._logger.isEnabledFor(logging.INFO):
            self._logger.info(logfmt(event, **details))

    def warning(self, event: str, **details: object) -> None:
        """Log an event that needs an operator's attention."""
        self._logger.warning(logfmt(event, **details))

    def error(self, event: str, **details: object) -> None:
        """Log a failure."""
        self._logger.error(logfmt(event, **details))

    def exception(self, event: str, **details: object) -> None:
        """Log a failure with the traceback of the exception being handled."""
        self._logger.exception(logfmt(event, **details))


log: Final = _Log()

_PRIORITIES: Final = {
    logging.DEBUG: 7,
    logging.INFO: 6,
    logging.WARNING: 4,
    logging.ERROR: 3,
    logging.CRITICAL: 2,
}


class _Lines(logging.Formatter):
    """Formatter with one line per message, whatever it contains; only a traceback has more lines."""

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802  logging's name
        record.message = escaped(record.message)
        return super().formatMessage(record)

    def formatException(self, ei: Any) -> str:  # noqa: N802  logging's name
        return "\n".join(map(escaped, super().formatException(ei).splitlines()))


class _JournalLines(_Lines):
    """``<priority>message``: journald adds the time itself; every line has the prefix."""

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
