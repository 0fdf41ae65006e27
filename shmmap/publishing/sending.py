# SPDX-License-Identifier: Apache-2.0
"""Sending objects, unless a run that was cut short sent them lately; looking for objects that are absent."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterable
from concurrent.futures import Executor
from typing import Final

from shmmap.failpoints import step
from shmmap.origin.remote.published_object import blob_path
from shmmap.origin.remote.store import Store

__all__ = ["ASKED_AT_ONCE", "absent_objects", "send_object"]

ASKED_AT_ONCE: Final = 32
_YOUNG_S: Final = 86_400.0
"""An object that no version has is used again if it is younger: pruning spares it for much longer."""


def send_object(store: Store, path: str, frame: bytes, *, look: bool = True) -> bool:
    """Have an object in the store; returns whether it was sent.

    Parameters
    ----------
    look
        False: it cannot be there.
    """
    if look:
        found = store.head(path)
        if found is not None and found.size == len(frame) and abs(time.time() - found.modified_s) < _YOUNG_S:
            return False
    step("publish.send")
    store.put(path, frame)
    return True


def absent_objects(
    store: Store, objects: Iterable[tuple[bytes, int]], threads: Executor, *, since_s: float = 0.0
) -> list[bytes]:
    """Return which objects, by hash and size, are not in the store.

    Parameters
    ----------
    since_s
        Unix time: objects written before it count as absent, too.
    """

    def is_absent(named: tuple[bytes, int]) -> bool:
        found = store.head(blob_path(named[0]))
        return found is None or found.size != named[1] or found.modified_s < since_s

    asked = list(objects)
    absent = threads.map(is_absent, asked)
    return [digest for digest, _ in itertools.compress(asked, absent)]
