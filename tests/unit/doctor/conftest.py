# SPDX-License-Identifier: Apache-2.0
"""Machines for doctor, made of files in a directory, and daemons with given statistics."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, cast

import pytest

from shmmap.daemon.config import DaemonConfig
from shmmap.doctor.diagnosis import Diagnosis, Machine
from shmmap.statistics.identity import DaemonIdentity
from shmmap.statistics.reader import Snapshot
from shmmap.version import build_version

USER = 61005
IDENTITY = DaemonIdentity(
    pid=4242,
    start_time_ticks=1,
    pid_namespace=1,
    epoch=1,
    instance="default",
    endpoint="/run/shmmap/default.sock",
    map_path="/maps/town",
    map_version=1,
    shm_dir="/dev/shm",
    id_prefix="",
    library_version=build_version(),
    started_unix_ns=1,
    frame_id="map",
)


class _Made(Snapshot):
    """Statistics with these counters."""

    def __init__(self, state: str, version: str, counters: dict[str, int]) -> None:
        identity = None if state == "absent" else dataclasses.replace(IDENTITY, library_version=version)
        super().__init__(cast("Any", state), identity)
        self.__dict__["counters"] = counters


def snapshot(state: str = "healthy", *, version: str = build_version(), **counters: int) -> Snapshot:
    return _Made(state, version, counters)


class Ward:
    """Makes diagnoses; files of their machine are given by name."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def file(self, name: str, text: str) -> None:
        path = self.root / name.lstrip("/")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)

    def mounts(self, *mounts: str) -> None:
        """Mount file systems, each ``POINT KIND OPTIONS``."""
        parts = [mount.split() for mount in mounts]
        lines = [f"1 1 0:1 / {point} rw - {kind} none {options}\n" for point, kind, options in parts]
        self.file("/proc/self/mountinfo", "".join(lines))

    def diagnosis(
        self, seen: Snapshot | None = None, *, uid: int = USER, file: str = "", **settings: object
    ) -> Diagnosis:
        (self.root / "dev/shm").mkdir(parents=True, exist_ok=True)
        config = DaemonConfig(**settings)  # type: ignore[arg-type]
        return Diagnosis(
            Machine(self.root), config, file, config.endpoint, seen or snapshot("absent"), uid=uid
        )


@pytest.fixture
def ward(tmp_path: Path) -> Ward:
    """Return a machine without files."""
    return Ward(tmp_path / "machine")
