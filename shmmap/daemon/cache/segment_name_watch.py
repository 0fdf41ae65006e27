# SPDX-License-Identifier: Apache-2.0
"""Noticing when others remove segments (``rm /dev/shm/*``, logind's RemoveIPC, a cleaner) or cut them short.

What is gone must not be handed out for ever: the cell is loaded again when it is next asked for.
Its readers keep what they map.
"""

from __future__ import annotations

from typing import Final

from shmmap.daemon.host.inotify import NAME_GONE, OVERFLOW, Inotify
from shmmap.daemon.records import Resident
from shmmap.logfmt import log
from shmmap.quantities import format_bytes

__all__ = ["LostSegments", "SegmentNameWatch"]

SETTLE_S: Final = 0.5
"""A cleaner removes one file after the other: its log line waits for so long without a further one."""
LIKELY: Final = (
    "logind (RemoveIPC) after the user's last logout, or a cleaner of temporary files; see `shmmap doctor`"
)


class SegmentNameWatch:
    """Watches a directory for names that vanish.

    Attributes
    ----------
    fd
        Readable when `gone` has something to tell; -1 where the kernel does not tell.
    """

    def __init__(self, path: str, prefix: str) -> None:
        self._prefix = prefix.lstrip("/")
        self._inotify: Inotify | None = None
        try:
            self._inotify = Inotify()
            self._inotify.add(path, NAME_GONE)
        except OSError:
            self.close()
        self.fd = self._inotify.fd if self._inotify is not None else -1

    def close(self) -> None:
        """Stop watching."""
        if self._inotify is not None:
            self._inotify.close()
            self._inotify = None

    def gone(self) -> set[str] | None:
        """Names (slash included) that vanished since the last call; None: any of them, events were lost."""
        names: set[str] = set()
        for event in self._inotify.read() if self._inotify is not None else ():
            if event.mask & OVERFLOW:
                return None
            if event.name.startswith(self._prefix):
                names.add("/" + event.name)
        return names


class LostSegments:
    """Counts segments that others removed or cut short, and logs them in one line a burst."""

    def __init__(self) -> None:
        self._removed = self._cut = self._bytes = 0
        self._example = ""
        self._last_s = 0.0

    def add(self, resident: Resident, *, removed: bool, now_s: float) -> None:
        """Count a segment."""
        self._removed += removed
        self._cut += not removed
        self._bytes += resident.nbytes
        self._example = self._example or resident.key.cell_id
        self._last_s = now_s

    def report(self, now_s: float) -> None:
        """Log what was lost, once nothing more has been for a moment."""
        if not (self._removed or self._cut) or now_s < self._last_s + SETTLE_S:
            return
        log.warning(
            "segments lost to other programs", removed=self._removed, cut_short=self._cut,
            memory=format_bytes(self._bytes), example=self._example, likely=LIKELY,
            effect="their cells are loaded again when they are asked for",
        )  # fmt: skip
        self._removed = self._cut = self._bytes = 0
        self._example = ""
