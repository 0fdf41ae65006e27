# SPDX-License-Identifier: Apache-2.0
"""Verbs that read the statistics of one daemon."""

from __future__ import annotations

import os

from tests.support.daemon_process import ROOT, DaemonProcess
from tests.support.forked_programs import run_verb

__all__ = ["health", "verb"]


def verb(one: DaemonProcess, *words: str, env: dict[str, str] | None = None) -> tuple[int, str]:
    """Exit code of a verb, and what it prints; ``env`` is added to the environment."""
    address = ["--instance", one.instance, "--runtime-dir", one.runtime_dir, "--shm-dir", one.shm_dir]
    done = run_verb([*words, *address], {**os.environ, "PYTHONPATH": str(ROOT), **(env or {})})
    return done.returncode, done.stdout


def health(one: DaemonProcess, env: dict[str, str] | None = None) -> tuple[int, str]:
    """Exit code of ``shmmap health --strict``, and what it prints."""
    return verb(one, "health", "--strict", env=env)
