# SPDX-License-Identifier: Apache-2.0
"""Segments that other programs remove (``rm /dev/shm/*``, logind's RemoveIPC, a cleaner) or truncate.

They are retired, so that their cells are loaded again at the next request.  Readers keep the segments that
they have mapped.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

from shmmap.daemon.cache.reclaimer import Reclaimer
from shmmap.daemon.host.inotify import NAME_GONE, OVERFLOW, Inotify
from shmmap.daemon.records import Resident
from shmmap.daemon.turns import Walk
from shmmap.logfmt import log
from shmmap.quantities import format_bytes

SETTLE_S: Final = 0.5
"""A cleaner removes files one after the other: the log line waits until none has vanished for this long."""
LIKELY: Final = (
    "logind (RemoveIPC) after the user's last logout, or a cleaner of temporary files; see `shmmap doctor`"
)


class LostSegments:
    """Watches the names of segments, retires lost segments, and logs each burst of losses in one line.

    Parameters
    ----------
    prefix
        Prefix of the names of segments.

    Attributes
    ----------
    to_check : Walk
        Segments to check after the kernel lost reports of vanished names.
    fd : int
        Readable when `retire_vanished` has something to do; -1 where the kernel reports no removals.
    """

    def __init__(self, reclaimer: Reclaimer, prefix: str) -> None:
        self._reclaimer = reclaimer
        self._prefix = prefix.lstrip("/")
        self.to_check: Walk[Resident] = Walk()
        self._removed = self._cut = self._bytes = 0
        self._example = ""
        self._last_s = 0.0
        self._inotify: Inotify | None = None
        try:
            self._inotify = Inotify()
            self._inotify.add(reclaimer.directory.path, NAME_GONE)
        except OSError:
            self.close()
        self.fd = self._inotify.fd if self._inotify is not None else -1

    def close(self) -> None:
        """Stop watching."""
        if self._inotify is not None:
            self._inotify.close()
            self._inotify = None

    def vanished(self) -> set[str] | None:
        """Return names (slash included) that vanished since the last call; None if the kernel lost some."""
        names: set[str] = set()
        for event in self._inotify.read() if self._inotify is not None else ():
            if event.mask & OVERFLOW:
                return None
            if event.name.startswith(self._prefix):
                names.add("/" + event.name)
        return names

    def retire_vanished(self, now_s: float) -> bool:
        """Retire segments whose removal the kernel reports; return True if that released memory."""
        ledger, names = self._reclaimer.ledger, self.vanished()
        if names is None:
            self.to_check = Walk(ledger.segments.walk())
            return False
        return self._retire_lost(filter(None, map(ledger.resident_named, names)), now_s)

    def check_some(self, now_s: float) -> bool:
        """Check whether some segments still exist; return True if that released memory."""
        return self._retire_lost(self.to_check.for_a_step(), now_s)

    def _retire_lost(self, residents: Iterable[Resident], now_s: float) -> bool:
        return sum(self.retire_if_lost(resident, now_s) for resident in residents) > 0

    def retire_if_lost(self, resident: Resident, now_s: float) -> bool:
        """Retire a segment in service that was removed or truncated, so that its cell is loaded again."""
        reclaimer = self._reclaimer
        if reclaimer.ledger.resident_named(resident.name) is not resident:
            return False
        size = reclaimer.directory.size_of(resident.name)
        if size >= resident.nbytes:
            return False
        self._removed += size < 0
        self._cut += size >= 0
        self._bytes += resident.nbytes
        self._example = self._example or resident.key.cell_id
        self._last_s = now_s
        reclaimer.retire(resident, now_s, "damaged")
        reclaimer.never_revive(resident.key)
        return True

    def report(self, now_s: float) -> None:
        """Log the lost segments, once none has followed for a moment."""
        if not (self._removed or self._cut) or now_s < self._last_s + SETTLE_S:
            return
        log.warning(
            "segments lost to other programs",
            removed=self._removed,
            cut_short=self._cut,
            memory=format_bytes(self._bytes),
            example=self._example,
            likely=LIKELY,
            effect="their cells are loaded again when they are asked for",
        )
        self._removed = self._cut = self._bytes = 0
        self._example = ""
