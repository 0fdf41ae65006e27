# SPDX-License-Identifier: Apache-2.0
"""Programs that take long to compile are compiled once for all of pytest's processes."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Callable
from pathlib import Path

import pytest

__all__ = ["built_once"]


def built_once(
    factory: pytest.TempPathFactory, name: str, build: Callable[[Path], Path | None]
) -> Path | None:
    """Return what ``build`` returned in the process that came first; it gets a directory of that name."""
    base = factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        base = base.parent
    folder = base / name
    folder.mkdir(exist_ok=True)
    done = folder / "built"
    with open(folder / "lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not done.exists():
            done.write_text(str(build(folder) or ""))
        found = done.read_text()
    return Path(found) if found else None
