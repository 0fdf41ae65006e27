# SPDX-License-Identifier: Apache-2.0
"""A window in a control loop: no call waits longer than it may, whatever the daemon does; nothing is lost."""

from __future__ import annotations

import re
import shutil
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

import shmmap
from tests.cpp.conftest import DaemonFactory
from tests.support.compiled_programs import ControlLoop, built_once, compiled_loop
from tests.support.daemon_process import DaemonProcess
from tests.support.divided_map import DividedMap
from tests.support.skips import programs_or_skip

RADIUS = 25.0
LONG_S = 120.0


@pytest.fixture(scope="session")
def loop_program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the program, compiled once for all processes of the tests."""
    programs_or_skip("g++")
    program = built_once(tmp_path_factory, "control_loop", compiled_loop)
    assert program is not None
    return program


def is_whole(loop: ControlLoop, daemon: DaemonProcess) -> None:
    """The window has what the map has around the vehicle."""
    is_complete, x, held = loop.complete(LONG_S)
    assert is_complete
    with shmmap.connect(daemon.endpoint) as client:
        assert held == {cell.id: cell.version for cell in client.around(x, 0.0, RADIUS, wait=LONG_S)}


def test_a_stopped_daemon_costs_no_call_anything(
    daemon: DaemonFactory, divided_map: DividedMap, loop_program: Path
) -> None:
    """Not an error either, before `timeout` is over; what was asked meanwhile is answered afterwards."""
    one = daemon(divided_map.root)
    loop = ControlLoop(loop_program, one.endpoint, RADIUS, wait=LONG_S)
    loop.go(1)
    is_whole(loop, one)
    one.send(signal.SIGSTOP)
    rounds = loop.go(250, wait=0.0, period=0.0)  # 25 m: the window has to ask
    assert rounds.codes == {"-": 250}
    assert rounds.current < 250
    one.send(signal.SIGCONT)
    is_whole(loop, one)
    assert loop.close() == 0


def test_a_silent_daemon_is_an_error_in_the_end(
    daemon: DaemonFactory, divided_map: DividedMap, loop_program: Path
) -> None:
    one = daemon(divided_map.root)
    loop = ControlLoop(loop_program, one.endpoint, RADIUS, wait=0.2)
    loop.go(1)
    is_whole(loop, one)
    one.send(signal.SIGSTOP)
    codes = loop.go(250, wait=0.002, period=0.0).codes
    assert codes["-"] > 0
    assert codes["no_answer"] > 0
    one.send(signal.SIGCONT)
    is_whole(loop, one)
    assert loop.close() == 0


def test_a_killed_daemon_is_found_again(
    daemon: DaemonFactory, divided_map: DividedMap, loop_program: Path
) -> None:
    one = daemon(divided_map.root)
    loop = ControlLoop(loop_program, one.endpoint, RADIUS)
    loop.go(1)
    is_whole(loop, one)
    one.kill()
    codes = loop.go(250, wait=0.0, period=0.0).codes
    assert set(codes) <= {"-", "stale_socket"}
    assert codes["stale_socket"] >= 248, "reported at once without a daemon"
    one.start()
    is_whole(loop, one)
    assert loop.close() == 0


def test_a_daemon_that_comes_later(
    daemon: DaemonFactory, divided_map: DividedMap, loop_program: Path, tmp_path: Path
) -> None:
    one = daemon(divided_map.root)
    one.stop()
    loop = ControlLoop(loop_program, one.endpoint, RADIUS)
    assert loop.go(20, wait=0.0, period=0.0).codes == {"no_socket": 20}
    one.start()
    is_whole(loop, one)
    one.stop()
    assert set(loop.go(20, wait=0.0, period=0.0).codes) <= {"-", "no_socket", "connection_lost"}
    one.start()
    is_whole(loop, one)
    assert loop.close() == 0


def killed(one: DaemonProcess) -> Callable[[], object]:
    one.kill()
    return one.start


def stopped(one: DaemonProcess) -> Callable[[], object]:
    one.send(signal.SIGSTOP)
    return lambda: one.send(signal.SIGCONT)


@pytest.mark.skipif(shutil.which("strace") is None, reason="strace is not installed")
@pytest.mark.parametrize("trouble", [killed, stopped])
def test_no_call_of_the_kernel_may_wait_longer(
    daemon: DaemonFactory,
    divided_map: DividedMap,
    loop_program: Path,
    tmp_path: Path,
    trouble: Callable[[DaemonProcess], Callable[[], object]],
) -> None:
    """Whatever can wait, waits at most 20 ms; and no call waits that does not say how long."""
    one = daemon(divided_map.root)
    calls = tmp_path / "calls"
    waiting = "poll,ppoll,select,pselect6,epoll_wait,nanosleep,clock_nanosleep,futex,flock,fcntl"
    loop = ControlLoop(
        loop_program, one.endpoint, RADIUS, wait=0.5, wrapper=["strace", "-o", str(calls), "-e", waiting]
    )
    loop.go(20)
    again = trouble(one)
    loop.go(40)
    again()
    loop.go(300, period=0.0)
    assert loop.close() == 0
    traced = calls.read_text()
    assert "ppoll(" in traced
    for line in traced.splitlines():
        assert "F_SETLKW" not in line
        assert "FUTEX_WAIT" not in line
        for seconds, nanoseconds in re.findall(r"tv_sec=(\d+), tv_nsec=(\d+)", line.split(" = ")[0]):
            if "TIMER_ABSTIME" in line:
                continue  # the loop's own, until its next round
            assert int(seconds) * 1e9 + int(nanoseconds) <= 20.5e6, line
        assert not line.startswith(("poll(", "select(", "epoll_wait(")), line
