# SPDX-License-Identifier: Apache-2.0
"""The command line as a user runs it."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path
from typing import Any

from tests.support.daemon_process import ROOT, DaemonProcess
from tests.support.forked_programs import run_verb


class Shmmap:
    """Runs ``shmmap`` as a user does, aimed at one daemon."""

    def __init__(self, daemon: DaemonProcess, cwd: Path) -> None:
        self.daemon = daemon
        self.cwd = cwd
        self.environment = {k: v for k, v in os.environ.items() if not k.startswith("SHMMAP_")} | {
            "PYTHONPATH": str(ROOT),
            "SHMMAP_INSTANCE": daemon.instance,
            "SHMMAP_RUNTIME_DIR": daemon.runtime_dir,
            "SHMMAP_SHM_DIR": daemon.shm_dir,
        }

    def __call__(self, *words: str, code: int = 0) -> str:
        done = self.run(*words)
        assert done.returncode == code, done.stderr + done.stdout
        return done.stdout

    def run(self, *words: str) -> subprocess.CompletedProcess[str]:
        return run_verb(list(words), self.environment, self.cwd)

    def json(self, *words: str, code: int = 0) -> Any:
        return json.loads(self(*words, "--json", code=code))
