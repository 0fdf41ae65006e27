# SPDX-License-Identifier: Apache-2.0
"""Entry point of the process that divides a cloud for the daemon (``python -m shmmap.dividing.child_main``).

It sends packets of JSON: ``{"stage", "done", "total"}`` once a second, and ``{"error", "message", "hint"}``
before it exits with an error.  It is killed when the daemon dies; the next such process resumes its work.
"""

from __future__ import annotations

import json
import os
import socket
import sys
import time
from typing import Final

from shmmap.dividing.divide import divide
from shmmap.dividing.settings import DivideSettings
from shmmap.errors import MapDataError, ShmmapError
from shmmap.origin.map_report import LINK_NAME, read_report
from shmmap.processes.start_child import channel_to_parent
from shmmap.progress import NoProgress

_NICENESS: Final = 10  # clients of the daemon have priority
_REPORT_EVERY_S: Final = 1.0


class _Channel(NoProgress):
    """Sends progress and errors as packets to the daemon."""

    def __init__(self, channel: socket.socket) -> None:
        self._channel = channel
        self._name = ""
        self._done = self._total = 0
        self._reported_s = 0.0

    def stage(self, name: str, total: int) -> None:
        self._name, self._total, self._done = name, total, 0
        self._report()

    def advance(self, points: int) -> None:
        self._done += points
        if time.monotonic() - self._reported_s >= _REPORT_EVERY_S:
            self._report()

    def send(self, **fields: object) -> None:
        self._channel.send(json.dumps(fields).encode())

    def _report(self) -> None:
        self._reported_s = time.monotonic()
        self.send(stage=self._name, done=self._done, total=self._total)


def _frame_before(out: str) -> tuple[float, float, float] | None:
    """Return the offset that the served division of the cloud added to its points; None if there is none."""
    try:
        report = read_report(os.path.join(os.path.dirname(out), LINK_NAME))
    except MapDataError:
        return None  # written by another version: the cloud is divided again
    if report is None:
        return None
    x, y, z = (0.0 - float(part) for part in report["origin"])
    return x, y, z


def main(arguments: list[str]) -> int:
    """Run with ``CHANNEL_FD PARENT_PID CLOUD OUT UNIT VERTICAL_UNIT DROP_NOISE``; return its exit code."""
    channel = _Channel(channel_to_parent(arguments))
    os.nice(_NICENESS)
    # the settings of `shmmap divide`, for an equal map; a changed cloud keeps the frame of its last division
    settings = DivideSettings(
        resume=True,
        frame_before=_frame_before(arguments[3]),
        unit=arguments[4],
        vertical_unit=arguments[5],
        drop_noise=bool(arguments[6]),
    )
    try:
        divide([arguments[2]], arguments[3], settings, progress=channel)
    except ShmmapError as error:
        channel.send(error=error.code, message=error.message, hint=error.hint)
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
