# SPDX-License-Identifier: Apache-2.0
"""The shared-memory directory: nothing appears half done, nothing is left behind."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import pytest

from shmmap.errors import CannotStart, ConfigError
from shmmap.segment.directory import ShmDirectory, is_full, measured_bytes
from shmmap.segment.names import (
    check_instance,
    is_retired,
    retired_name,
    segment_prefix,
    usual_directory,
)
from tests.unit.segment.conftest import Publish


def test_an_unnamed_file_vanishes_with_its_descriptor(shm: ShmDirectory) -> None:
    fd = shm.create()
    os.posix_fallocate(fd, 0, 10_000)
    assert measured_bytes(fd) == 12_288
    assert os.listdir(shm.path) == []
    os.close(fd)
    assert os.listdir(shm.path) == []


def test_published_whole_with_its_mode(shm: ShmDirectory, publish: Publish) -> None:
    for mode in (0o400, 0o440):
        name = publish(mode=mode)
        status = os.stat(f"{shm.path}{name}")
        assert stat.S_IMODE(status.st_mode) == mode  # whatever the umask
        assert status.st_size == status.st_blocks * 512  # whole pages, all there
        assert status.st_nlink == 1


def test_a_name_is_never_taken_twice(shm: ShmDirectory, publish: Publish) -> None:
    name = publish()
    fd = shm.create()
    with pytest.raises(FileExistsError):
        shm.link(fd, name)
    os.close(fd)


def test_rename_unlink_and_list(shm: ShmDirectory, publish: Publish) -> None:
    names = sorted(publish(seed=i) for i in range(3))
    Path(shm.path, "shmmap.unity.0011").touch()
    assert shm.names(segment_prefix("unit")) == names
    assert shm.rename(names[0], retired_name(names[0]))
    assert not shm.rename(names[0], "/elsewhere")
    assert [is_retired(n) for n in shm.names(segment_prefix("unit"))] == [True, False, False]
    assert shm.unlink(retired_name(names[0]))
    assert not shm.unlink(retired_name(names[0]))
    assert shm.names(segment_prefix("unit")) == names[1:]


def test_links_are_not_followed(shm: ShmDirectory) -> None:
    os.symlink("/etc/passwd", f"{shm.path}/shmmap.unit.link")
    with pytest.raises(OSError, match="symbolic"):
        shm.open("/shmmap.unit.link")
    os.unlink(f"{shm.path}/shmmap.unit.link")


@pytest.mark.parametrize("path", ["/no/such/directory", "/etc/passwd", "/proc"])
def test_what_cannot_be_the_directory(path: str) -> None:
    before = os.listdir("/proc/self/fd")
    with pytest.raises(CannotStart) as refusal:
        ShmDirectory(path)
    assert path in str(refusal.value)
    assert os.listdir("/proc/self/fd") == before


def test_full_is_distinguished_from_other_failures() -> None:
    assert is_full(OSError(28, "No space left on device"))
    assert is_full(OSError(122, "Disk quota exceeded"))
    assert not is_full(OSError(13, "Permission denied"))


@pytest.mark.parametrize("name", ["", "a.b", "a/b", "..", "a b", "ä", "x" * 65, "a\n"])
def test_unusable_instance_names(name: str) -> None:
    with pytest.raises(ConfigError):
        check_instance(name)


def test_where_names_are_looked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On huge pages where such a file system is mounted, unless the instance is in /dev/shm."""
    plain, huge = tmp_path / "plain", tmp_path / "huge"
    places = str(plain), str(huge)
    plain.mkdir()
    huge.mkdir()
    assert usual_directory("unit", places) == str(plain)
    monkeypatch.setattr("os.path.ismount", lambda path: path == str(huge))
    assert usual_directory("unit", places) == str(huge)
    (plain / "shmmap.unit.statistics").touch()
    assert usual_directory("unit", places) == str(plain)
    assert usual_directory("another", places) == str(huge)
