# SPDX-License-Identifier: Apache-2.0
"""Runs requests as coroutines, in an event loop in a thread of its own: so each can be ended at any time."""

from __future__ import annotations

import asyncio
import os
import threading
from collections.abc import Awaitable, Coroutine
from typing import Any, Final, TypeVar

from shmmap.errors import Offline
from shmmap.origin.remote.transport import too_slow
from shmmap.processes.request_threads import PREFIX

__all__ = ["run_coroutine", "within"]

_Answer = TypeVar("_Answer")


async def within(name: str, limit_s: float, work: Awaitable[_Answer]) -> _Answer:
    """Wait for a part of a request, and end it at its limit."""
    try:
        return await asyncio.wait_for(work, limit_s)
    except asyncio.TimeoutError:
        raise too_slow(name, limit_s) from None


_starting: Final = threading.Lock()
_loop: tuple[int, asyncio.AbstractEventLoop] | None = None  # and the process that it belongs to


def run_coroutine(work: Coroutine[Any, Any, _Answer]) -> _Answer:
    """Run a request in the event loop; an exception in this thread, as Ctrl-C raises, ends the request.

    Raises
    ------
    Offline
        The system allows no more threads.
    """
    try:
        future = asyncio.run_coroutine_threadsafe(work, _running_loop())
    except RuntimeError:
        work.close()
        raise Offline("no request can be made: the system allows no more threads") from None
    try:
        return future.result()
    finally:
        future.cancel()


def _running_loop() -> asyncio.AbstractEventLoop:
    global _loop
    with _starting:
        if _loop is None or _loop[0] != os.getpid():
            loop = asyncio.new_event_loop()
            threading.Thread(target=loop.run_forever, name=f"{PREFIX}loop", daemon=True).start()
            _loop = os.getpid(), loop
        return _loop[1]
