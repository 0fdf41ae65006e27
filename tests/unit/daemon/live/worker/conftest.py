# SPDX-License-Identifier: Apache-2.0
"""A served map of a small drive."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.support.served_map import Served


@pytest.fixture
def shm() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(dir="/dev/shm") as path:
        yield Path(path)


@pytest.fixture
def serve(shm: Path, tmp_path: Path) -> Iterator[Callable[..., Served]]:
    """Begin lives of one map, ``serve(budget_bytes, linger_s=..., ...)``; `Served.end` ends them."""
    begun: list[Served] = []

    def factory(budget_bytes: int = 10**9, **limits: Any) -> Served:
        for earlier in begun:
            earlier.map.live.close()
        begun.append(Served(shm, tmp_path / "map", budget_bytes, **limits))
        return begun[-1]

    yield factory
    for one in begun:
        one.map.live.close()
