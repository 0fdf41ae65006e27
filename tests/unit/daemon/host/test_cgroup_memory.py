# SPDX-License-Identifier: Apache-2.0
"""The memory limit of a control group, on trees as the kernel shows them."""

from __future__ import annotations

from pathlib import Path

import pytest

from shmmap.daemon.host.cgroup_memory import memory_limit_bytes, out_of_memory_kills


def tree(root: Path, cgroup: str, mounts: str, limits: dict[str, str]) -> str:
    """Make a process's view; ``@`` in ``mounts`` stands for the root."""
    (root / "proc").mkdir()
    (root / "proc/cgroup").write_text(cgroup)
    (root / "proc/mountinfo").write_text(mounts.replace("@", str(root)))
    for name, text in limits.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text + "\n")
    return str(root / "proc")


V2 = "30 23 0:26 / @/cg rw,nosuid shared:4 - cgroup2 cgroup2 rw,nsdelegate\n"
V1 = (
    "35 25 0:30 / @/cg/cpu rw - cgroup cgroup rw,cpu,cpuacct\n"
    "36 25 0:31 / @/cg/memory rw - cgroup cgroup rw,memory\n"
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
    assert memory_limit_bytes(tree(tmp_path, "0::/a.slice/b.service\n", V2, limits)) == expected


def test_version_1(tmp_path: Path) -> None:
    group = "5:cpu,cpuacct:/x\n4:memory:/docker/1234\n0::/\n"
    limits = {
        "cg/memory/docker/1234/memory.limit_in_bytes": "67108864",
        "cg/memory/memory.limit_in_bytes": "9223372036854771712",
        "cg/cpu/x/memory.limit_in_bytes": "1",
    }
    assert memory_limit_bytes(tree(tmp_path, group, V1, limits)) == 67108864


def test_inside_a_container(tmp_path: Path) -> None:
    """Its own group is what is mounted there."""
    mounts = "36 25 0:31 /docker/1234 @/cg/memory rw - cgroup cgroup rw,memory\n"
    limits = {"cg/memory/memory.limit_in_bytes": "5000"}
    assert memory_limit_bytes(tree(tmp_path, "4:memory:/docker/1234\n", mounts, limits)) == 5000


def test_nothing_there(tmp_path: Path) -> None:
    assert memory_limit_bytes(str(tmp_path)) is None


def test_of_this_process() -> None:
    limit = memory_limit_bytes()
    assert limit is None or limit > 1 << 20


def test_processes_killed_for_lack_of_memory(tmp_path: Path) -> None:
    (tmp_path / "vmstat").write_text("oom_kill_disable 7\nnr_free_pages 1\noom_kill 3\n")
    assert out_of_memory_kills(str(tmp_path / "vmstat")) == 3
    assert out_of_memory_kills(str(tmp_path / "none")) == 0
    assert out_of_memory_kills() >= 0
