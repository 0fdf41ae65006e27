# SPDX-License-Identifier: Apache-2.0
"""Budgets on file systems of given sizes, memory limits of control groups, and memory given back."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest

from shmmap.daemon.host.memory import (
    choose_budget,
    loader_bytes,
    memory_limit_bytes,
    out_of_memory_kills,
)
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
    monkeypatch.setattr("shmmap.daemon.host.memory._memory_bytes", lambda _which: total_gib << 30)
    assert loader_bytes(None if limit_gib is None else limit_gib << 30) == expected_gib << 30


def tree(root: Path, cgroup: str, mounts: str, limits: dict[str, str]) -> str:
    """Make a process's view of a machine; return the machine's root."""
    (root / "proc/self").mkdir(parents=True)
    (root / "proc/self/cgroup").write_text(cgroup)
    (root / "proc/self/mountinfo").write_text(mounts)
    for name, text in limits.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text + "\n")
    return str(root)


V2 = "30 23 0:26 / /cg rw,nosuid shared:4 - cgroup2 cgroup2 rw,nsdelegate\n"
V1 = (
    "35 25 0:30 / /cg/cpu rw - cgroup cgroup rw,cpu,cpuacct\n"
    "36 25 0:31 / /cg/memory rw - cgroup cgroup rw,memory\n"
)


@pytest.mark.parametrize(
    ("limits", "expected"),
    [
        ({"cg/a.slice/b.service/memory.max": "max", "cg/a.slice/memory.max": "max"}, None),
        ({"cg/a.slice/b.service/memory.max": "1000000"}, 1000000),
        ({"cg/a.slice/b.service/memory.max": "3000", "cg/a.slice/memory.max": "2000"}, 2000),
        ({"cg/a.slice/b.service/memory.max": "max", "cg/memory.max": "77"}, 77),
        ({"cg/other/memory.max": "5"}, None),
    ],
)
def test_version_2(tmp_path: Path, limits: dict[str, str], expected: int | None) -> None:
    """The lowest of its own and every one around it."""
    assert memory_limit_bytes(root=tree(tmp_path, "0::/a.slice/b.service\n", V2, limits)) == expected


def test_version_1(tmp_path: Path) -> None:
    group = "5:cpu,cpuacct:/x\n4:memory:/docker/1234\n0::/\n"
    limits = {
        "cg/memory/docker/1234/memory.limit_in_bytes": "67108864",
        "cg/memory/memory.limit_in_bytes": "9223372036854771712",
        "cg/cpu/x/memory.limit_in_bytes": "1",
    }
    assert memory_limit_bytes(root=tree(tmp_path, group, V1, limits)) == 67108864


def test_inside_a_container(tmp_path: Path) -> None:
    """Its own group is what is mounted there."""
    mounts = "36 25 0:31 /docker/1234 /cg/memory rw - cgroup cgroup rw,memory\n"
    limits = {"cg/memory/memory.limit_in_bytes": "5000"}
    assert memory_limit_bytes(root=tree(tmp_path, "4:memory:/docker/1234\n", mounts, limits)) == 5000


@pytest.mark.parametrize("group", ["/../b.service", "/.."])
def test_a_group_outside_of_the_namespace(tmp_path: Path, group: str) -> None:
    limits = {"cg/memory.max": "5000", "b.service/memory.max": "1"}
    assert memory_limit_bytes(root=tree(tmp_path, f"0::{group}\n", V2, limits)) == 5000


def test_nothing_there(tmp_path: Path) -> None:
    assert memory_limit_bytes(root=str(tmp_path)) is None


def test_processes_killed_for_lack_of_memory(tmp_path: Path) -> None:
    (tmp_path / "vmstat").write_text("oom_kill_disable 7\nnr_free_pages 1\noom_kill 3\n")
    assert out_of_memory_kills(str(tmp_path / "vmstat")) == 3
    assert out_of_memory_kills(str(tmp_path / "none")) == 0
    assert out_of_memory_kills() >= 0


PROGRAM: Final = """
import sys
from pathlib import Path
from shmmap.daemon.prerequisites import give_back_large_tables

def own_kib():
    status = Path("/proc/self/status").read_text()
    return int(status.split("RssAnon:")[1].split()[0])

if sys.argv[1] == "large":
    give_back_large_tables()
before = own_kib()
table = b"1" * (8 << 20)
del table
table, later = b"1" * (8 << 20), b"1" * (7 << 20)
del table
print(own_kib() - before - 7 * 1024)
"""


@pytest.mark.parametrize(("which", "given_back"), [("large", True), ("none", False)])
def test_a_large_table_goes_back_whatever_was_made_after_it(which: str, given_back: bool) -> None:
    """And the C library alone would keep it, once one of its size has been freed."""
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, which], stdout=subprocess.PIPE, text=True, check=True, timeout=60.0
    )
    assert (int(done.stdout) < 4096) == given_back
