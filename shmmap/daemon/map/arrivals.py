# SPDX-License-Identifier: Apache-2.0
"""Bytes that the daemon's own threads receive from a remote origin, counted for the budget of its link."""

from __future__ import annotations

import threading


class Arrivals:
    """Bytes that threads of the daemon itself have received; thread-safe.

    ``pages_bytes`` are those of pages that are being fetched.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._index = self._ahead = self.pages_bytes = 0

    def add_index(self, nbytes: int) -> None:
        """Count bytes of the list of cells."""
        with self._lock:
            self._index += nbytes

    def add_ahead(self, nbytes: int) -> None:
        """Count bytes of objects that are kept on the disk ahead of use."""
        with self._lock:
            self._ahead += nbytes

    def add_pages(self, nbytes: int) -> None:
        """Count bytes of pages that are being fetched; negative when they have come."""
        with self._lock:
            self.pages_bytes += nbytes

    def take(self) -> tuple[int, int]:
        """Return the bytes of the list of cells and of objects since the last call."""
        with self._lock:
            found = self._index, self._ahead
            self._index = self._ahead = 0
        return found
