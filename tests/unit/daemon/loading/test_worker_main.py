# SPDX-License-Identifier: Apache-2.0
"""Loaders and the process that they are forked from, over their socket pairs."""

from __future__ import annotations

import contextlib
import errno
import os
import resource
import signal
import socket
import struct
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest

import shmmap
from shmmap.daemon.loading import parent_main, worker_messages
from shmmap.daemon.loading.worker_main import WorkerSettings
from shmmap.processes.start_child import MAX_PACKET_BYTES
from shmmap.segment.directory import ShmDirectory
from shmmap.segment.header import PublishBlock
from shmmap.segment.pins import prepare_process
from shmmap.segment.version import Source
from tests.support.daemon_process import until, wait_ended, wait_readable
from tests.support.divided_map import random_points, write_ascii, write_pcd

BOX = (0.0, 0.0, 20.0, 20.0)
TIMEOUT_S = 60.0
ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join(part for part in sys.path if part)}
COMMAND = [sys.executable, "-m", "shmmap.daemon.loading.parent_main"]


class Parent:
    """The process that loaders are forked from, and our end of its channel."""

    def __init__(self, shm_dir: str, memory_bytes: int = 2 << 30, **environment: str) -> None:
        self.shm_dir = shm_dir
        self.channel, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.channel.settimeout(TIMEOUT_S)
        self.process = subprocess.Popen(
            [*COMMAND, str(theirs.fileno()), str(os.getpid())],
            pass_fds=(theirs.fileno(),),
            env={**ENVIRONMENT, "OPENBLAS_NUM_THREADS": "1", **environment},
            stderr=subprocess.DEVNULL,
        )
        theirs.close()
        self.channel.send(f"{shm_dir}\0{memory_bytes}".encode())
        assert self.channel.recv(100).decode() == shmmap.__version__

    def fork(self) -> Loader:
        """Fork a loader."""
        return Loader(self)

    def descriptors(self) -> dict[int, str]:
        """Return its descriptors, and what they are."""
        folder = f"/proc/{self.process.pid}/fd"
        return {int(name): os.readlink(f"{folder}/{name}") for name in os.listdir(folder)}

    def end(self) -> int:
        """Close its channel, wait for its end."""
        self.channel.close()
        try:
            return self.process.wait(TIMEOUT_S)
        finally:
            self.process.kill()
            self.process.wait()


class Loader:
    """One loader process and our end of its channel."""

    def __init__(self, parent: Parent) -> None:
        self.shm_dir, self.segments = parent.shm_dir, dict[int, int]()
        self.channel, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.channel.settimeout(TIMEOUT_S)
        with theirs:
            socket.send_fds(parent.channel, [b"loader"], [theirs.fileno()])
        ready, self.pidfd = self.receive()
        assert isinstance(ready, worker_messages.Ready)
        self.pid = ready.pid

    def send(self, message: msgspec.Struct) -> None:
        """Send a message, and a file with a job."""
        packet = worker_messages.encode(message)
        if isinstance(message, worker_messages.Job):
            fd = self.segments[message.number] = os.open(self.shm_dir, os.O_TMPFILE | os.O_RDWR, 0o400)
            socket.send_fds(self.channel, [packet], [fd])
        else:
            self.channel.send(packet)

    def receive(self) -> tuple[worker_messages.FromWorker, int]:
        """Return the next message; with `worker_messages.Done` the segment, the caller's to close."""
        data, fds, _, _ = socket.recv_fds(self.channel, MAX_PACKET_BYTES, 1)
        assert data, "the loader closed its channel"
        message = worker_messages.decode_from_worker(data)
        if isinstance(message, worker_messages.Compiling):  # once on a machine
            return self.receive()
        assert bool(fds) is isinstance(message, worker_messages.Ready)
        if isinstance(message, worker_messages.Failed):
            os.close(self.segments.pop(message.number))
        if isinstance(message, worker_messages.Done):
            return message, self.segments.pop(message.number)
        return message, fds[0] if fds else -1

    def done(self, number: int = 1) -> worker_messages.Done:
        """Receive the end of a job that made a segment, and close that."""
        message, fd = self.receive()
        os.close(fd)
        assert isinstance(message, worker_messages.Done)
        assert message.number == number
        return message

    def load(self, number: int, path: Path, granted: int = 1 << 30) -> None:
        self.send(worker_messages.Job(number, str(path), Source(str(path)), "points", BOX, "map", granted))

    def peak_bytes(self) -> int:
        for line in Path(f"/proc/{self.pid}/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
        raise AssertionError("no VmHWM")

    def ended(self) -> int:
        """Receive how it ended; nothing comes after that."""
        while not isinstance(message := self.receive()[0], worker_messages.Ended):
            pass
        assert self.channel.recv(100) == b"", "another process holds its end of the channel"
        return message.code

    def end(self) -> int:
        """Have it end by itself; returns its exit code."""
        self.channel.shutdown(socket.SHUT_WR)
        try:
            return self.ended()
        finally:
            self.close()

    def close(self) -> None:
        """Close our end."""
        self.channel.close()
        for fd in (self.pidfd, *self.segments.values()):
            os.close(fd)


@pytest.fixture
def shm_dir() -> Iterator[str]:
    prepare_process()
    path = tempfile.mkdtemp(prefix="shmmap-worker-", dir="/dev/shm")
    yield path
    assert os.listdir(path) == [], "a loader publishes nothing"
    os.rmdir(path)


@pytest.fixture
def parent(shm_dir: str) -> Iterator[Parent]:
    one = Parent(shm_dir)
    yield one
    assert one.end() == 0


@pytest.fixture
def loader(parent: Parent) -> Iterator[Loader]:
    one = parent.fork()
    yield one
    one.close()


def cell(path: Path, points: int) -> Path:
    write_pcd(path, random_points(np.random.default_rng(points), (0, 0), points))
    return path


@pytest.mark.parametrize("granted", [True, False])
def test_more_bytes_than_granted(loader: Loader, tmp_path: Path, granted: bool) -> None:
    """It asks, and waits for the answer though other jobs come first; those are done afterwards, in order."""
    loader.load(1, write_ascii(tmp_path / "a.pcd", 5000), 8192)
    need, _ = loader.receive()
    assert isinstance(need, worker_messages.Need)
    assert need.number == 1
    assert need.bytes % 4096 == 0
    assert 5000 * 12 < need.bytes <= 5000 * 12 + 2 * 4096
    for number in (2, 3):
        loader.load(number, cell(tmp_path / f"{number}.pcd", 10))
    assert wait_readable([loader.channel.fileno()], 0.0) == []
    loader.send(worker_messages.Decision(granted))
    first, fd = loader.receive()
    if granted:
        assert isinstance(first, worker_messages.Done)
        assert os.fstat(fd).st_blocks * 512 <= need.bytes
        os.close(fd)
    else:
        assert isinstance(first, worker_messages.Failed)
        assert (first.number, first.code, fd) == (1, "over_budget", -1)
    for number in (2, 3):
        loader.done(number)


@pytest.mark.parametrize("times", [1, 2])
def test_a_file_that_is_rewritten_while_it_is_read_is_read_once_more(
    loader: Loader, tmp_path: Path, times: int
) -> None:
    """And only once: one that is written all the time fails."""
    path = write_ascii(tmp_path / "a.pcd", 5000)
    loader.load(1, path, 8192)
    for more in range(1, times + 1):
        assert isinstance(loader.receive()[0], worker_messages.Need)
        write_ascii(path, 5000 + 5000 * more)
        loader.send(worker_messages.Decision(True))
    if times == 1:
        assert isinstance(loader.receive()[0], worker_messages.Need)
        loader.send(worker_messages.Decision(True))
        assert loader.done().points == 10_000
    else:
        failed, _ = loader.receive()
        assert isinstance(failed, worker_messages.Failed)
        assert failed.code == "load_failed"


def test_the_channel_closes_while_it_waits_for_room(loader: Loader, tmp_path: Path) -> None:
    loader.load(1, write_ascii(tmp_path / "a.pcd", 5000), 8192)
    assert isinstance(loader.receive()[0], worker_messages.Need)
    loader.channel.shutdown(socket.SHUT_WR)
    assert loader.ended() == 0


def test_it_ignores_the_keyboard(loader: Loader, tmp_path: Path) -> None:
    """Ctrl-C reaches the whole foreground group; what to do about it is the daemon's business."""
    os.kill(loader.pid, signal.SIGINT)
    loader.load(1, cell(tmp_path / "a.pcd", 10))
    loader.done()


def compressed(path: Path, points: int) -> Path:
    """Write zeros, packed: LZF makes 264 bytes of three."""
    runs, rest = divmod((points - 1) * 12, 264)
    assert not rest
    body = b"\x0b" + bytes(12) + b"\xe0\xff\0" * runs
    header = (
        "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
        f"WIDTH {points}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {points}\nDATA binary_compressed\n"
    )
    path.write_bytes(header.encode() + struct.pack("<II", len(body), points * 12) + body)
    return path


def test_a_cell_that_takes_too_much_memory_fails_alone(shm_dir: str, tmp_path: Path) -> None:
    parent = Parent(shm_dir, 256 << 20)
    try:
        one = parent.fork()
        large = compressed(tmp_path / "large.pcd", 22 * 1_600_000 + 1)
        one.load(1, large, 1 << 40)
        one.load(2, cell(tmp_path / "good.pcd", 10))
        failed, _ = one.receive()
        assert isinstance(failed, worker_messages.Failed)
        assert (failed.number, failed.code) == (1, "load_failed")
        assert str(large) in failed.message
        assert "256 MiB of memory that a loader may use (divide the map" in failed.message
        one.done(2)
        assert one.peak_bytes() < 256 << 20
        one.close()
    finally:
        parent.end()


FORKED = """
import socket, sys
from shmmap.daemon.loading.prepared_parent import fork_early
import threading
process, channel = fork_early()
print(process.pid, flush=True)
sys.stdin.readline()
event = threading.Event()
threading.Thread(target=event.wait, daemon=True).start()
assert fork_early() is None, "another thread may hold a lock"
channel.send(sys.argv[1].replace("|", "\\0").encode())
assert channel.recv(100)
print("ready", flush=True)
sys.stdin.readline()
"""


def _opened(pid: int) -> list[str]:
    """What a process has open, sorted."""
    opened = []
    for descriptor in Path(f"/proc/{pid}/fd").iterdir():
        with contextlib.suppress(FileNotFoundError):  # closed meanwhile
            opened.append(os.readlink(descriptor).partition(":")[0])
    return sorted(opened)


def test_the_first_parent_is_a_fork_of_the_daemon(shm_dir: str) -> None:
    """It has nothing that was open, in a session of its own, and ends with the daemon."""
    with tempfile.TemporaryFile() as inherited:
        os.set_inheritable(inherited.fileno(), True)
        daemon = subprocess.Popen(
            [sys.executable, "-c", FORKED, f"{shm_dir}|{2 << 30}"],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, pass_fds=(inherited.fileno(),),
            env={**ENVIRONMENT, "OPENBLAS_NUM_THREADS": "1"},
        )  # fmt: skip
    assert daemon.stdin is not None
    assert daemon.stdout is not None
    with daemon, daemon.stdin, daemon.stdout:
        parent = int(daemon.stdout.readline())
        daemon.stdin.write("go on\n")
        daemon.stdin.flush()
        assert daemon.stdout.readline() == "ready\n"
        # it is ready before it has looked into the directory of compiled kernels, which it closes again
        until(lambda: len(_opened(parent)) == 4, lambda: f"{_opened(parent)}: not 2 null, stderr, channel")
        assert _opened(parent)[:2] == ["/dev/null", "/dev/null"]
        assert (os.getsid(parent), os.readlink(f"/proc/{parent}/cwd")) == (parent, "/")
        assert private_bytes(parent) < 60 << 20
        daemon.kill()
    assert wait_ended(parent, TIMEOUT_S)


def test_a_parent_that_started_too_late_ends_at_once() -> None:
    """Its parent is another process: the daemon died before the kernel was asked to signal that."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, theirs:
        code = subprocess.run(
            [*COMMAND, str(theirs.fileno()), "1"],
            pass_fds=(theirs.fileno(),),
            env=ENVIRONMENT,
            check=False,
        ).returncode
    assert code == 0


def private_bytes(pid: int) -> int:
    lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    return 1024 * sum(int(line.split()[1]) for line in lines if line.startswith("Private_"))


def mapped(pid: int, *names: str) -> list[str]:
    maps = Path(f"/proc/{pid}/maps").read_text()
    return [name for name in names if name in maps]


HEAVY = ("/open3d/", "/numba/", "/scipy/", "libzmq")


def test_the_parent_can_be_forked_at_any_time(parent: Parent, loader: Loader, shm_dir: str) -> None:
    """It has one thread and nothing of any segment; what a loader has of its own is little."""
    pid = parent.process.pid
    assert os.listdir(f"/proc/{pid}/task") == [str(pid)]
    assert mapped(pid, shm_dir, *HEAVY) == []
    assert not [name for name in parent.descriptors().values() if name.startswith("/dev/shm")]
    assert private_bytes(pid) < 60 << 20
    assert private_bytes(loader.pid) < 20 << 20


def test_idle_a_loader_is_small_and_polite(parent: Parent) -> None:
    """A loader stays once started; numpy alone is some 30 MB."""
    (control,) = [name for name in parent.descriptors().values() if name.startswith("socket:")]
    loader = parent.fork()
    pid = loader.pid
    assert loader.peak_bytes() < 100 << 20
    assert os.getpriority(os.PRIO_PROCESS, pid) >= min(19, os.getpriority(os.PRIO_PROCESS, 0) + 1)
    assert os.getsid(pid) == os.getpgid(pid) == pid
    assert int(Path(f"/proc/{pid}/oom_score_adj").read_text()) >= 500
    assert mapped(pid, *HEAVY) == []
    opened = set()
    for fd in os.listdir(f"/proc/{pid}/fd"):
        with contextlib.suppress(FileNotFoundError):  # it was open while they were listed
            opened.add(os.readlink(f"/proc/{pid}/fd/{fd}"))
    assert opened
    assert control not in opened
    loader.close()


def test_how_a_loader_ended_is_reported_after_all_that_it_sent(parent: Parent, tmp_path: Path) -> None:
    """No other process holds its channel: neither loaders forked before it, nor those after it."""
    before, one, after = parent.fork(), parent.fork(), parent.fork()
    one.load(1, cell(tmp_path / "a.pcd", 10))
    assert wait_readable([one.channel.fileno()], TIMEOUT_S)
    signal.pidfd_send_signal(one.pidfd, signal.SIGKILL)
    assert wait_readable([one.pidfd], TIMEOUT_S)
    one.done()
    assert one.ended() == -signal.SIGKILL
    one.close()
    for other in (before, after):
        other.load(2, cell(tmp_path / "b.pcd", 10))
        other.done(2)
        assert other.end() == 0


def test_a_loader_that_cannot_be_watched_is_none(parent: Parent) -> None:
    """Its parent has no descriptor left for its pidfd: it reports that, and goes on."""
    pid = parent.process.pid
    limits = resource.prlimit(pid, resource.RLIMIT_NOFILE)
    free = min(set(range(64)) - set(parent.descriptors()))
    resource.prlimit(pid, resource.RLIMIT_NOFILE, (free + 1, limits[1]))  # only one more: the channel
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    ours.settimeout(TIMEOUT_S)
    with ours:
        with theirs:
            socket.send_fds(parent.channel, [b"loader"], [theirs.fileno()])
        said = []
        while data := ours.recv(1000):
            said.append(worker_messages.decode_from_worker(data))
    assert said[-1] == worker_messages.Ended(-1, "pidfd_open: Too many open files")
    resource.prlimit(pid, resource.RLIMIT_NOFILE, limits)
    assert parent.fork().end() == 0


def test_a_parent_that_cannot_compile_goes_on(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """There is no process left for the child that compiles kernels: loaders do it."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    monkeypatch.setattr(parent_main, "compiled_mark", lambda: tmp_path / "none")
    forks: list[int] = []

    def no_process() -> int:
        forks.append(os.getpid())
        raise BlockingIOError(errno.EAGAIN, "none left")

    monkeypatch.setattr(os, "fork", no_process)
    with theirs:
        ours.close()
        parent_main._Parent(theirs, WorkerSettings(str(tmp_path))).run()
    assert len(forks) == 1


def test_a_layer_is_made_of_points_in_memory_while_they_are_of_the_file_s_state(
    loader: Loader, shm_dir: str, tmp_path: Path
) -> None:
    path = cell(tmp_path / "cell.pcd", 400)
    loader.load(1, path)
    done, fd = loader.receive()
    assert isinstance(done, worker_messages.Done)
    directory = ShmDirectory(shm_dir)
    segment = "/shmmap.test.0123456789abcdef"
    block = PublishBlock(1, 2)
    directory.publish(fd, segment, block=block, header_bytes=done.header_bytes, mode=0o600, gid=-1)
    os.close(fd)
    with open(f"{shm_dir}{segment}", "r+b") as file:  # other points than the file's: what is read shows
        file.seek(done.header_bytes)
        file.write(np.full((400, 3), 0.25, "<f4").tobytes())

    def voxels(number: int) -> int:
        loader.send(
            worker_messages.Job(
                number, str(path), Source(str(path)), "voxel(leaf=1.0)", BOX, "map", 1 << 30, segment
            )
        )
        return loader.done(number).points

    try:
        assert voxels(2) == 1
        cell(path, 401)
        assert voxels(3) > 300
    finally:
        directory.unlink(segment)
        directory.close()
    cell(path, 400)
    assert voxels(4) > 300
