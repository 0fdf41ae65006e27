# SPDX-License-Identifier: Apache-2.0
"""Fixtures of several packages' tests."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator

import pytest

from shmmap.segment.directory import ShmDirectory


@pytest.fixture
def shm() -> Iterator[ShmDirectory]:
    """Return a directory of its own inside /dev/shm."""
    with tempfile.TemporaryDirectory(prefix="shmmap-unit-", dir="/dev/shm") as path:
        directory = ShmDirectory(path)
        yield directory
        directory.close()
