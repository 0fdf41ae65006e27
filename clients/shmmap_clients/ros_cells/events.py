# SPDX-License-Identifier: Apache-2.0
"""Wake a program when something happens in the daemon, so that it asks for pending cells again."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Final

from shmmap import ShmmapError
from shmmap.events import EventStream

_LOOK_S: Final = 0.2
_AGAIN_S: Final = 0.02
"""Shortest time between two calls, seconds: a burst of events is one reason to ask again."""


def follow_events(
    endpoint: str, stop: threading.Event, notify: Callable[[], None], *, name: str = ""
) -> None:
    """Call ``notify`` after events of the daemon, and when it is back, until ``stop`` is set.

    Run this in a thread of its own.  A program should also ask again now and then: not all that ends a wait
    is an event, as when another program gives memory back.

    Parameters
    ----------
    endpoint
        The daemon's request socket.
    name
        Name of the client in the daemon's lists.
    """
    while not stop.is_set():
        try:
            with EventStream(endpoint, name=name) as events:
                notify()
                while not stop.is_set():
                    if events.next(_LOOK_S) is None:
                        continue
                    stop.wait(_AGAIN_S)
                    while events.next(0) is not None:
                        pass
                    notify()
        except ShmmapError:  # the daemon is away
            stop.wait(_LOOK_S)
