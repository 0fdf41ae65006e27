# SPDX-License-Identifier: Apache-2.0
"""Hold back Ctrl-C while a process is started or a cleanup runs."""

from __future__ import annotations

import contextlib
import shutil
import signal
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping
from types import FrameType
from typing import Final

ENDINGS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Signals by which users and the system end a program."""


@contextlib.contextmanager
def interrupts_later() -> Iterator[None]:
    """Hold back signals that end the program until the block is done.

    An interrupt inside `subprocess.Popen` would leak the child that was just started.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    held: list[int] = []

    def hold(number: int, frame: FrameType | None) -> None:
        del frame
        held.append(number)

    try:
        with _handled_by(hold):
            yield
    finally:
        if held:
            signal.raise_signal(held[0])


@contextlib.contextmanager
def signals_interrupt() -> Iterator[None]:
    """Make SIGTERM and SIGHUP interrupt like Ctrl-C; after the first signal, cleanup is not interrupted."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        del number, frame
        for again in ENDINGS:
            signal.signal(again, signal.SIG_IGN)
        raise KeyboardInterrupt

    with _handled_by(interrupt):
        yield


@contextlib.contextmanager
def _handled_by(handle: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    """Handle `ENDINGS` by a function, except signals with a handler in C, which Python cannot restore."""
    before = {number: handler for number in ENDINGS if (handler := signal.getsignal(number)) is not None}
    try:
        for number in before:
            signal.signal(number, handle)
        yield
    finally:
        try:
            _put_back(before)
        except BaseException:  # raised by a restored handler: the others must be restored, too
            _put_back(before)
            raise


def _put_back(handlers: Mapping[signal.Signals, Callable[[int, FrameType | None], object] | int]) -> None:
    for number, handler in handlers.items():
        signal.signal(number, handler)


@contextlib.contextmanager
def scratch_directory(prefix: str) -> Iterator[str]:
    """Create a temporary directory with this name prefix, and remove it with its content in any case."""
    with interrupts_later():
        path = tempfile.mkdtemp(prefix=prefix)
    try:
        yield path
    finally:
        with interrupts_later():
            shutil.rmtree(path, ignore_errors=True)
