# SPDX-License-Identifier: Apache-2.0
"""A daemon that was started at a terminal ends with it; one that is kept by others reads its map again."""

from __future__ import annotations

import os
import pty
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from shmmap.events import EventStream
from tests.process.conftest import DaemonFactory
from tests.support.daemon_process import DaemonProcess, next_reload, until
from tests.support.divided_map import DividedMap

AT_TERMINAL = """\
import fcntl, os, sys, termios
os.setsid()
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
os.execv(sys.executable, [sys.executable, *sys.argv[1:]])
"""
"""What a terminal does before it starts a shell."""


def serve(one: DaemonProcess) -> list[str]:
    words = ["-m", "shmmap.daemon", one.map_path, "--instance", one.instance]
    return [*words, "--runtime-dir", one.runtime_dir, "--shm-dir", one.shm_dir]


def at_terminal(one: DaemonProcess, *before: str, **variables: str) -> tuple[subprocess.Popen[bytes], int]:
    """Start the daemon at a terminal of its own; returns the terminal's other end, too."""
    ours, theirs = pty.openpty()
    with one.log_path.open("ab") as log:
        process = subprocess.Popen(
            [sys.executable, "-c", AT_TERMINAL, *before, *serve(one)],
            env={**one.environment, **variables}, stdin=theirs, stdout=log, stderr=log,
        )  # fmt: skip
    os.close(theirs)
    until(lambda: "ready endpoint" in one.log or process.poll() is not None, lambda: one.log)
    one.process = process
    return process, ours


@pytest.mark.parametrize("how", ["closed", "hung up"])
def test_it_ends_with_its_terminal(daemon: DaemonFactory, divided_map: DividedMap, how: str) -> None:
    one = daemon(divided_map.root, start=False, forked=False)
    process, terminal = at_terminal(one)
    if how == "closed":
        os.close(terminal)
    else:  # as a shell does that ends before its terminal
        one.send(signal.SIGHUP)
    assert process.wait(30) == 0, one.log
    one.process = None
    assert "stopping signal=SIGHUP" in one.log
    assert one.leftovers() == []
    if how != "closed":
        os.close(terminal)


@pytest.mark.parametrize("how", ["nohup", "service manager", "started elsewhere"])
def test_a_kept_client_reads_the_map_again(
    daemon: DaemonFactory, divided_map: DividedMap, tmp_path: Path, how: str
) -> None:
    one = daemon(divided_map.root, start=False, forked=False)
    terminal = -1
    if how == "nohup":
        ignoring = (
            "import os, signal, sys; signal.signal(signal.SIGHUP, signal.SIG_IGN);"
            "os.execv(sys.executable, [sys.executable, *sys.argv[1:]])"
        )
        _, terminal = at_terminal(one, "-c", ignoring)
    elif how == "service manager":
        _, terminal = at_terminal(one, NOTIFY_SOCKET=str(tmp_path / "none"))
    else:
        one.start()
    with EventStream(one.endpoint, timeout=30.0) as stream:
        one.send(signal.SIGHUP)
        assert next_reload(stream).error == ""
    assert one.stop() == 0
    if terminal >= 0:
        os.close(terminal)


def test_a_terminal_that_closes_while_it_starts(daemon: DaemonFactory, divided_map: DividedMap) -> None:
    one = daemon(divided_map.root, start=False, forked=False)
    ours, theirs = pty.openpty()
    with one.log_path.open("ab") as log:
        process = subprocess.Popen(
            [sys.executable, "-c", AT_TERMINAL, *serve(one)],
            env=one.environment, stdin=theirs, stdout=log, stderr=log,
        )  # fmt: skip
    os.close(theirs)
    until(lambda: any(name.endswith(".lock") for name in os.listdir(one.runtime_dir)), lambda: one.log)
    os.close(ours)
    assert process.wait(60) == 0, one.log
    assert one.leftovers() == []
