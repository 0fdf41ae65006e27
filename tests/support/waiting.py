# SPDX-License-Identifier: Apache-2.0
"""Waiting for what a daemon does by itself: by what it tells, not for a time."""

from __future__ import annotations

import time
from collections.abc import Callable

from shmmap.events import EventStream
from shmmap.protocol import events as e
from shmmap.statistics.reader import read_statistics
from tests.support.daemon_process import DaemonProcess

__all__ = ["PATIENCE_S", "counters", "next_reload", "until"]

PATIENCE_S = 60.0


def until(done: Callable[[], object], why: Callable[[], str]) -> None:
    """Wait until something is so; ``why`` says what is instead."""
    end_s = time.monotonic() + PATIENCE_S
    while not done():
        assert time.monotonic() < end_s, why()
        time.sleep(0.02)


def counters(one: DaemonProcess) -> dict[str, int]:
    """What its statistics say now."""
    return dict(read_statistics(one.instance, one.shm_dir).counters)


def next_reload(stream: EventStream) -> e.Reloaded:
    """Wait until the map has been read again."""
    while True:
        happening = stream.next(60.0)
        assert happening is not None, "no reload was told of"
        if isinstance(happening, e.Reloaded):
            return happening
