# SPDX-License-Identifier: Apache-2.0
"""What a daemon takes away that is stopped before it serves."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from shmmap.daemon.host.instance_names import stopped_early
from shmmap.daemon.host.signals import StartSignals
from shmmap.segment.directory import ShmDirectory
from shmmap.statistics.exclusive_name import hold, take_name

LEFT = "shmmap.unit.0123456789abcdef"


@pytest.fixture
def signals() -> StartSignals:
    """Return signals of a daemon that starts; this process keeps its own handlers."""
    one = StartSignals.__new__(StartSignals)
    one.keep = False
    return one


@pytest.fixture
def shm(tmp_path: Path) -> Iterator[ShmDirectory]:
    directory = ShmDirectory(str(tmp_path))
    yield directory
    directory.close()


def test_what_an_earlier_life_left(shm: ShmDirectory, signals: StartSignals) -> None:
    for name in (LEFT, "shmmap.unit.statistics", "shmmap.another.0123456789abcdef"):
        Path(shm.path, name).touch()
    stopped_early(signals, shm, "unit", None)
    stopped_early(signals, shm, "unit", RuntimeError)
    assert len(os.listdir(shm.path)) == 3
    signals.keep = True
    stopped_early(signals, shm, "unit", SystemExit)
    assert len(os.listdir(shm.path)) == 3
    signals.keep = False
    stopped_early(signals, shm, "unit", SystemExit)
    assert os.listdir(shm.path) == ["shmmap.another.0123456789abcdef"]


def test_the_names_of_a_daemon_that_serves_stay(shm: ShmDirectory, signals: StartSignals) -> None:
    """Both found them free, and the other one was quicker."""
    Path(shm.path, LEFT).touch()
    fd = shm.create()
    hold(fd)
    take_name(shm, "unit", fd)
    stopped_early(signals, shm, "unit", SystemExit)
    assert sorted(os.listdir(shm.path)) == [LEFT, "shmmap.unit.statistics"]
    os.close(fd)
    stopped_early(signals, shm, "unit", SystemExit)
    assert os.listdir(shm.path) == []
