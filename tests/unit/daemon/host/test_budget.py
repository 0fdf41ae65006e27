# SPDX-License-Identifier: Apache-2.0
"""The choice of a budget, on file systems of given sizes."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from shmmap.daemon.host.budget import choose_budget, loader_bytes
from shmmap.errors import CannotStart, ConfigError
from shmmap.segment.directory import ShmDirectory


class Sized(ShmDirectory):
    """The real directory, on a file system that says it has this size and this much left."""

    def __init__(self, path: str, size: int, free: int) -> None:
        super().__init__(path)
        self._sizes = size, free

    def size_bytes(self) -> int:
        return self._sizes[0]

    def free_bytes(self) -> int:
        return self._sizes[1]


@pytest.fixture
def shm(tmp_path: Path) -> Iterator[str]:
    del tmp_path
    path = f"/dev/shm/shmmap-budget-{os.getpid()}"
    os.mkdir(path)
    yield path
    os.rmdir(path)


def choose(path: str, asked: int, size: int, free: int, limit: int | None = None, ours: int = 0) -> int:
    directory = Sized(path, size, free)
    try:
        return choose_budget(asked, directory, ours_bytes=ours, limit_bytes=limit)
    finally:
        directory.close()


def available() -> int:
    """MemAvailable, bytes."""
    (line,) = [s for s in Path("/proc/meminfo").read_text().splitlines() if s.startswith("MemAvailable")]
    return int(line.split()[1]) * 1024


def test_an_explicit_one_is_taken_as_it_is(shm: str) -> None:
    assert choose(shm, 123 << 20, 1 << 40, 1 << 39) == 123 << 20
    assert choose(shm, 64 << 20, 64 << 20, 64 << 20) == 64 << 20
    assert choose(shm, 1 << 20, 1 << 40, 1 << 39) == 1 << 20


@pytest.mark.parametrize(
    ("asked", "free"), [((64 << 20) + 1, 64 << 20), ((1 << 20) - 1, 1 << 30), (1, 1 << 30)]
)
def test_an_explicit_one_that_cannot_be(shm: str, asked: int, free: int) -> None:
    with pytest.raises(ConfigError) as failure:
        choose(shm, asked, 64 << 20, free)
    assert failure.value.key == "budget"
    assert failure.value.hint


def test_what_does_not_fit_while_others_use_the_file_system_may_fit_later(shm: str) -> None:
    """A service manager tries again, see `CannotStart`."""
    assert choose(shm, 64 << 20, 1 << 30, 64 << 20) == 64 << 20
    for asked, free in (((64 << 20) + 1, 64 << 20), (1 << 30, 0), (0, 0)):
        with pytest.raises(CannotStart, match=re.escape(shm)) as failure:
            choose(shm, asked, 1 << 30, free)
        assert "free some" in failure.value.hint


def test_the_default_is_a_quarter_of_the_memory_and_at_most_4_gib(shm: str) -> None:
    chosen = choose(shm, 0, 1 << 62, 1 << 62)
    assert abs(chosen - min(available() // 4, 4 << 30)) < 512 << 20  # others use memory meanwhile


def test_the_default_shrinks_to_the_file_system(shm: str) -> None:
    """Docker's 64 MB: 5 % stay free; of a large file system at most 256 MiB."""
    assert choose(shm, 0, 64 << 20, 64 << 20) == (64 << 20) - (64 << 20) // 20
    assert choose(shm, 0, 64 << 30, (256 << 20) + (32 << 20)) == 32 << 20
    with pytest.raises(CannotStart):
        choose(shm, 0, 64 << 20, 3 << 20)


def test_a_control_group_that_allows_less(shm: str) -> None:
    """Beyond its limit the kernel kills, so an explicit budget is refused and the default shrinks."""
    assert choose(shm, 0, 1 << 40, 1 << 39, limit=100 << 20) == 50 << 20
    assert choose(shm, 744 << 20, 1 << 40, 1 << 39, limit=1000 << 20) == 744 << 20
    with pytest.raises(ConfigError, match="control group") as failure:
        choose(shm, 745 << 20, 1 << 40, 1 << 39, limit=1000 << 20)
    assert (failure.value.key, failure.value.exit_code) == ("budget", 78)
    assert failure.value.hint


def test_what_an_earlier_life_left_counts_as_free(shm: str) -> None:
    assert choose(shm, 64 << 20, 64 << 20, 4 << 20, ours=60 << 20) == 64 << 20
    with pytest.raises(CannotStart):
        choose(shm, 64 << 20, 64 << 20, 4 << 20, ours=59 << 20)


@pytest.mark.parametrize(
    ("total_gib", "limit_gib", "expected_gib"),
    [(4, None, 2), (16, None, 4), (16, 12, 3), (16, 64, 4), (256, None, 8), (256, 1, 2)],
)
def test_what_a_loader_may_use(
    monkeypatch: pytest.MonkeyPatch, total_gib: int, limit_gib: int | None, expected_gib: int
) -> None:
    monkeypatch.setattr("shmmap.daemon.host.budget._memory_bytes", lambda _which: total_gib << 30)
    assert loader_bytes(None if limit_gib is None else limit_gib << 30) == expected_gib << 30
