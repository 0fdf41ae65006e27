# SPDX-License-Identifier: Apache-2.0
"""`shmmap doctor` for one daemon."""

from __future__ import annotations

import json
import os
from typing import Any

from tests.support.daemon_process import ROOT, DaemonProcess
from tests.support.forked_programs import run_verb

__all__ = ["doctor"]


def doctor(one: DaemonProcess, *words: str) -> tuple[int, dict[str, Any]]:
    """Exit code, and the findings by name."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith("SHMMAP_")}
    address = ["--instance", one.instance, "--runtime-dir", one.runtime_dir, "--shm-dir", one.shm_dir]
    done = run_verb(["doctor", "--json", *address, *words], {**environment, "PYTHONPATH": str(ROOT)})
    assert done.stdout, done.stderr
    told = json.loads(done.stdout)
    found = {finding["name"]: finding for finding in told["findings"]}
    states = [finding["state"] for finding in told["findings"]]
    assert told["worst"] == next(state for state in ("fail", "warn", "ok") if state in states)
    return done.returncode, found
