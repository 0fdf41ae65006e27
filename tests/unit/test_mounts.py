# SPDX-License-Identifier: Apache-2.0
"""Mounts and control groups of this process, read from the kernel's files."""

from __future__ import annotations

from pathlib import Path

import pytest

from shmmap.mounts import Mount, mount_of, mounts

LINES = (
    "22 1 0:20 / / rw - ext4 /dev/sda1 rw\n"
    "30 22 0:30 / /maps rw shared:1 - nfs4 server:/maps rw,vers=4\n"
    "31 22 0:31 / /maps\\040néw rw - xfs /dev/sdb1 rw\n"
    "32 22 0:32 /sub /maps rw - ext3 /dev/sdc1 rw\n"
)


@pytest.fixture
def machine(tmp_path: Path) -> str:
    """A machine with these mounts."""
    path = tmp_path / "proc/self/mountinfo"
    path.parent.mkdir(parents=True)
    path.write_text(LINES)
    return str(tmp_path)


def test_every_mount_is_given(machine: str, tmp_path: Path) -> None:
    found = list(mounts(machine))
    assert found[1] == Mount("nfs4", "/", "/maps", ["rw", "vers=4"])
    assert (found[2].point, found[3].root) == ("/maps néw", "/sub")
    assert list(mounts(str(tmp_path / "none"))) == []
    assert mount_of("/maps", str(tmp_path / "none")).kind == "unknown"


@pytest.mark.parametrize(
    ("path", "kind"), [("/", "ext4"), ("/mapsets", "ext4"), ("/maps/town", "ext3"), ("/maps néw/a", "xfs")]
)
def test_the_innermost_mount_counts_and_the_last_at_one_place(path: str, kind: str, machine: str) -> None:
    assert mount_of(path, machine).kind == kind


def test_file_systems_of_this_machine() -> None:
    assert [mount_of(path).kind for path in ("/proc/self", "/dev/shm")] == ["proc", "tmpfs"]


@pytest.mark.parametrize(
    ("options", "expected"),
    [("rw", ""), ("rw,huge=advise", ""), ("rw,huge=never", ""), ("rw,huge=always", "huge=always")],
)
def test_which_mounts_have_huge_pages(options: str, expected: str) -> None:
    assert Mount("tmpfs", "/", "/dev/shm", options.split(",")).huge_pages == expected
