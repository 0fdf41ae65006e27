# SPDX-License-Identifier: Apache-2.0
"""SIGKILL at every labelled step of daemon, worker and client: no leak, no wrong byte, no lost request."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

import shmmap
from shmmap.errors import InternalError, StaleSocket
from shmmap.failpoints import CLIENT_STEPS, DAEMON_STEPS, WORKER_STEPS
from tests.process.conftest import DaemonFactory
from tests.support.cpp_client import CppClient
from tests.support.daemon_process import ROOT, DaemonProcess, Deadline, until
from tests.support.divided_map import DividedMap, random_points
from tests.support.mapping_process import MappingProcess
from tests.support.segment_reader import assert_right, whole

STEPS_AT_START = (
    "daemon.lock",
    "daemon.adopt",
    "daemon.adopted",
    "daemon.bind",
    "daemon.accept",
    "worker.check",
)
CRASH = "SHMMAP_TEST_CRASH"


class Keeper:
    """Starts the daemon again when it was killed, as a service manager does."""

    def __init__(self, one: DaemonProcess) -> None:
        self.one = one
        self.restarts = 0
        self._ours, self._theirs = os.pipe()
        self._thread = threading.Thread(target=self._watch)

    def __enter__(self) -> Keeper:
        self.start()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._theirs)
        self._thread.join()
        os.close(self._ours)

    def start(self) -> None:
        """Start it, a second time if it did not come to serving."""
        try:
            self.one.start()
        except InternalError:
            assert self.one.process is not None
            assert self.one.process.returncode == -9, self.one.log
            self._again()

    def _again(self) -> None:
        self.restarts += 1
        self.one.environment.pop(CRASH)
        self.one.start()

    def _watch(self) -> None:
        import select

        pidfd = os.pidfd_open(self.one.pid)
        try:
            ready, _, _ = select.select([pidfd, self._ours], [], [])
        finally:
            os.close(pidfd)
        if pidfd in ready:
            assert self.one.process is not None
            assert self.one.process.wait() == -9, self.one.log
            self._again()


@pytest.fixture
def crashing(
    daemon: DaemonFactory, divided_map: DividedMap, tmp_path: Path, private_tmpfs: Callable[[str], str]
) -> Iterator[Callable[[str], DaemonProcess]]:
    """Make a daemon that is to die at a step, not started; at the end no memory may be without a name."""
    made: list[DaemonProcess] = []

    def make(label: str) -> DaemonProcess:
        shm_dir = private_tmpfs("64m") if os.geteuid() == 0 else None
        one: DaemonProcess = daemon(divided_map.root, "--workers", "1", start=False, shm_dir=shm_dir)
        if label in STEPS_AT_START:
            one.start()
            with shmmap.connect(one.endpoint, timeout=60.0) as client:
                client.around(0, 0, 60).raise_for_failures()
            one.kill()
        one.environment[CRASH] = f"{label}:1:{tmp_path}/reached"
        made.append(one)
        return one

    yield make
    assert (tmp_path / "reached").exists(), "the step was never reached"
    if os.geteuid() == 0:
        until(lambda: not _unnamed_bytes(made[0].shm_dir))  # a loader may outlive its daemon by a moment


def _unnamed_bytes(directory: str) -> int:
    """Return how many bytes of a tmpfs belong to files without a name."""
    state = os.statvfs(directory)
    named = sum(os.stat(f"{directory}/{name}").st_blocks * 512 for name in os.listdir(directory))
    return (state.f_blocks - state.f_bfree) * state.f_frsize - named


def live(client: shmmap.Client, made: DividedMap) -> None:
    """Come by every step: load, hand out, retire while held, revive, free, change, reload."""
    near, far = made.in_circle(0, 0, 5), made.in_circle(40, 40, 5)
    held = whole(client, 0, 0, 5)
    assert_right(held, made, near)
    client.evict()  # retired, but held
    assert_right(whole(client, 0, 0, 5), made, near)
    assert_right(whole(client, 40, 40, 5), made, far)
    client.evict()  # retired, and the far ones freed
    made.write_cell("0_0.pcd", (0, 0), random_points(np.random.default_rng(8), (0, 0), 321))
    client.reload()
    assert_right(whole(client, 0, 0, 5), made, near)


def connected(one: DaemonProcess) -> shmmap.Client:
    """Connect, again where the daemon has just died and is started again."""
    waiting = Deadline()
    while waiting(True):
        with contextlib.suppress(StaleSocket):
            return shmmap.connect(one.endpoint, timeout=240.0, connect_timeout=240.0)
    raise AssertionError("it is not started again")


@pytest.mark.more_as_root
@pytest.mark.parametrize("label", [*DAEMON_STEPS, *WORKER_STEPS])
def test_daemon_and_worker(
    crashing: Callable[[str], DaemonProcess], divided_map: DividedMap, label: str
) -> None:
    one = crashing(label)
    paths = [f"{one.shm_dir}/{name}" for name in one.segments()[:3]]
    with MappingProcess(paths) as reader:
        before = reader.checksums()
        with (
            Keeper(one) as keeper,
            connected(one) as client,
        ):
            live(client, divided_map)
            assert reader.checksums() == before
        assert keeper.restarts == label.startswith("daemon.")
    with shmmap.connect(one.endpoint, timeout=60.0) as client:
        assert_right(whole(client, 0, 0, 500), divided_map, sorted(divided_map.corners))
        until(lambda: _books_agree(one, client))
        client.evict()
        one.until_segments(0, client.stats)


def _books_agree(one: DaemonProcess, client: shmmap.Client) -> bool:
    counters = client.stats().counters
    return counters["bytes_resident"] + counters["bytes_zombie"] == one.segment_bytes()


CLIENT = """
import sys
import shmmap
client = shmmap.connect(sys.argv[1])
held = client.around(0, 0, 30, wait=30.0).raise_for_failures()
"""


def die_in_python(request: pytest.FixtureRequest, endpoint: str, crash: str) -> int:
    """Run a client that is to die; returns its exit code."""
    return subprocess.run(
        [sys.executable, "-c", CLIENT, endpoint], env={**os.environ, CRASH: crash}, cwd=ROOT
    ).returncode


def die_in_cpp(request: pytest.FixtureRequest, endpoint: str, crash: str) -> int:
    """Do the same in C++."""
    client = CppClient(request.getfixturevalue("cpp_program"), endpoint, environment={CRASH: crash})
    with pytest.raises((AssertionError, BrokenPipeError), match=r"ended with -9|Broken pipe"):
        client.around(0, 0, 30, wait=30.0)
    return client.program.close()


@pytest.mark.parametrize("label", CLIENT_STEPS)
@pytest.mark.parametrize(("die", "number"), [(die_in_python, 1), (die_in_python, 3), (die_in_cpp, 3)])
def test_client(
    daemon: DaemonFactory,
    divided_map: DividedMap,
    label: str,
    number: int,
    die: Callable[[pytest.FixtureRequest, str, str], int],
    request: pytest.FixtureRequest,
) -> None:
    """What it had is free as soon as it is dead; another client notices nothing."""
    if label == "client.answer":
        number = 1
    one = daemon(divided_map.root)
    with shmmap.connect(one.endpoint, timeout=60.0) as other:
        near = divided_map.in_circle(0, 0, 30)
        held = whole(other, 0, 0, 5)
        assert die(request, one.endpoint, f"{label}:{number}") == -9
        assert other.evict().pinned == len(held)
        one.until_segments(len(held), lambda: other.stats())
        assert_right(whole(other, 0, 0, 30), divided_map, near)
        until(lambda: len(other.stats().sessions) <= 1)
