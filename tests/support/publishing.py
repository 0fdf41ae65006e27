# SPDX-License-Identifier: Apache-2.0
"""Publishes maps for tests, by the command line."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

from tests.support.daemon_process import ROOT

__all__ = ["publish"]


def publish(source: Path, url: str | Path, *words: str, environment: Mapping[str, str] | None = None) -> str:
    """Run ``shmmap publish``; returns what it prints."""
    given = {k: v for k, v in os.environ.items() if not k.startswith(("SHMMAP_", "GOOGLE_", "AZURE_"))}
    given |= {"PYTHONPATH": str(ROOT), **(environment or {})}
    done = subprocess.run(
        [sys.executable, "-m", "shmmap.cli", "publish", str(source), str(url), "--workers", "1", *words],
        env=given, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout
