# SPDX-License-Identifier: Apache-2.0
"""Fixtures of several packages' tests."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from typing import Any, Protocol

import pytest

from shmmap.cli.entry import main
from shmmap.segment.directory import ShmDirectory


@pytest.fixture
def shm() -> Iterator[ShmDirectory]:
    """Return a directory of its own inside /dev/shm."""
    with tempfile.TemporaryDirectory(prefix="shmmap-unit-", dir="/dev/shm") as path:
        directory = ShmDirectory(path)
        yield directory
        directory.close()


class Verb(Protocol):
    """Runs a verb in this process; returns what was printed (``out``, ``err``) since it was last asked."""

    def __call__(self, words: Sequence[str], code: int = 0) -> Any: ...


@pytest.fixture
def verb(capsys: pytest.CaptureFixture[str]) -> Verb:
    """Return the command line, which checks the exit code."""

    def run(words: Sequence[str], code: int = 0) -> Any:
        assert main(words) == code
        return capsys.readouterr()

    return run
