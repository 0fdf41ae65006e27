# SPDX-License-Identifier: Apache-2.0
"""Limits the bytes of what threads hold in memory at once."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator


class WorkRoom:
    """Bytes that threads take for pieces of work, and wait for; thread-safe.

    A piece that is larger than the room is worked on alone.  Threads get room in the order in which they ask,
    so smaller ones do not overtake a large piece.

    Parameters
    ----------
    limit_bytes
        Bytes that all pieces together may take.
    """

    def __init__(self, limit_bytes: int) -> None:
        self._limit = limit_bytes
        self._taken = 0
        self._turn = threading.Lock()
        self._changed = threading.Condition()

    @contextlib.contextmanager
    def taken(self, nbytes: int) -> Iterator[None]:
        """Wait for room for a piece of work, and hold it until the block is done."""
        with self._turn, self._changed:
            self._changed.wait_for(lambda: not self._taken or self._taken + nbytes <= self._limit)
            self._taken += nbytes
        try:
            yield
        finally:
            with self._changed:
                self._taken -= nbytes
                self._changed.notify_all()
