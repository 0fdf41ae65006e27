# SPDX-License-Identifier: Apache-2.0
"""What a daemon does, seen from outside, so that watching it costs it no processor time.

A daemon answers the request `Stats` by asking the kernel about every segment.  Its statistics segment and its
directory of segments can be read without its doing anything.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Final

from shmmap.demo.process_cpu import cpu_seconds
from shmmap.demo.process_memory import descendants
from shmmap.statistics.reader import read_statistics
from shmmap.statistics.snapshot import Snapshot
from shmmap.testing.daemon_process import DaemonProcess

__all__ = ["Traffic", "WatchedDaemon", "statistics_now"]

_LOOK_S: Final = 0.02


@dataclass(frozen=True, slots=True)
class Traffic:
    """Messages between clients and daemon: how many requests, bytes, handles in replies."""

    requests: int
    request_bytes: int
    reply_bytes: int
    handles: int


class WatchedDaemon:
    """A daemon from now on.

    Attributes
    ----------
    start_cpu_s
        Processor time that it and its workers have used so far, seconds.
    """

    def __init__(self, process: DaemonProcess) -> None:
        self.process = process
        self._first = statistics_now(process).counters
        self.start_cpu_s = cpu_seconds(self.pids())

    @property
    def counters(self) -> dict[str, int]:
        """Its counters, a quarter of a second old at most."""
        return read_statistics(self.process.instance, self.process.shm_dir).counters

    def pids(self) -> list[int]:
        """Return the daemon and its workers."""
        return descendants(self.process.pid)

    def loaded(self) -> set[str]:
        """Return what is in service: names of segments."""
        return {name for name in self.process.segments() if not name.endswith(".zombie")}

    def traffic(self) -> Traffic:
        """Return what clients sent and got since the beginning."""
        now = statistics_now(self.process).counters
        grown = {name: value - self._first.get(name, 0) for name, value in now.items()}
        return Traffic(
            requests=grown["requests"],
            request_bytes=grown["bytes_received"],
            reply_bytes=grown["bytes_sent"],
            handles=grown["handles_sent"],
        )


def statistics_now(daemon: DaemonProcess) -> Snapshot:
    """Read a daemon's statistics as they are now or later: it writes them four times a second."""
    asked_s = time.monotonic()
    while True:
        found = read_statistics(daemon.instance, daemon.shm_dir)
        if found.beat_age_s < time.monotonic() - asked_s or found.state != "healthy":
            return found
        time.sleep(_LOOK_S)
