# SPDX-License-Identifier: Apache-2.0
"""Publishes maps for tests, by the command line."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Mapping
from pathlib import Path

from tests.support.daemon_process import ROOT
from tests.support.forked_programs import run_verb

__all__ = ["make_older", "publish"]


def publish(source: Path, url: str | Path, *words: str, environment: Mapping[str, str] | None = None) -> str:
    """Run ``shmmap publish``; returns what it prints."""
    given = {k: v for k, v in os.environ.items() if not k.startswith(("SHMMAP_", "GOOGLE_", "AZURE_"))}
    given |= {"PYTHONPATH": str(ROOT), **(environment or {})}
    done = run_verb(["publish", str(source), str(url), "--workers", "1", *words], given)
    assert done.returncode == 0, done.stderr
    return done.stdout


def make_older(store: Path, days: float, *versions: int) -> None:
    """Date these versions, and all objects, that many days back."""
    then = time.time() - days * 86_400
    for version in versions:
        path = store / f"versions/{version}.json"
        entry = json.loads(path.read_bytes())
        entry["created"] = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(then))
        path.write_text(json.dumps(entry))
    for path in (store / "blobs/sha256").iterdir():
        os.utime(path, (then, then))
