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

import io
import logging
import os
import select
import sys
from typing import TYPE_CHECKING, Any, Final, TextIO

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


if TYPE_CHECKING:
    _StreamHandler = logging.StreamHandler[TextIO]
else:
    _StreamHandler = logging.StreamHandler  # before Python 3.11 it takes no parameter


class _Lossy(_StreamHandler):
    """Handler that leaves lines out, and says how many, where nothing reads them.

    A stopped terminal or a pipe that is full would hold up the process, and all its clients.
    """

    _PART_CHARS: Final = 1000  # at most 4000 bytes: what poll(2) promises of a pipe
    _WAIT_MS: Final = 20  # for a reader that is only slow

    def __init__(self, stream: TextIO) -> None:
        super().__init__(stream)
        self._left_out = 0

    def emit(self, record: logging.LogRecord) -> None:
        try:
            text = self.format(record) + "\n"
            if self._left_out and self._is_writable():
                missed, self._left_out = self._left_out, 0
                note = logfmt("log lines left out: nothing read them", count=missed)
                self.emit(logging.LogRecord(record.name, logging.WARNING, "", 0, note, None, None))
            for begin in range(0, len(text), self._PART_CHARS):
                if not self._is_writable():
                    self._left_out += 1
                    return
                self.stream.write(text[begin : begin + self._PART_CHARS])
                self.flush()
        except (OSError, ValueError):
            self.handleError(record)

    def _is_writable(self) -> bool:
        try:
            stream = self.stream.fileno()
        except io.UnsupportedOperation:
            return True  # memory
        poll = select.poll()
        poll.register(stream, select.POLLOUT)
        return bool(poll.poll(0 if self._left_out else self._WAIT_MS))


def set_up_logging(level: int = logging.INFO) -> None:
    """Send the daemon's log to stderr, in the form its reader expects."""
    handler = _Lossy(sys.stderr)
    if os.environ.get("JOURNAL_STREAM"):
        handler.setFormatter(_JournalLines("%(message)s"))
    else:
        handler.setFormatter(_Lines("%(asctime)s %(levelname)-7s %(message)s", datefmt="%Y-%m-%d %H:%M:%S"))
    logging.basicConfig(level=level, handlers=[handler], force=True)
