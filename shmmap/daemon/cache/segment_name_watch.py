# SPDX-License-Identifier: Apache-2.0
"""Hearing when a segment's name vanishes behind the daemon's back (``rm /dev/shm/*``, RemoveIPC).

What is gone must not be handed out for ever: the cell is loaded anew when it is next asked for.
Its readers keep what they map.
"""

from __future__ import annotations

from shmmap.daemon.host.inotify import NAME_GONE, OVERFLOW, Inotify

__all__ = ["SegmentNameWatch"]


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
