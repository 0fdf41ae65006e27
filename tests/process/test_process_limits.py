# SPDX-License-Identifier: Apache-2.0
"""Clients in processes that may have no more descriptors or threads: refused by the limit's name."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import shmmap
from shmmap.errors import LimitReached
from shmmap.segment.process_limits import check_files, check_threads
from tests.support.daemon_process import ROOT, DaemonProcess
from tests.support.divided_map import make_map

Factory = Callable[..., DaemonProcess]

PROGRAM = """
import os, resource, sys
import shmmap
endpoint = sys.argv[1]
fds = []
def leave_files(left):
    resource.setrlimit(resource.RLIMIT_NOFILE, (64, resource.getrlimit(resource.RLIMIT_NOFILE)[1]))
    try:
        while True:
            fds.append(os.dup(0))
    except OSError:
        for _ in range(left):
            os.close(fds.pop())
def free_files():
    while fds:
        os.close(fds.pop())
def leave_threads(left):
    import socket
    with open("/proc/self/statm") as file:
        now = int(file.read().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    resource.setrlimit(resource.RLIMIT_STACK, (8 << 20, 8 << 20))
    most = now + left * (8 << 20) + (left + 1) * (1 << 20)
    resource.setrlimit(resource.RLIMIT_AS, (most, resource.getrlimit(resource.RLIMIT_AS)[1]))
def tried(act):
    try:
        return act() or "works"
    except shmmap.ShmmapError as error:
        return f"{type(error).__name__}: {error}"
"""


def outcomes(code: str, one: DaemonProcess) -> list[str]:
    """Run a program that must end by itself and say nothing on stderr; returns its lines."""
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM + code, one.endpoint],
        capture_output=True, text=True, timeout=120, check=False, cwd=ROOT,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout.splitlines()


@pytest.fixture
def one(daemon: Factory, tmp_path: Path) -> DaemonProcess:
    served: DaemonProcess = daemon(make_map(tmp_path / "map", columns=2, rows=2).root)
    return served


def test_few_descriptors(one: DaemonProcess) -> None:
    """With 0 to 12 of them left, for a client and for a window."""
    lines = outcomes(
        """
shmmap.connect, shmmap.MapWindow
def window():
    with shmmap.MapWindow(endpoint, 50.0) as made:
        made.move_to(0.0, 0.0)
        return None if made.wait_until_current(60) else f"{made.error}"
def client():
    with shmmap.connect(endpoint) as made:
        return None if made.around(0, 0, 50).complete else "incomplete"
for act in client, window:
    for left in range(13):
        leave_files(left)
        result = tried(act)
        free_files()
        print(left, result)
""",
        one,
    )
    assert len(lines) == 26
    for line in lines:
        left, _, result = line.partition(" ")
        if int(left) >= 10:
            assert result == "works", line
        else:
            assert result.startswith(
                f"LimitReached: a connection to the daemon needs 10 more descriptors, {left} are left: "
                "this process has as many files open as it may, 64 (RLIMIT_NOFILE)"
            ), line


def test_none_to_load_the_library_with(one: DaemonProcess) -> None:
    (line,) = outcomes("leave_files(0); print(tried(lambda: shmmap.connect(endpoint)))", one)
    assert line.startswith("LimitReached: shmmap.connect cannot be loaded: this process has as many files")


def test_none_for_a_segment_and_for_a_window_of_a_client_that_is_there(one: DaemonProcess) -> None:
    lines = outcomes(
        """
shmmap.MapWindow
client = shmmap.connect(endpoint)
leave_files(0)
print(tried(lambda: client.around(0, 0, 50)))
window = shmmap.MapWindow(client, 50.0)
window.move_to(0.0, 0.0)
while window.error is None:
    pass
print(tried(lambda: f"{type(window.error).__name__}: {window.error}"))
free_files()
print(window.wait_until_current(60), tried(lambda: None if client.around(0, 0, 50).complete else "no"))
""",
        one,
    )
    for line in lines[:2]:
        assert line.startswith(
            "LimitReached: this process has as many files open as it may, 64 (RLIMIT_NOFILE)"
        )
    assert lines[2:] == ["True works"]


def test_none_to_connect_again_with(one: DaemonProcess) -> None:
    """The daemon is back, and this process may not open a socket: nobody blames the daemon."""
    program = subprocess.Popen(
        [sys.executable, "-c", PROGRAM + """
client = shmmap.connect(endpoint, timeout=1)
print("connected", flush=True)
while client.disconnected_since is None:
    pass
leave_files(0)
print("lost", flush=True)
input()
print(tried(lambda: client.around(0, 0, 50)), flush=True)
free_files()
client.close()
print(tried(lambda: None if shmmap.connect(endpoint).around(0, 0, 50).complete else "no"), flush=True)
""", one.endpoint],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT,
    )  # fmt: skip
    assert program.stdout is not None
    assert program.stdout.readline() == "connected\n"
    one.stop()
    assert program.stdout.readline() == "lost\n"
    one.start()
    rest, _ = program.communicate("\n", timeout=120)
    refusal, after = rest.splitlines()
    assert refusal.startswith("LimitReached: a connection to the daemon needs 1 more descriptors, 0 are left")
    assert after == "works"
    assert program.returncode == 0


@pytest.mark.parametrize("left", range(5))
def test_few_threads(one: DaemonProcess, left: int) -> None:
    """Stacks of threads need address space, which an ordinary user can limit, too."""
    client, window = outcomes(
        f"""
shmmap.connect, shmmap.MapWindow
leave_threads({left})
def client():
    shmmap.connect(endpoint).close()
def window():
    shmmap.MapWindow(endpoint, 50.0).close()
print(tried(client))
print(tried(window))
""",
        one,
    )
    assert client == "works" if left >= 3 else client.startswith("LimitReached: ")
    assert window == "works" if left >= 4 else window.startswith("LimitReached: ")
    if left < 3:
        assert "RLIMIT_NPROC" in client
        assert "of address space (RLIMIT_AS)" in client


@pytest.mark.root
@pytest.mark.parametrize("left", range(4))
def test_few_threads_of_a_user(one: DaemonProcess, left: int) -> None:
    """Root is not limited: the program becomes a user that has no other processes."""
    for path in (one.endpoint, str(Path(one.endpoint).parent)):
        os.chmod(path, 0o777)
    (line,) = outcomes(
        f"""
import socket
shmmap.connect
uid = 1_500_000_000 + os.getpid()
threads = len(os.listdir("/proc/self/task"))
resource.setrlimit(resource.RLIMIT_NPROC, (threads + {left}, threads + {left}))
os.setresuid(uid, uid, uid)
print(tried(lambda: shmmap.connect(endpoint).close()))
""",
        one,
    )
    if left == 3:
        assert line == "works"
    else:
        assert line.startswith("LimitReached: ")
        assert " processes and threads of this user (RLIMIT_NPROC)" in line


def test_checking_leaves_nothing() -> None:
    files, threads = len(os.listdir("/proc/self/fd")), set(os.listdir("/proc/self/task"))
    check_files(8, "this")
    check_threads(4, "this")
    assert len(os.listdir("/proc/self/fd")) == files
    assert set(os.listdir("/proc/self/task")) <= threads, "those of earlier tests may be ending"


def test_the_error_is_one_of_ours() -> None:
    assert shmmap.LimitReached is LimitReached
    assert (LimitReached.code, LimitReached.exit_code) == ("limit_reached", 71)
