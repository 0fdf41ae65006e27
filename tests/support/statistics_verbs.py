# SPDX-License-Identifier: Apache-2.0
"""Verbs that read the statistics of one daemon."""

from __future__ import annotations

import os
import subprocess
import sys

from tests.support.daemon_process import ROOT, DaemonProcess

__all__ = ["health", "verb"]


def verb(one: DaemonProcess, *words: str, env: dict[str, str] | None = None) -> tuple[int, str]:
    """Exit code of a verb, and what it prints; ``env`` is added to the environment."""
    done = subprocess.run(
        [sys.executable, "-m", "shmmap.cli", *words, "--instance", one.instance,
         "--runtime-dir", one.runtime_dir, "--shm-dir", one.shm_dir],
        env={**os.environ, "PYTHONPATH": str(ROOT), **(env or {})}, capture_output=True, text=True,
    )  # fmt: skip
    return done.returncode, done.stdout


def health(one: DaemonProcess, env: dict[str, str] | None = None) -> tuple[int, str]:
    """Exit code of ``shmmap health --strict``, and what it prints."""
    return verb(one, "health", "--strict", env=env)
