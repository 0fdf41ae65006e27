# SPDX-License-Identifier: Apache-2.0
"""``shmmap metrics --listen`` of one daemon, as a process."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from tests.support.daemon_process import ROOT, DaemonProcess


@contextmanager
def listening(daemon: DaemonProcess) -> Iterator[str]:
    """The address of a server of this daemon's metrics."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith("SHMMAP_")} | {
        "PYTHONPATH": str(ROOT)
    }
    where = ("--instance", daemon.instance, "--runtime-dir", daemon.runtime_dir, "--shm-dir", daemon.shm_dir)
    with subprocess.Popen(
        [sys.executable, "-m", "shmmap.cli", "metrics", "--listen", "0", *where],
        env=environment, stdout=subprocess.PIPE, text=True,
    ) as process:  # fmt: skip
        try:
            assert process.stdout is not None
            found = re.fullmatch(r"serving (http://127\.0\.0\.1:\d+/metrics)\n", process.stdout.readline())
            assert found is not None
            yield found[1]
        finally:
            process.send_signal(signal.SIGTERM)
            assert process.wait(20) == -signal.SIGTERM
