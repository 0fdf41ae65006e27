# SPDX-License-Identifier: Apache-2.0
"""A live map whose files are being read: in a thread, for a directory may hang, and again until it succeeds.

Whatever is wrong with one map's files is that map's problem: it has a name, and others are served meanwhile.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Final

from shmmap.daemon.config_live import LiveSettings
from shmmap.daemon.live.folder import Folder
from shmmap.daemon.live.map_files import MapFiles, MapSettings
from shmmap.daemon.live.messages import not_served
from shmmap.errors import ShmmapError
from shmmap.logfmt import log
from shmmap.protocol.live import LiveMapRow

__all__ = ["OpeningMap"]

LONG_S: Final = 1.0
"""Files that have been read for longer than this are a problem by now; a slow disk's passes by itself."""
RETRY_S: Final = 1.0
"""At least, after the files could not be read."""
PART: Final = 4.0
"""How much longer than it took in vain the pause is: large maps are not read all the time."""


class OpeningMap:
    """One map on its way into memory.

    Parameters
    ----------
    settings
        Which, and where.
    budget_bytes
        What it may take.
    wake
        Called in the thread when the files have been read, or cannot be.

    Attributes
    ----------
    problem
        Why it is not open; empty while that is not known.
    error
        What the last try ended with.
    """

    def __init__(self, settings: LiveSettings, budget_bytes: int, wake: Callable[[], None]) -> None:
        self.settings = settings
        self.problem = ""
        self.error: Exception | None = None
        self._budget_bytes = budget_bytes
        self._wake = wake
        self._begun_s = self._retry_s = 0.0
        self._thread: threading.Thread | None = None
        self._outcome: list[tuple[Folder, MapFiles] | Exception] = []

    def turn(self, now_s: float) -> tuple[Folder, MapFiles] | None:
        """Go on; returns the directory and its files, open and of a new life, once they have been read."""
        if self._thread is None:
            if now_s >= self._retry_s:
                self._begun_s = now_s
                self._thread = threading.Thread(target=self._read, daemon=True, name="live-opening")
                self._thread.start()
            return None
        if not self._outcome:
            if now_s >= self._begun_s + LONG_S and not self.problem:
                path = self.settings.path
                self._note(f"its files are being read, which takes long: is {path} slow, or does it hang?")
            return None
        self._thread = None
        outcome = self._outcome.pop()
        if not isinstance(outcome, Exception):
            return outcome
        self.failed(outcome, now_s)
        return None

    def failed(self, error: Exception, now_s: float) -> None:
        """It cannot be opened just now: that is its problem until the next try succeeds."""
        self.error = error
        self._retry_s = now_s + max(RETRY_S, PART * (now_s - self._begun_s))
        self._note(f"it cannot be opened: {_reason(error)}")

    def _note(self, problem: str) -> None:
        if problem != self.problem:
            self.problem = problem
            log.error("live map not open", map=self.settings.name, path=self.settings.path, reason=problem)

    def next_turn_s(self, now_s: float) -> float:
        """When the next turn is due."""
        if self._thread is None:
            return max(now_s, self._retry_s)
        return max(now_s, self._begun_s + LONG_S) if not self.problem else now_s + LONG_S

    def status(self) -> LiveMapRow:
        """How the map is: nothing of it is in memory."""
        return not_served(self.settings, self._budget_bytes, self.problem)

    def _read(self) -> None:
        """Read the files, in a thread that may never come back."""
        outcome: tuple[Folder, MapFiles] | Exception
        try:
            outcome = open_files(self.settings)
        except Exception as error:  # noqa: BLE001  a damaged file must not end another map
            outcome = error
        self._outcome.append(outcome)
        self._wake()


def open_files(settings: LiveSettings) -> tuple[Folder, MapFiles]:
    """Open a map's directory and read what is in it; a new life of the map begins.

    Raises
    ------
    ShmmapError, OSError
        It cannot be opened.
    """
    folder = Folder(settings.path)
    try:
        files = MapFiles(folder, MapSettings(settings.resolution, settings.occupancy, settings.frame_id))
        files.begin_life()
    except BaseException:
        folder.close()
        raise
    return folder, files


def _reason(error: Exception) -> str:
    if isinstance(error, ShmmapError):
        return error.message
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    log.error("unexpected error of a live map's files", kind=type(error).__name__, reason=str(error))
    return f"{type(error).__name__}: {error}"
