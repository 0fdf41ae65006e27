# SPDX-License-Identifier: Apache-2.0
"""Sending an object, unless a run that was cut short has sent it lately."""

from __future__ import annotations

import time
from typing import Final

from shmmap.failpoints import step
from shmmap.origin.remote.store import Store

__all__ = ["send_object"]

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
