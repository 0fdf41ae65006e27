# SPDX-License-Identifier: Apache-2.0
"""``shmmap-ros-bridge`` as a process, a DDS domain of its own, and peers to compile."""

from __future__ import annotations

import fcntl
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, Final

from tests.support.daemon_process import ROOT, DaemonProcess

PROGRAM = [sys.executable, "-m", "shmmap_clients.ros_bridge"]
WITHIN_S = 60.0


def bridge_environment() -> dict[str, str]:
    """Variables for processes that use DDS: of this tree, on the loopback interface."""
    paths = [str(ROOT), str(ROOT / "clients")]
    return {**os.environ, "CYCLONEDDS_URI": URI, "PYTHONPATH": os.pathsep.join(paths), "XDG_RUNTIME_DIR": ""}


class BridgeProcess:
    """A bridge; used as a context manager it is ready on entry, and has ended on exit."""

    def __init__(self, daemon: DaemonProcess, domain: int, *options: str) -> None:
        self._command = [*PROGRAM, "--endpoint", daemon.endpoint, "--domain", str(domain), *options]
        self._status = Path(daemon.runtime_dir, f"{daemon.instance}.ros-bridge-{domain}.json")
        self._said: list[str] = []
        self._news = threading.Condition()
        self._silent = False
        self.process: subprocess.Popen[str] | None = None

    def __enter__(self) -> BridgeProcess:
        return self.start()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.process is not None and self.process.poll() is None:
            code = self.stop()
            assert error is not None or code == 0, self.log

    def start(self) -> BridgeProcess:
        """Start it and wait until it is ready."""
        self.process = subprocess.Popen(
            self._command,
            stderr=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            text=True,
            env=bridge_environment(),
        )
        before, self._silent = len(self._said), False
        self._listener = threading.Thread(target=self._listen, args=(self.process,))
        self._listener.start()
        self.wait_said("ready:", since=before)
        return self

    @property
    def pid(self) -> int:
        assert self.process is not None
        return self.process.pid

    @property
    def log(self) -> str:
        """All that it said."""
        with self._news:
            return "".join(self._said)

    def wait_said(self, text: str, *, since: int = 0, within_s: float = WITHIN_S) -> None:
        """Wait until it has said something."""
        with self._news:
            self._news.wait_for(
                lambda: any(text in line for line in self._said[since:]) or self._silent, within_s
            )
            assert any(text in line for line in self._said[since:]), "".join(self._said)

    @property
    def status(self) -> dict[str, Any]:
        """What it writes for doctor."""
        status: dict[str, Any] = json.loads(self._status.read_text())
        return status

    def wait_status(self, within_s: float = WITHIN_S, **wanted: Any) -> None:
        """Wait until it writes this."""
        until_s = time.monotonic() + within_s
        while any(self.status[name] != value for name, value in wanted.items()):
            assert time.monotonic() < until_s, self.status
            time.sleep(0.05)

    def kill(self) -> None:
        """SIGKILL."""
        assert self.process is not None
        self.process.kill()
        self._wait()

    def stop(self) -> int:
        """SIGTERM; returns the exit code."""
        assert self.process is not None
        self.process.send_signal(signal.SIGTERM)
        return self._wait()

    def _wait(self) -> int:
        assert self.process is not None
        try:
            return self.process.wait(WITHIN_S)
        finally:
            self.process.kill()  # one that does not end would answer the clients of later tests
            self._listener.join()

    def _listen(self, process: subprocess.Popen[str]) -> None:
        assert process.stderr is not None
        for line in process.stderr:
            with self._news:
                self._said.append(line)
                self._news.notify_all()
        process.stderr.close()
        with self._news:
            self._silent = True
            self._news.notify_all()


# A DDS domain for one test: no other test of this machine is in it, and nothing leaves the machine


_DOMAINS: Final = range(1, 100)  # the ports of higher ones are given out for any port
_LOCKS: Final = Path("/tmp")

URI: Final = (
    "<CycloneDDS><Domain Id='any'>"
    "<General><Interfaces><NetworkInterface name='lo'/></Interfaces>"
    "<AllowMulticast>false</AllowMulticast></General>"
    "<Discovery><ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>60</MaxAutoParticipantIndex>"
    "<Peers><Peer address='127.0.0.1'/></Peers></Discovery>"
    "</Domain></CycloneDDS>"
)
"""Settings of CycloneDDS: the loopback interface alone, no multicast."""


@contextmanager
def dds_domain() -> Iterator[int]:
    """Have a domain to oneself; the kernel gives it back whatever becomes of this process.

    Accounts share no lock, and begin their search at different numbers.
    """
    first = os.getuid() % len(_DOMAINS)
    for number in (*_DOMAINS[first:], *_DOMAINS[:first]):
        fd = os.open(
            _LOCKS / f"shmmap-test-dds-domain-{os.getuid()}-{number}.lock", os.O_RDWR | os.O_CREAT, 0o600
        )
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(fd)
            continue
        try:
            yield number
        finally:
            os.close(fd)
        return
    raise AssertionError("a hundred tests use DDS at once")


# The peers of ``tests/support/dds_peers``, compiled where what they need is installed


_SOURCES = Path(__file__).parent / "dds_peers"


def built_cyclone_peer(folder: Path) -> Path | None:
    """The peer over Debian's CycloneDDS; None where it cannot be built."""
    if not (shutil.which("idlc") and shutil.which("gcc") and Path("/usr/include/dds/dds.h").exists()):
        return None
    # -t: no type information, as in the ROS distributions whose mapping this is
    subprocess.run(["idlc", "-t", "-l", "c", str(_SOURCES / "autoware.idl")], cwd=folder, check=True)
    program = folder / "cyclone_peer"
    sources = [str(_SOURCES / "cyclone_peer.c"), "autoware.c"]
    subprocess.run(
        ["gcc", "-O1", "-Wall", "-Wextra", "-Werror", "-I.", *sources, "-lddsc", "-o", str(program)],
        cwd=folder,
        check=True,
    )
    return program


def built_fast_peer(folder: Path) -> Path | None:
    """The peer over Fast DDS; None where it cannot be built."""
    if not (shutil.which("g++") and Path("/usr/include/fastdds/dds/topic/TopicDataType.hpp").exists()):
        return None
    program = folder / "fast_peer"
    flags = ["-std=c++17", "-O1", "-Wall", "-Wextra", "-Werror"]
    source = str(_SOURCES / "fast_peer.cpp")
    subprocess.run(["g++", *flags, source, "-lfastrtps", "-lfastcdr", "-o", str(program)], check=True)
    return program
