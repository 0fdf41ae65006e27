# SPDX-License-Identifier: Apache-2.0
"""Places where a test can kill a process, to see what that leaves: ``SHMMAP_TEST_CRASH=STEP[:N[:FILE]]``.

The process sends itself SIGKILL when it comes to STEP for the Nth time (the first, if N is not
given).  With FILE only the process that makes this file dies: those that take its place live on,
and the test sees that the step was reached.  Without the variable a step is an empty function.
"""

from __future__ import annotations

import os
from typing import Final

__all__ = ["CLIENT_STEPS", "DAEMON_STEPS", "WORKER_STEPS", "step"]

WORKER_STEPS: Final = (
    "worker.alloc",
    "worker.write",
    "worker.header",
    "worker.pass",
    "worker.passed",
    "worker.done",
    "worker.check",
)
DAEMON_STEPS: Final = (
    "daemon.lock",
    "daemon.adopt",
    "daemon.adopted",
    "daemon.bind",
    "daemon.received",
    "daemon.stamp",
    "daemon.link",
    "daemon.linked",
    "daemon.catalogue",
    "daemon.reply",
    "daemon.replied",
    "daemon.rename",
    "daemon.renamed",
    "daemon.probe",
    "daemon.unlink",
    "daemon.unlinked",
    "daemon.accept",
)
CLIENT_STEPS: Final = ("client.answer", "client.open", "client.lock", "client.map")


def _without_crash(label: str) -> None:
    """Do nothing: this process is not to die."""


class _Crash:
    def __init__(self, wanted: str) -> None:
        label, _, rest = wanted.partition(":")
        number, _, self._file = rest.partition(":")
        if label not in {*WORKER_STEPS, *DAEMON_STEPS, *CLIENT_STEPS}:
            raise ValueError(f"SHMMAP_TEST_CRASH: there is no step {label!r}")
        self._label = label
        self._left = int(number or 1)

    def __call__(self, label: str) -> None:
        if label != self._label:
            return
        self._left -= 1
        if self._left == 0 and self._is_first():
            import signal  # costs every client half a millisecond, and is for tests

            os.kill(os.getpid(), signal.SIGKILL)

    def _is_first(self) -> bool:
        if not self._file:
            return True
        try:
            os.close(os.open(self._file, os.O_CREAT | os.O_EXCL | os.O_CLOEXEC))
        except FileExistsError:
            return False
        return True


_wanted: Final = os.environ.get("SHMMAP_TEST_CRASH", "")
step: Final = _Crash(_wanted) if _wanted else _without_crash
"""Called with the name of the step the process has come to."""
