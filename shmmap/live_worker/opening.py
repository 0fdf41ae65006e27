# SPDX-License-Identifier: Apache-2.0
"""Open a live map: a thread reads its files, since a directory may hang, and retries on errors.

A problem with one map's files is reported, and does not affect other maps.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable
from typing import Final

from shmmap.errors import ShmmapError
from shmmap.live_messages import not_served
from shmmap.live_settings import LiveSettings
from shmmap.live_worker.disk.folder import Folder
from shmmap.live_worker.disk.map_database import MapDatabase
from shmmap.live_worker.disk.map_record import MapSettings
from shmmap.logfmt import log
from shmmap.protocol.live import LiveMapRow

LONG_S: Final = 1.0
"""Reading time that is reported as a problem; on a slow disk it ends by itself."""
RETRY_S: Final = 1.0
"""Shortest pause after a failed try."""
PAUSE_FACTOR: Final = 4.0
"""Ratio of the pause to the duration of the failed try, so that large maps are not read continuously."""


class OpeningMap:
    """One map that is being opened.

    Parameters
    ----------
    wake
        Called in the thread when reading the files has succeeded or failed.

    Attributes
    ----------
    problem
        Why the map is not open; empty while the reason is not known.
    error
        Error of the last try.
    """

    def __init__(self, settings: LiveSettings, budget_bytes: int, wake: Callable[[], None]) -> None:
        self.settings = settings
        self.problem = ""
        self.error: Exception | None = None
        self._budget_bytes = budget_bytes
        self._wake = wake
        self._begun_s = self._retry_s = 0.0
        self._thread: threading.Thread | None = None
        self._outcome: list[tuple[Folder, MapDatabase] | Exception] = []

    def run_turn(self, now_s: float) -> tuple[Folder, MapDatabase] | None:
        """Continue; once the files are read, begin a new run and return the directory and the database."""
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
        """Record an error of opening as the map's problem until a try succeeds."""
        self.error = error
        self._retry_s = now_s + max(RETRY_S, PAUSE_FACTOR * (now_s - self._begun_s))
        self._note(f"it cannot be opened: {_reason(error)}")

    def _note(self, problem: str) -> None:
        if problem != self.problem:
            self.problem = problem
            log.error("live map not open", map=self.settings.name, path=self.settings.path, reason=problem)

    def next_turn_s(self, now_s: float) -> float:
        """Return when the next turn is due."""
        if self._thread is None:
            return max(now_s, self._retry_s)
        return max(now_s, self._begun_s + LONG_S) if not self.problem else now_s + LONG_S

    def status(self) -> LiveMapRow:
        """Return the map's state, with no chunk in memory."""
        return not_served(self.settings, self._budget_bytes, self.problem)

    def _read(self) -> None:
        """Read the files, in a thread that may never return."""
        outcome: tuple[Folder, MapDatabase] | Exception
        try:
            outcome = _open_files(self.settings)
        except Exception as error:  # noqa: BLE001  a damaged file must not end other maps
            outcome = error
        self._outcome.append(outcome)
        self._wake()


def _open_files(settings: LiveSettings) -> tuple[Folder, MapDatabase]:
    """Open a map's directory and read it; a new run of the map begins."""
    with contextlib.ExitStack() as undo:
        folder = Folder(settings.path)
        undo.callback(folder.close)
        fixed = MapSettings(settings.resolution, settings.occupancy, settings.frame_id)
        database = MapDatabase(folder, fixed)
        undo.callback(database.close)
        database.begin_run()
        undo.pop_all()
    return folder, database


def _reason(error: Exception) -> str:
    if isinstance(error, ShmmapError):
        return error.message
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    log.error("unexpected error of a live map's files", kind=type(error).__name__, reason=str(error))
    return f"{type(error).__name__}: {error}"
