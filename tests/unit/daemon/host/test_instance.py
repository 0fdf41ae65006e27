# SPDX-License-Identifier: Apache-2.0
"""One daemon per instance, whatever becomes of the lock's file; what a stop before serving takes away."""

from __future__ import annotations

import fcntl
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from shmmap.daemon.host.instance import InstanceLock, stopped_early
from shmmap.daemon.host.signals import StartSignals
from shmmap.errors import CannotStart, InstanceBusy
from shmmap.segment.directory import ShmDirectory
from shmmap.statistics.exclusive_name import hold, take_name

HOLDER = """
import sys
from shmmap.daemon.host.instance import InstanceLock
lock = InstanceLock(sys.argv[1])
print("locked", flush=True)
sys.stdin.readline()
lock.release()
print("released", flush=True)
"""


def holder(path: Path) -> subprocess.Popen[str]:
    """Start another process that takes the lock."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(part for part in sys.path if part)},
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "locked\n"
    return process


def end(process: subprocess.Popen[str], number: signal.Signals = signal.SIGKILL) -> None:
    process.send_signal(number)
    process.wait()
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            pipe.close()


@pytest.mark.parametrize("left", [b"", b"1\n", b"99999999", bytes(16)])
def test_what_a_daemon_or_a_power_cut_left_is_replaced(tmp_path: Path, left: bytes) -> None:
    path = tmp_path / "a.lock"
    path.write_bytes(left)
    lock = InstanceLock(str(path))
    assert path.read_text() == f"{os.getpid()}\n"
    lock.release()
    assert not path.exists()


@pytest.mark.parametrize("left", ["", "1\n"])
def test_refused_for_another_reason(tmp_path: Path, left: str) -> None:
    """Nothing is changed: the file may be another program's after all."""
    path = tmp_path / "a.lock"
    if left:
        path.write_text(left)

    def check() -> None:
        raise InstanceBusy("its socket is in use")

    with pytest.raises(InstanceBusy, match="its socket"):
        InstanceLock(str(path), check)
    assert (path.read_text() if path.exists() else "") == left


def test_a_lock_that_is_no_file(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.lock")
    with pytest.raises(CannotStart, match="the lock file cannot be"):
        InstanceLock(str(tmp_path / "a.lock"))
    assert (tmp_path / "a.lock").is_fifo()


def test_a_lock_file_that_a_cleaner_removed(tmp_path: Path) -> None:
    """It is made again, and hinders a second daemon as before."""
    path = tmp_path / "a.lock"
    lock = InstanceLock(str(path))
    assert path.stat().st_mode & 0o777 == 0o600
    path.unlink()
    lock.restore()
    lock.restore()
    with pytest.raises(InstanceBusy, match=f"pid {os.getpid()}"):
        InstanceLock(str(path))
    lock.release()
    assert not path.exists()


def test_a_predecessor_whose_file_was_removed_leaves_its_successor_s_alone(tmp_path: Path) -> None:
    path = tmp_path / "a.lock"
    first = InstanceLock(str(path))
    path.unlink()
    second = holder(path)
    try:
        first.release()
        assert path.exists()
        with pytest.raises(InstanceBusy):
            InstanceLock(str(path))
        assert second.stdin is not None
        assert second.stdout is not None
        second.stdin.write("\n")
        second.stdin.flush()
        assert second.stdout.readline() == "released\n"
        assert not path.exists()
    finally:
        end(second)


def test_where_no_file_can_be(tmp_path: Path) -> None:
    (tmp_path / "elsewhere").write_text("precious")
    (tmp_path / "link.lock").symlink_to(tmp_path / "elsewhere")
    for path in (tmp_path / "missing" / "a.lock", tmp_path / "link.lock", tmp_path / "elsewhere", tmp_path):
        with pytest.raises(CannotStart, match=f"the lock file cannot be {path}: "):
            InstanceLock(str(path))
    assert (tmp_path / "elsewhere").read_text() == "precious"


@pytest.mark.root
@pytest.mark.parametrize("held", [False, True])
def test_another_user_s_file_is_no_daemon(tmp_path: Path, held: bool) -> None:
    """Where all users may make files another one may have made it, and locked it."""
    path = tmp_path / "a.lock"
    path.write_text("1\n")
    os.chown(path, 12345, -1)
    with path.open() as file:
        if held:
            fcntl.flock(file, fcntl.LOCK_EX)
        with pytest.raises(CannotStart) as failure:
            InstanceLock(str(path))
    assert failure.value.message == f"the lock file cannot be {path}: there is a file of uid 12345"
    assert failure.value.hint.startswith(f"see whose it is and remove it: `sudo rm {path}`; or ")
    assert path.read_text() == "1\n"


LEFT = "shmmap.unit.0123456789abcdef"


@pytest.fixture
def signals() -> StartSignals:
    """Return signals of a daemon that starts; this process keeps its own handlers."""
    one = StartSignals.__new__(StartSignals)
    one.keep = False
    return one


@pytest.fixture
def shm(tmp_path: Path) -> Iterator[ShmDirectory]:
    directory = ShmDirectory(str(tmp_path))
    yield directory
    directory.close()


def test_what_a_previous_run_left(shm: ShmDirectory, signals: StartSignals) -> None:
    for name in (LEFT, "shmmap.unit.statistics", "shmmap.another.0123456789abcdef"):
        Path(shm.path, name).touch()
    stopped_early(signals, shm, "unit", None)
    stopped_early(signals, shm, "unit", RuntimeError)
    assert len(os.listdir(shm.path)) == 3
    signals.keep = True
    stopped_early(signals, shm, "unit", SystemExit)
    assert len(os.listdir(shm.path)) == 3
    signals.keep = False
    stopped_early(signals, shm, "unit", SystemExit)
    assert os.listdir(shm.path) == ["shmmap.another.0123456789abcdef"]


def test_the_names_of_a_daemon_that_serves_stay(shm: ShmDirectory, signals: StartSignals) -> None:
    """Both found them free, and the other one was quicker."""
    Path(shm.path, LEFT).touch()
    fd = shm.create()
    hold(fd)
    take_name(shm, "unit", fd)
    stopped_early(signals, shm, "unit", SystemExit)
    assert sorted(os.listdir(shm.path)) == [LEFT, "shmmap.unit.statistics"]
    os.close(fd)
    stopped_early(signals, shm, "unit", SystemExit)
    assert os.listdir(shm.path) == []
