# SPDX-License-Identifier: Apache-2.0
"""Threads that make requests: a program that is interrupted does not wait for the answers."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from types import TracebackType
from typing import Final

__all__ = ["REQUEST", "RequestThreads", "requests_under_way"]

REQUEST: Final = "request-"
"""Prefix of the names of threads with a request."""


class RequestThreads(ThreadPoolExecutor):
    """A pool of threads for requests to a store; ``with`` waits for them, but not after an interrupt."""

    def __init__(self, threads: int, name: str) -> None:
        super().__init__(threads, f"{REQUEST}{name}")

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        is_interrupt = kind is not None and issubclass(kind, KeyboardInterrupt | SystemExit)
        self.shutdown(wait=not is_interrupt, cancel_futures=kind is not None)


def requests_under_way() -> bool:
    """Whether threads with a request have not ended.

    Python would wait for those of a pool at its exit, and abort if one returns from native code then.
    """
    return any(thread.name.startswith(REQUEST) for thread in threading.enumerate())
