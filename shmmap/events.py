# SPDX-License-Identifier: Apache-2.0
"""Live events of the daemon: cells loaded, changed and evicted, clients that join and leave.

::

    from shmmap.events import EventStream

    with EventStream() as stream:
        for event in stream:
            print(event)

`EventStream` iterates over events; each kind of event is one of the other classes here.  For lost events it
yields `MissedEvents`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from shmmap.lazy_imports import lazy_public_names

if TYPE_CHECKING:
    from shmmap.client.event_stream import EventStream, MissedEvents
    from shmmap.protocol.events import (
        Beat,
        Changed,
        Epoch,
        Event,
        Evicted,
        Failed,
        Joined,
        Left,
        LiveChanged,
        LiveDamaged,
        LiveEnded,
        LiveProblem,
        LiveStarted,
        Loaded,
        LongTurn,
        PrefetchMiss,
        Pressure,
        Reloaded,
        Retried,
    )

__all__ = [
    "Beat",
    "Changed",
    "Epoch",
    "Event",
    "EventStream",
    "Evicted",
    "Failed",
    "Joined",
    "Left",
    "LiveChanged",
    "LiveDamaged",
    "LiveEnded",
    "LiveProblem",
    "LiveStarted",
    "Loaded",
    "LongTurn",
    "MissedEvents",
    "PrefetchMiss",
    "Pressure",
    "Reloaded",
    "Retried",
]

if not TYPE_CHECKING:
    __getattr__ = lazy_public_names(__name__)
