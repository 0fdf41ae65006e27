# SPDX-License-Identifier: Apache-2.0
"""Reload of the map's catalogue, outside the serving loop.

Checking every file of a large map takes seconds, so it runs in a thread, which also compares the new state
with the old one.  An event descriptor wakes the loop, which then switches in one step.  If the list of cells
is paged, the new state may be held back until the needed pages have arrived; a state loaded in the meantime
replaces it.  Requests that arrive during a reload are answered by the next one, which sees all changes made
before them.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from dataclasses import dataclass

from shmmap.daemon.map.catalogue_view import CatalogueView, ViewOrigin
from shmmap.errors import InternalError, ShmmapError
from shmmap.logfmt import log
from shmmap.origin.catalogue import CatalogueChange


@dataclass(frozen=True, slots=True)
class Reread:
    """Another state of the map, and its difference from the state served when the reload was requested."""

    catalogue: CatalogueView
    change: CatalogueChange


Answer = Callable[[Reread | ShmmapError], None]
Apply = Callable[[Reread], Reread | None]
"""Serves a loaded state and returns it with its final difference; returns None if it has to be held back."""


class Reloader:
    """Loads the catalogue in a thread, one at a time.

    Parameters
    ----------
    origin
        Where the map is loaded from.
    served
        Returns the state of the map that is served.

    Attributes
    ----------
    fd
        Readable when a result is available: call `collect` then.
    """

    def __init__(self, origin: ViewOrigin, served: Callable[[], CatalogueView]) -> None:
        self.origin = origin
        self._served = served
        self.fd = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
        self._result: Reread | ShmmapError | None = None
        self._asked: list[Answer] = []
        self._next: list[Answer] = []
        self._held: Reread | None = None
        self._held_asked: list[Answer] = []

    def ask(self, answer: Answer) -> None:
        """Load the catalogue in a thread; ``answer`` is called from `collect`."""
        self._next.append(answer)
        if not self._asked:
            self._begin()

    def _begin(self) -> None:
        self._asked, self._next = self._next, []
        thread = threading.Thread(target=self._load, args=(self._served(),), name="reload", daemon=True)
        try:
            thread.start()
        except RuntimeError as error:  # the limit of threads is reached
            self._result = ShmmapError(
                f"{self.origin.path}: {error}", hint="raise the limit of processes (TasksMax=, ulimit -u)"
            )
            os.eventfd_write(self.fd, 1)

    def _load(self, before: CatalogueView) -> None:
        try:
            catalogue = self.origin.load(fresh=True, before=before)
            _ = catalogue.map_version, catalogue.bounds, catalogue.mean_size  # compute here, not in the loop
            self._result = Reread(catalogue, catalogue.changes_from(before))
        except ShmmapError as error:
            self._result = error
        except OSError as error:
            self._result = ShmmapError(f"{self.origin.path}: {error}")
        except Exception as error:  # noqa: BLE001  else this reload and later ones would never be answered
            log.exception("reload failed", map=self.origin.path, cause="a defect in shmmap")
            self._result = InternalError(f"{self.origin.path}: {type(error).__name__}: {error}")
        os.eventfd_write(self.fd, 1)

    def collect(self, apply: Apply, failed: Callable[[ShmmapError], None]) -> None:
        """Apply a finished load, answer its callers, and start the next load if one was requested."""
        os.eventfd_read(self.fd)
        result, asked = self._result, self._asked
        self._result, self._asked = None, []
        if isinstance(result, ShmmapError):
            log.error("reload failed", map=self.origin.path, message=result, served="the old state")
            failed(result)
            for answer in asked:
                answer(result)
        elif result is not None:
            self._held, self._held_asked = result, [*self._held_asked, *asked]
            self.apply_held(apply)
        if self._next and not self._asked:
            self._begin()

    def apply_held(self, apply: Apply) -> None:
        """Apply the held-back load unless it must still wait, and answer its callers."""
        applied = apply(self._held) if self._held is not None else None
        if applied is None:
            return
        asked, self._held_asked, self._held = self._held_asked, [], None
        for answer in asked:
            answer(applied)

    def close(self) -> None:
        """Forget a running load; its thread ends with the process."""
        os.close(self.fd)
