# SPDX-License-Identifier: Apache-2.0
"""Closes the last descriptors of removed segments in a thread of its own.

Taking memory back takes the kernel 0.2 ms a megabyte, in the thread that closes the last descriptor.  This
one does nothing else, and holds the interpreter only for the moment between two closes.
"""

from __future__ import annotations

import contextlib
import os
import queue
import signal
import threading
from collections import deque
from typing import Final

__all__ = ["Closer"]

SMALL_BYTES: Final = 1 << 16
MAX_WAITING: Final = 64
"""Descriptors that may wait to be closed: clients need them more."""
THREAD_NAME: Final = "shmmap-freeing"


class Closer:
    """A thread, begun when it is first needed.

    Attributes
    ----------
    fd
        Readable when `closed` has something to count.
    small_bytes
        Memory that is taken back sooner than another thread is woken.
    """

    def __init__(self) -> None:
        self.fd = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self.small_bytes = SMALL_BYTES
        self._to_close: queue.SimpleQueue[tuple[int, int] | None] = queue.SimpleQueue()
        self._closed: deque[int] = deque()
        self._waiting = 0
        self._thread: threading.Thread | None = None

    @property
    def full(self) -> bool:
        """Whether no more may be given to it for now."""
        return self._waiting >= MAX_WAITING

    def close(self, fd: int, nbytes: int) -> None:
        """Close a descriptor, whose segment takes ``nbytes``, in the thread."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name=THREAD_NAME, daemon=True)
            before = signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())
            try:
                self._thread.start()  # signals are the serving loop's
            finally:
                signal.pthread_sigmask(signal.SIG_SETMASK, before)
        self._waiting += 1
        self._to_close.put((fd, nbytes))

    def closed(self) -> int:
        """Return the bytes of what was closed since the last call."""
        with contextlib.suppress(BlockingIOError):
            os.eventfd_read(self.fd)
        nbytes = 0
        for _ in range(len(self._closed)):
            nbytes += self._closed.popleft()
            self._waiting -= 1
        return nbytes

    def end(self) -> None:
        """Close what waits, and end the thread."""
        if self._thread is not None:
            self._to_close.put(None)
            self._thread.join()
            self._thread = None
        os.close(self.fd)

    def _run(self) -> None:
        while (item := self._to_close.get()) is not None:
            fd, nbytes = item
            os.close(fd)
            self._closed.append(nbytes)
            os.eventfd_write(self.fd, 1)
