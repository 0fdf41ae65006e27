# SPDX-License-Identifier: Apache-2.0
"""The verbs that publish and fetch maps, as a user runs them without a daemon."""

from __future__ import annotations

import fcntl
import json
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tests.support.daemon_process import ROOT
from tests.support.forked_programs import run_verb

__all__ = ["Shmmap", "files_of", "locked"]


class Shmmap:
    """Runs the command line, with a home and a cache of its own."""

    def __init__(self, home: Path) -> None:
        hidden = ("SHMMAP_", "AWS_", "GOOGLE_", "AZURE_")
        self.environment = {k: v for k, v in os.environ.items() if not k.startswith(hidden)} | {
            "PYTHONPATH": str(ROOT),
            "HOME": str(home),
            "XDG_CACHE_HOME": str(home / "cache"),
        }

    def start(self, *words: str | Path, env: Mapping[str, str] | None = None) -> subprocess.Popen[str]:
        """Start a verb as a process of its own."""
        return subprocess.Popen(
            [sys.executable, "-m", "shmmap.cli", *_words(words)],
            env={**self.environment, **(env or {})},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def __call__(self, *words: str | Path, code: int = 0, env: Mapping[str, str] | None = None) -> str:
        done = run_verb(_words(words), {**self.environment, **(env or {})}, os.getcwd())
        assert done.returncode == code, done.stderr + done.stdout
        return done.stdout if code in (0, 1) else done.stderr

    def json(self, *words: str | Path, code: int = 0, env: Mapping[str, str] | None = None) -> dict[str, Any]:
        found = json.loads(self(*words, "--json", code=code, env=env))
        assert isinstance(found, dict)
        return found


def _words(words: tuple[str | Path, ...]) -> list[str]:
    """One worker is enough for these maps."""
    workers = ["--workers", "1"] if words[0] in ("publish", "prepare") else []
    return [*map(str, words), *workers]


def files_of(folder: Path) -> dict[str, bytes]:
    """The files of a directory by name."""
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@contextmanager
def locked(store: Path) -> Iterator[None]:
    """Hold the lock of a store in a directory: no other process replaces ``CURRENT`` or the timestamp."""
    with open(store / ".lock", "w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield
