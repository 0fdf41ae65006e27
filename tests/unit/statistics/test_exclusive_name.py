# SPDX-License-Identifier: Apache-2.0
"""One writer of an instance's statistics in a directory, whatever others do to the file or its name."""

from __future__ import annotations

import fcntl
import os
import struct
import subprocess
import sys
from pathlib import Path

import pytest

from shmmap.errors import CannotStart, InstanceBusy
from shmmap.segment.directory import ShmDirectory
from shmmap.segment.names import statistics_name
from shmmap.statistics import exclusive_name
from shmmap.statistics.exclusive_name import has_writer, hold, refuse_second, take_name
from shmmap.statistics.identity import DaemonIdentity
from shmmap.statistics.writer import StatisticsWriter

NAME = statistics_name("unit")
READ_LOCK = struct.pack("@hhqqi4x", fcntl.F_RDLCK, 0, 0, 0, 0)
SET_LOCK = 37  # F_OFD_SETLK


def held_file(shm: ShmDirectory) -> int:
    """Return a file without a name, held as a writer does."""
    fd = shm.create()
    hold(fd)
    return fd


def test_a_second_writer_is_refused_and_the_first_named(
    shm: ShmDirectory, identity: DaemonIdentity, writer: StatisticsWriter
) -> None:
    first = os.stat(shm.path + NAME).st_ino
    for attempt in (
        lambda: refuse_second(shm, "unit"),
        lambda: StatisticsWriter(shm, "unit", identity),
    ):
        with pytest.raises(InstanceBusy, match=f"pid {os.getpid()}, listening at /run/") as failure:
            attempt()
        assert failure.value.exit_code == 75
    assert os.stat(shm.path + NAME).st_ino == first
    assert len(os.listdir(shm.path)) == 1
    refuse_second(shm, "another")
    del writer


def test_what_a_killed_writer_left_is_replaced(shm: ShmDirectory, identity: DaemonIdentity) -> None:
    code = (
        "import os, signal, sys\n"
        "from shmmap.segment.directory import ShmDirectory\n"
        "from shmmap.statistics.exclusive_name import hold, take_name\n"
        "shm = ShmDirectory(sys.argv[1]); fd = shm.create(); hold(fd); take_name(shm, 'unit', fd)\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    subprocess.run([sys.executable, "-c", code, shm.path], check=False)
    left = os.stat(shm.path + NAME).st_ino
    assert not has_writer(shm, NAME)
    writer = StatisticsWriter(shm, "unit", identity)
    assert os.stat(shm.path + NAME).st_ino != left
    assert has_writer(shm, NAME)
    writer.close()
    assert os.listdir(shm.path) == []


def test_a_reader_s_lock_makes_no_writer(shm: ShmDirectory) -> None:
    """A process that may only read the file gets read locks and flocks: a dead daemon's name stays free."""
    ours = held_file(shm)
    take_name(shm, "unit", ours)
    with shm.opened(NAME) as reading:
        os.close(ours)
        fcntl.fcntl(reading, SET_LOCK, READ_LOCK)
        fcntl.flock(reading, fcntl.LOCK_EX)
        with pytest.raises(OSError, match="Bad file"):
            fcntl.fcntl(reading, SET_LOCK, struct.pack("@hhqqi4x", fcntl.F_WRLCK, 0, 0, 0, 0))
        assert not has_writer(shm, NAME)
        successor = held_file(shm)
        take_name(shm, "unit", successor)
        assert has_writer(shm, NAME)
        os.close(successor)
    os.unlink(shm.path + NAME)


@pytest.mark.root
def test_another_account_s_lock_makes_no_writer(shm: ShmDirectory) -> None:
    fd = os.open(shm.path + NAME, os.O_RDWR | os.O_CREAT, 0o666)
    os.fchown(fd, 12345, -1)
    hold(fd)
    assert not has_writer(shm, NAME)
    refuse_second(shm, "unit")
    os.close(fd)
    os.unlink(shm.path + NAME)


def test_something_that_is_no_file(shm: ShmDirectory) -> None:
    path = Path(shm.path + NAME)
    for kind in ("pipe", "link"):
        if kind == "pipe":
            os.mkfifo(path)
        else:
            path.symlink_to("/etc/passwd")
        assert not has_writer(shm, NAME)
        ours = held_file(shm)
        take_name(shm, "unit", ours)
        assert has_writer(shm, NAME)
        os.close(ours)
        path.unlink()


def test_one_that_comes_between_the_look_and_the_renaming_keeps_the_name(
    shm: ShmDirectory, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both saw the dead one; removing by name would remove the quicker one's file."""
    dead, quicker, slower = held_file(shm), held_file(shm), held_file(shm)
    take_name(shm, "unit", dead)
    os.close(dead)
    rename = ShmDirectory.rename

    def later(self: ShmDirectory, old: str, new: str) -> bool:
        monkeypatch.setattr(ShmDirectory, "rename", rename)
        take_name(self, "unit", quicker)
        return rename(self, old, new)

    monkeypatch.setattr(ShmDirectory, "rename", later)
    with pytest.raises(InstanceBusy):
        take_name(shm, "unit", slower)
    assert os.stat(shm.path + NAME).st_ino == os.fstat(quicker).st_ino
    assert os.listdir(shm.path) == [NAME.lstrip("/")]
    os.unlink(shm.path + NAME)
    for fd in (quicker, slower):
        os.close(fd)


def test_a_name_that_is_made_repeatedly_is_an_error_after_some_time(
    shm: ShmDirectory, monkeypatch: pytest.MonkeyPatch
) -> None:
    ours = held_file(shm)
    os.mkfifo(shm.path + NAME)
    unlink = ShmDirectory.unlink

    def and_again(self: ShmDirectory, name: str) -> bool:
        os.mkfifo(self.path + NAME)
        return unlink(self, name)

    monkeypatch.setattr(ShmDirectory, "unlink", and_again)
    with pytest.raises(CannotStart, match="there is a pipe of user"):
        take_name(shm, "unit", ours)
    os.close(ours)
    os.unlink(shm.path + NAME)
    assert exclusive_name._ATTEMPTS > 2
