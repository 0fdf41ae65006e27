# SPDX-License-Identifier: Apache-2.0
"""A terminal's whole screen: drawn again and again, keys read between, and left as it was found."""

from __future__ import annotations

import contextlib
import os
import re
import select
import shutil
import signal
import sys
import termios
import tty
from collections.abc import Sequence
from types import FrameType, TracebackType
from typing import Any, Final

from shmmap.cli.screens.output import Line, painted, wants_style

# alternate screen, no cursor, no wrapping of long lines; and back
_ENTER: Final = "\x1b[?1049h\x1b[?25l\x1b[?7l"
_LEAVE: Final = "\x1b[?7h\x1b[?25h\x1b[?1049l"
_KEY: Final = re.compile(r"\x1b[\[O][0-9;]*[A-Za-z~]|.", re.DOTALL)
_NAMES: Final = {
    "\x1b[A": "up",
    "\x1b[B": "down",
    "\x1bOA": "up",
    "\x1bOB": "down",
    "\x1b[5~": "page up",
    "\x1b[6~": "page down",
    "\x1b[H": "home",
    "\x1b[F": "end",
    "\x04": "q",
}
_MAX_READ: Final = 1024


class FullScreen:
    """The screen of the terminal on stdout; keys come from stdin, if that is a terminal, too."""

    def __init__(self) -> None:
        self._input = -1
        self._ended = False
        self._before: list[Any] = []
        self._stopped_by: Any = None

    def __enter__(self) -> FullScreen:
        with contextlib.suppress(OSError, ValueError):  # stdin may be closed
            if sys.stdin.isatty() and _is_ours(sys.stdin.fileno()):
                self._input = sys.stdin.fileno()
        sys.stdout.flush()
        self._take()
        self._stopped_by = signal.signal(signal.SIGTSTP, self._stop)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        signal.signal(signal.SIGTSTP, self._stopped_by)
        with contextlib.suppress(OSError):  # the terminal may be gone
            sys.stdout.flush()
            self._give()

    @property
    def has_keys(self) -> bool:
        """Whether keys are read."""
        return self._input >= 0 and not self._ended

    @property
    def size(self) -> tuple[int, int]:
        """Columns and lines."""
        return shutil.get_terminal_size()

    def draw(self, lines: Sequence[Line]) -> None:
        """Show these lines, which are not longer than the screen is wide."""
        style = wants_style()
        text = "\n".join(f"{painted(line, style=style)}\x1b[K" for line in lines[: self.size[1]])
        sys.stdout.write(f"\x1b[H{text}\x1b[J")
        sys.stdout.flush()

    def keys(self, timeout_s: float) -> list[str]:
        """Wait for keys; return their letters or names (``"down"``), none after the time."""
        if not self.has_keys:
            select.select([], [], [], timeout_s)
            return []
        if not select.select([self._input], [], [], timeout_s)[0]:
            return []
        data = os.read(self._input, _MAX_READ)
        if not data:
            self._ended = True  # the terminal is gone
        return [_NAMES.get(key, key) for key in _KEY.findall(data.decode("utf-8", "replace"))]

    def _take(self) -> None:
        if self._input >= 0:
            self._before = termios.tcgetattr(self._input)
            tty.setcbreak(self._input)
        _write(_ENTER)

    def _give(self) -> None:
        try:
            _write(_LEAVE)
        finally:
            if self._before:
                with contextlib.suppress(termios.error):
                    termios.tcsetattr(self._input, termios.TCSADRAIN, self._before)

    def _stop(self, number: int, frame: FrameType | None) -> None:
        """Stop as Ctrl-Z asks, with the terminal as it was; go on when continued."""
        del number, frame
        self._give()
        os.kill(os.getpid(), signal.SIGSTOP)
        self._take()


def _write(text: str) -> None:
    """Write to the terminal past the buffer of stdout: that may be in use while a signal is handled."""
    data = text.encode()
    while data:
        data = data[os.write(sys.stdout.fileno(), data) :]


def _is_ours(fd: int) -> bool:
    """Whether keys come to this process: a job in the background would be stopped if it read them."""
    try:
        return os.tcgetpgrp(fd) == os.getpgrp()
    except OSError:
        return True  # a terminal without jobs
