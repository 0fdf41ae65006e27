# SPDX-License-Identifier: Apache-2.0
"""The command line as a user runs it."""

from __future__ import annotations

import fcntl
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
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


def _address(one: DaemonProcess) -> list[str]:
    return ["--instance", one.instance, "--runtime-dir", one.runtime_dir, "--shm-dir", one.shm_dir]


def doctor(one: DaemonProcess, *words: str) -> tuple[int, dict[str, Any]]:
    """Exit code, and the findings by name."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith("SHMMAP_")}
    done = run_verb(["doctor", "--json", *_address(one), *words], {**environment, "PYTHONPATH": str(ROOT)})
    assert done.stdout, done.stderr
    report = json.loads(done.stdout)
    found = {finding["name"]: finding for finding in report["findings"]}
    states = [finding["state"] for finding in report["findings"]]
    assert report["worst"] == next(state for state in ("fail", "warn", "ok") if state in states)
    return done.returncode, found


def verb(one: DaemonProcess, *words: str, env: dict[str, str] | None = None) -> tuple[int, str]:
    """Exit code of a verb, and what it prints; ``env`` is added to the environment."""
    done = run_verb([*words, *_address(one)], {**os.environ, "PYTHONPATH": str(ROOT), **(env or {})})
    return done.returncode, done.stdout


def health(one: DaemonProcess, env: dict[str, str] | None = None) -> tuple[int, str]:
    """Exit code of ``shmmap health --strict``, and what it prints."""
    return verb(one, "health", "--strict", env=env)


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


class Verbs:
    """Runs the command line without a daemon, with a home and a cache of its own."""

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
