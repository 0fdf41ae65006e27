# SPDX-License-Identifier: Apache-2.0
"""Threads whose owner is gone, and did not stop them because an exception came when it ended.

Python ends objects by functions written in Python, at whose first step a signal handler's exception may come;
then nobody stops what such an object had running.  The next connection does.
"""

from __future__ import annotations

import weakref
from typing import Final, Protocol

__all__ = ["Running", "enter", "running", "stop_orphans"]


class Running(Protocol):
    """What runs in a thread for somebody."""

    @property
    def owner(self) -> weakref.ref[object]:
        """For whom."""

    def tell_to_stop(self) -> None:
        """Have it end, soon."""


running: Final[set[Running]] = set()
"""Each thread enters and leaves by itself."""


def enter(one: Running) -> None:
    """Begin what runs in this thread; its owner may be gone already, and no connection may come later."""
    running.add(one)
    if one.owner() is None:
        one.tell_to_stop()


def stop_orphans() -> None:
    """Have those end that nobody owns any more."""
    for one in tuple(running):
        if one.owner() is None:
            one.tell_to_stop()
