# SPDX-License-Identifier: Apache-2.0
"""Segments to try things on."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from shmmap.segment.directory import ShmDirectory
from shmmap.segment.header import PublishBlock
from tests.support.segments import publish_segment

Publish = Callable[..., str]


@pytest.fixture
def publish(shm: ShmDirectory) -> Publish:
    """Publish a cell of ``rows`` points; returns its name."""

    def make(rows: int = 100, seed: int = 0, mode: int = 0o400) -> str:
        rng = np.random.default_rng(seed)
        xyz = rng.random((rows, 3)).astype(np.float32)
        intensity = rng.integers(0, 256, rows).astype(np.uint8)
        columns: dict[str, NDArray[Any]] = {"xyz": xyz, "intensity": intensity}
        return publish_segment(shm, columns, block=PublishBlock(7, 8 + seed), mode=mode)[0]

    return make
