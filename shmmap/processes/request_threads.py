# SPDX-License-Identifier: Apache-2.0
"""Threads that make requests: a program that is interrupted does not wait for the answers."""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from types import TracebackType
from typing import Final, NoReturn

PREFIX: Final = "request-"
"""How the names of threads begin that make requests, or wait for them."""
END_S: Final = 0.2
"""How long a program that ends waits for threads that may wait for a store, seconds."""


class RequestThreads(ThreadPoolExecutor):
    """A pool of threads for requests to a store; ``with`` waits for them, but not after an interrupt."""

    def __init__(self, threads: int, name: str) -> None:
        super().__init__(threads, f"{PREFIX}{name}")

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        is_interrupt = kind is not None and not issubclass(kind, Exception)
        self.shutdown(wait=not is_interrupt, cancel_futures=kind is not None)


def have_ended(threads: Sequence[threading.Thread]) -> bool:
    """Wait a moment for threads that are to end; return whether all have ended."""
    until_s = time.monotonic() + END_S
    for thread in threads:
        thread.join(max(0.0, until_s - time.monotonic()))
    return not any(thread.is_alive() for thread in threads)


def leave(code: object) -> NoReturn:
    """End this process: without the interpreter's own end if there are threads for requests.

    The interpreter would wait for requests under way.  And a thread of obstore that has just delivered an
    answer aborts the process if the interpreter ends at that moment.
    """
    if any(thread.name.startswith(PREFIX) for thread in threading.enumerate()):
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code if isinstance(code, int) else 0)
    sys.exit(code)  # type: ignore[arg-type]
