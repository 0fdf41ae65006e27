# SPDX-License-Identifier: Apache-2.0
"""Steps at which a test can kill a process, or make it fail: ``SHMMAP_TEST_CRASH=STEP[:N[:FILE]]``.

The process sends itself SIGKILL when it reaches STEP for the Nth time (by default the first).  With FILE,
the process creates this file first, and does not die if the file exists: so only one process dies, its
replacement lives, and the test sees that the step was reached.

With ``SHMMAP_TEST_DEFECT=STEP:N:FILE`` the step raises an exception N times instead, once this file exists.
Without these variables a step is an empty function.
"""

from __future__ import annotations

import os
from typing import Final

WORKER_STEPS: Final = (
    "worker.alloc",
    "worker.write",
    "worker.header",
    "worker.pass",
    "worker.passed",
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
LIVE_STEPS: Final = (
    "live.copied",
    "live.odd",
    "live.applied",
    "live.even",
    "live.map",
    "live.written",
    "live.renamed",
    "live.flushed",
)
ORIGIN_STEPS: Final = (
    *("publish.send", "publish.shard", "publish.root"),
    *("version.entry", "version.switch", "version.switched"),
    *("sign.keys", "sign.root", "sign.metadata", "sign.timestamp", "sign.signed"),
    *("sign.switch", "sign.switched", "sign.repaired"),
    *("sign.nextkey", "sign.nextroot", "sign.renewed", "sign.rotated"),
    *("restore.entry", "restore.looked"),
    *("prune.entry", "prune.listed", "prune.metadata", "prune.object", "prune.part"),
    *("slice.shard", "slice.part", "slice.made"),
    *("join.root", "join.entry", "join.looked", "join.part"),
    *("fetch.cell", "fetch.whole", "fetch.renamed"),
    *("tier.made", "tier.written", "tier.named"),
    "trim.file",
    *("taken.head", "taken.written", "taken.named"),
)
CLIENT_STEPS: Final = ("client.answer", "client.open", "client.lock", "client.map")


def _untouched(label: str) -> None:
    """Do nothing: no test uses a step in this process."""


def _parsed(wanted: str) -> tuple[str, int, str]:
    label, _, rest = wanted.partition(":")
    number, _, file = rest.partition(":")
    if label not in {*WORKER_STEPS, *DAEMON_STEPS, *LIVE_STEPS, *ORIGIN_STEPS, *CLIENT_STEPS}:
        raise ValueError(f"SHMMAP_TEST_CRASH, SHMMAP_TEST_DEFECT: there is no step {label!r}")
    return label, int(number or 1), file


class _Defect:
    def __init__(self, wanted: str) -> None:
        self._label, self._left, self._file = _parsed(wanted)

    def __call__(self, label: str) -> None:
        if label == self._label and self._left and os.path.exists(self._file):
            self._left -= 1
            raise RuntimeError(f"a defect at {label}, as a test wants it")


class _Crash:
    def __init__(self, wanted: str) -> None:
        self._label, self._left, self._file = _parsed(wanted)

    def __call__(self, label: str) -> None:
        if label != self._label:
            return
        self._left -= 1
        if self._left == 0 and self._is_first():
            import signal  # takes half a millisecond, and only tests need it

            os.kill(os.getpid(), signal.SIGKILL)

    def _is_first(self) -> bool:
        if not self._file:
            return True
        try:
            os.close(os.open(self._file, os.O_CREAT | os.O_EXCL | os.O_CLOEXEC))
        except FileExistsError:
            return False
        return True


_crash: Final = os.environ.get("SHMMAP_TEST_CRASH", "")
_defect: Final = os.environ.get("SHMMAP_TEST_DEFECT", "")
step: Final = _Crash(_crash) if _crash else _Defect(_defect) if _defect else _untouched
"""Called with the name of the step that the process has reached."""
