# SPDX-License-Identifier: Apache-2.0
"""Threads that make requests: a program that is interrupted does not wait for the answers."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from types import TracebackType
from typing import Final

__all__ = ["RequestThreads", "requests_under_way"]

_PREFIX: Final = "request-"


class RequestThreads(ThreadPoolExecutor):
    """A pool of threads for requests to a store; ``with`` waits for them, but not after an interrupt."""

    def __init__(self, threads: int, name: str) -> None:
        super().__init__(threads, f"{_PREFIX}{name}")

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        is_interrupt = kind is not None and issubclass(kind, KeyboardInterrupt | SystemExit)
        self.shutdown(wait=not is_interrupt, cancel_futures=kind is not None)


def requests_under_way() -> bool:
    """Whether threads of a pool have not ended: Python would wait for them at its exit."""
    return any(thread.name.startswith(_PREFIX) for thread in threading.enumerate())
