# SPDX-License-Identifier: Apache-2.0
"""Where the daemon may listen, and whose sockets it takes away."""

from __future__ import annotations

import os
import socket
import stat
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pytest

from shmmap.daemon.transport.socket_file import SocketFile, refuse_taken
from shmmap.errors import CannotStart, InstanceBusy

LISTENER = """\
import socket, sys, time
one = socket.socket(socket.AF_UNIX, getattr(socket, sys.argv[2]))
one.bind(sys.argv[1])
if sys.argv[2] != "SOCK_DGRAM":
    one.listen(int(sys.argv[3]))
print("ready", flush=True)
sys.stdin.read()
"""


@pytest.fixture
def place(tmp_path: Path) -> Path:
    return tmp_path / "a.sock"


def listens(path: Path, kind: str = "SOCK_STREAM", backlog: int = 8) -> subprocess.Popen[str]:
    """Start another program that listens there."""
    process = subprocess.Popen(
        [sys.executable, "-c", LISTENER, str(path), kind, str(backlog)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    return process


def test_a_file_in_the_socket_s_place_stays(tmp_path: Path) -> None:
    place = tmp_path / "map.yaml"
    place.write_text("precious")
    with pytest.raises(CannotStart, match=f"cannot be {place}: there is a file of "):
        SocketFile(str(place), -1)
    assert place.read_text() == "precious"


def test_where_nothing_can_be_made(tmp_path: Path) -> None:
    with pytest.raises(CannotStart, match="No such file"):
        SocketFile(str(tmp_path / "missing" / "a.sock"), -1)
    with pytest.raises(CannotStart, match="too long"):
        SocketFile("/" + "a" * 200, -1)


def test_a_socket_left_over_is_replaced(place: Path) -> None:
    with socket.socket(socket.AF_UNIX) as left:
        left.bind(str(place))
    one = SocketFile(str(place), -1)
    with closing(one.socket):
        assert stat.S_IMODE(place.stat().st_mode) == 0o600
        there = one.is_there
        assert there
        one.remove()
        assert not place.exists()
        assert not one.is_there
        one.remove()


@pytest.mark.parametrize("kind", ["SOCK_STREAM", "SOCK_SEQPACKET", "SOCK_DGRAM"])
def test_another_program_s_socket_is_refused(place: Path, kind: str) -> None:
    with listens(place, kind) as process:
        before = place.stat().st_ino
        with pytest.raises(InstanceBusy, match=rf"in use by pid {process.pid} \(.*python") as failure:
            SocketFile(str(place), -1)
        assert failure.value.exit_code == 75
        assert place.stat().st_ino == before


def test_a_program_that_accepts_nothing(place: Path) -> None:
    """Whether it is stopped or its queue is full, it is there."""
    with listens(place, backlog=0) as process, socket.socket(socket.AF_UNIX) as first:
        first.connect(str(place))
        with pytest.raises(InstanceBusy, match=f"pid {process.pid}"):
            refuse_taken(str(place))


@pytest.mark.root
def test_a_stale_socket_of_another_user(place: Path) -> None:
    with socket.socket(socket.AF_UNIX) as left:
        left.bind(str(place))
    os.chown(place, 12345, -1)
    with pytest.raises(CannotStart, match="there is a socket of uid 12345"):
        SocketFile(str(place), -1)
    assert place.exists()


def test_a_link_is_no_socket(place: Path, tmp_path: Path) -> None:
    with closing(SocketFile(str(tmp_path / "other.sock"), -1).socket):
        place.symlink_to(tmp_path / "other.sock")
        with pytest.raises(CannotStart, match="symbolic link"):
            SocketFile(str(place), -1)
