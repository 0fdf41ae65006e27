# SPDX-License-Identifier: Apache-2.0
"""What is mounted where, and which file system a path is on."""

from __future__ import annotations

from pathlib import Path

import pytest

from shmmap.daemon.host import mounts as module
from shmmap.daemon.host.mounts import Mount, file_system_of, mounts

LINES = (
    "22 1 0:20 / / rw - ext4 /dev/sda1 rw\n"
    "30 22 0:30 / /maps rw shared:1 - nfs4 server:/maps rw,vers=4\n"
    "31 22 0:31 / /maps\\040néw rw - xfs /dev/sdb1 rw\n"
    "32 22 0:32 /sub /maps rw - ext3 /dev/sdc1 rw\n"
)


def test_every_mount_is_given(tmp_path: Path) -> None:
    (tmp_path / "mountinfo").write_text(LINES)
    found = list(mounts(str(tmp_path / "mountinfo")))
    assert found[1] == Mount("nfs4", "/", "/maps", ["rw", "vers=4"])
    assert (found[2].point, found[3].root) == ("/maps néw", "/sub")
    assert list(mounts(str(tmp_path / "none"))) == []


@pytest.mark.parametrize(
    ("path", "kind"), [("/", "ext4"), ("/mapsets", "ext4"), ("/maps/town", "ext3"), ("/maps néw/a", "xfs")]
)
def test_the_innermost_mount_counts_and_the_last_at_one_place(
    path: str, kind: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "mountinfo").write_text(LINES)
    found = list(mounts(str(tmp_path / "mountinfo")))
    monkeypatch.setattr(module, "mounts", lambda: iter(found))
    assert file_system_of(path) == kind


def test_this_machine_is_told_apart() -> None:
    assert file_system_of("/proc/self") == "proc"
    assert file_system_of("/dev/shm") == "tmpfs"
