# SPDX-License-Identifier: Apache-2.0
"""Starts real daemons for tests, and judges from outside what they leave behind."""

from __future__ import annotations

import contextlib
import os
import re
import secrets
import select
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from tests.support.patience import Patience

ROOT = Path(__file__).resolve().parents[2]
READY_S = 60.0
STOP_S = 30.0
_MARK = "SHMMAP_TEST_RUN"


def wait_readable(fds: Sequence[int], timeout: float) -> list[int]:
    """Wait until one of the descriptors is readable; returns those that are."""
    poller = select.poll()
    for fd in fds:
        poller.register(fd, select.POLLIN)
    return [fd for fd, _ in poller.poll(timeout * 1000)]


def wait_ended(pid: int, timeout: float = STOP_S) -> bool:
    """Wait until a process has ended; True if it has."""
    try:
        fd = os.pidfd_open(pid)
    except ProcessLookupError:
        return True
    try:
        return bool(wait_readable([fd], timeout))
    finally:
        os.close(fd)


def processes_marked(mark: str, variable: str = _MARK) -> list[int]:
    """Ids of the living processes whose environment carries ``mark``."""
    found = []
    for entry in os.listdir("/proc"):
        if entry.isdigit():
            try:
                if f"{variable}={mark}".encode() in Path(f"/proc/{entry}/environ").read_bytes().split(b"\0"):
                    found.append(int(entry))
            except OSError:
                continue
    return found


def open_files() -> dict[int, str]:
    """Descriptors of this process and what they refer to."""
    found = {}
    for entry in os.listdir("/proc/self/fd"):
        with contextlib.suppress(OSError):
            found[int(entry)] = os.readlink(f"/proc/self/fd/{entry}")
    return found


class DaemonProcess:
    """One instance of the daemon: a name, its directories, and a process that comes and goes.

    Parameters
    ----------
    map_path
        What to serve.
    arguments
        More flags of ``shmmap serve``.
    environment
        More variables, over this process's.
    shm_dir
        Directory of the segments; default a private one inside /dev/shm.
    command
        In front of the daemon's own command, for example ``["setpriv", ...]``.
    pass_fds
        Descriptors that it inherits.
    """

    def __init__(
        self,
        map_path: Path | str,
        *arguments: str,
        environment: Mapping[str, str] | None = None,
        shm_dir: str | None = None,
        command: Sequence[str] = (),
        pass_fds: Sequence[int] = (),
    ) -> None:
        self.map_path = str(map_path)
        self.instance = f"test-{secrets.token_hex(4)}"
        self.runtime_dir = tempfile.mkdtemp(prefix="shmmap-", dir="/tmp")
        self._own_shm_dir = shm_dir is None
        self.shm_dir = shm_dir or tempfile.mkdtemp(prefix=f"shmmap-{self.instance}-", dir="/dev/shm")
        self.endpoint = f"{self.runtime_dir}/{self.instance}.sock"
        self.log_path = Path(self.runtime_dir) / "log.txt"
        self.arguments = list(arguments)
        self.command = list(command)
        self.pass_fds = tuple(pass_fds)
        self.process: subprocess.Popen[bytes] | None = None
        self.killed = False
        self._private = tempfile.mkdtemp(prefix="shmmap-home-", dir="/tmp")
        for name in ("tmp", "cache"):
            os.mkdir(f"{self._private}/{name}")
        self._mark = secrets.token_hex(8)
        self.environment = {
            **{k: v for k, v in os.environ.items() if not k.startswith("SHMMAP_")},
            "TMPDIR": f"{self._private}/tmp",
            "XDG_CACHE_HOME": f"{self._private}/cache",
            "PYTHONPATH": str(ROOT),
            _MARK: self._mark,
            **(environment or {}),
        }

    def give_to(self, uid: int) -> None:
        """Let the daemon run as another user: its directories become that user's."""
        for path in (self.runtime_dir, self.shm_dir, self._private):
            os.chown(path, uid, -1)
            for name in os.listdir(path):
                os.chown(f"{path}/{name}", uid, -1)

    @property
    def pid(self) -> int:
        """Process id of the daemon."""
        assert self.process is not None
        return self.process.pid

    @property
    def cache_dir(self) -> Path:
        """``XDG_CACHE_HOME`` of the daemon."""
        return Path(self._private) / "cache"

    @property
    def log(self) -> str:
        """What the daemon wrote on stderr in all its lives."""
        return self.log_path.read_text(errors="replace") if self.log_path.exists() else ""

    def spawn(self, *, arguments: Sequence[str] | None = None, notify: str = "") -> subprocess.Popen[bytes]:
        """Start the process without waiting for it to be ready."""
        environment = dict(self.environment)
        environment.pop("NOTIFY_SOCKET", None)
        if notify:
            environment["NOTIFY_SOCKET"] = notify
        command = [
            *self.command, sys.executable, "-m", "shmmap.daemon", self.map_path,
            "--instance", self.instance, "--runtime-dir", self.runtime_dir, "--shm-dir", self.shm_dir,
            *(self.arguments if arguments is None else arguments),
        ]  # fmt: skip
        with self.log_path.open("ab") as log:
            return subprocess.Popen(
                command,
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                cwd="/",
                pass_fds=self.pass_fds,
            )

    def start(self, timeout: float = READY_S) -> DaemonProcess:
        """Start the daemon and wait until it says that it is ready (sd_notify)."""
        path = f"{self.runtime_dir}/notify"
        with contextlib.suppress(FileNotFoundError):
            os.unlink(path)
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as notify:
            notify.bind(path)
            os.chmod(path, 0o777)
            self.process = self.spawn(notify=path)
            pidfd = os.pidfd_open(self.process.pid)
            deadline = time.monotonic() + timeout
            try:
                while True:
                    ready = wait_readable([notify.fileno(), pidfd], max(0.0, deadline - time.monotonic()))
                    if notify.fileno() in ready:
                        if b"READY=1" in notify.recv(4096).splitlines():
                            self.killed = False
                            return self
                    elif ready:
                        raise AssertionError(f"the daemon ended with {self.process.wait()}:\n{self.log}")
                    else:
                        raise AssertionError(f"the daemon is not ready after {timeout} s:\n{self.log}")
            finally:
                os.close(pidfd)
                os.unlink(path)

    def run_to_end(self, timeout: float = READY_S) -> int:
        """Run a daemon that is expected to end by itself; returns its exit code."""
        process = self.spawn()
        try:
            return process.wait(timeout)
        finally:
            process.kill()
            process.wait()

    def send(self, number: signal.Signals) -> None:
        """Send the daemon a signal."""
        os.kill(self.pid, number)

    def stop(self) -> int:
        """End the daemon with SIGTERM; returns its exit code."""
        return self._end(signal.SIGTERM)

    def leave(self) -> int:
        """End the daemon with SIGUSR1, which leaves the segments to its next life; returns its exit code."""
        code = self._end(signal.SIGUSR1)
        self.killed = True
        return code

    def kill(self) -> None:
        """End the daemon with SIGKILL: it can clean up nothing."""
        self._end(signal.SIGKILL)
        self.killed = True

    def _end(self, number: signal.Signals) -> int:
        assert self.process is not None
        process, self.process = self.process, None
        if process.poll() is None:
            process.send_signal(signal.SIGCONT)
            process.send_signal(number)
        try:
            return process.wait(STOP_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            raise AssertionError(f"the daemon did not end within {STOP_S} s:\n{self.log}") from None

    def children(self) -> list[int]:
        """Ids of the daemon's living descendants, wherever they were reparented to."""
        own = self.process.pid if self.process is not None else 0
        return sorted(pid for pid in processes_marked(self._mark) if pid != own)

    def stop_loaders(self) -> list[int]:
        """SIGSTOP every loader there is, wait until they stand still; returns their ids."""
        loaders = self.children()
        for pid in loaders:
            os.kill(pid, signal.SIGSTOP)
            waiting = Patience()
            while waiting(Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "T"):
                os.sched_yield()
        return loaders

    def segments(self) -> list[str]:
        """Published and retired segments, sorted; statistics and lock are not among them."""
        own = re.compile(rf"shmmap\.{self.instance}\.[0-9a-f]{{16}}(\.zombie)?")
        return sorted(name for name in os.listdir(self.shm_dir) if own.fullmatch(name))

    def until_segments(self, at_most: int, ask: Callable[[], object]) -> None:
        """Ask until no more are left (the daemon looks at retired ones by itself)."""
        waiting = Patience()
        while waiting(len(self.segments()) > at_most):
            ask()

    def segment_bytes(self) -> int:
        """Memory the instance's segments occupy by their blocks (the statistics not counted)."""
        total = 0
        for name in self.segments():
            with contextlib.suppress(FileNotFoundError):
                total += os.stat(f"{self.shm_dir}/{name}").st_blocks * 512
        return total

    def leftovers(self) -> list[str]:
        """Everything a cleanly ended daemon must not leave: names, sockets, processes, files."""
        prefix = f"shmmap.{self.instance}."
        found = [f"process {pid}" for pid in self.children() if not wait_ended(pid, 10.0)]
        if self.killed:
            return found  # names are left behind for the next life to adopt
        found += [f"segment {name}" for name in os.listdir(self.shm_dir) if name.startswith(prefix)]
        if self._own_shm_dir:
            found += [
                f"file {n} in the shm directory" for n in os.listdir(self.shm_dir) if not n.startswith(prefix)
            ]
        found += [f"socket {name}" for name in os.listdir(self.runtime_dir) if name.endswith(".sock")]
        found += [f"temporary file {name}" for name in os.listdir(f"{self._private}/tmp")]
        return found

    def dispose(self) -> None:
        """Kill what is left and remove all directories; no judgement."""
        if self.process is not None:
            self.kill()
        for pid in self.children():
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        for name in os.listdir(self.shm_dir):
            if name.startswith(f"shmmap.{self.instance}."):
                os.unlink(f"{self.shm_dir}/{name}")
        if self._own_shm_dir:
            shutil.rmtree(self.shm_dir)
        shutil.rmtree(self.runtime_dir)
        shutil.rmtree(self._private)
