# SPDX-License-Identifier: Apache-2.0
"""A real daemon for a test or a demonstration: isolated by its own names, and checked for leftovers.

::

    with DaemonProcess("/path/to/map") as daemon, shmmap.connect(daemon.endpoint) as client:
        ...
    assert not daemon.leftovers()

With pytest the fixture of `shmmap.testing.fixtures` does all of that.
"""

from __future__ import annotations

import contextlib
import gc
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
import weakref
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Final, TypeVar

from shmmap.errors import InternalError
from shmmap.processes.interrupts import interrupts_later
from shmmap.segment.names import DEFAULT_SHM_DIR

__all__ = [
    "READY_S",
    "STOP_S",
    "DaemonProcess",
    "isolated_daemons",
    "open_files",
    "processes_marked",
    "wait_ended",
    "wait_readable",
    "without_settings",
]

READY_S: Final = 60.0
STOP_S: Final = 30.0
_MARK: Final = "SHMMAP_TEST_DAEMON"

_Self = TypeVar("_Self", bound="DaemonProcess")
_Daemon = TypeVar("_Daemon", bound="DaemonProcess")


class DaemonProcess:
    """An instance of the daemon for tests: its name, its directories, and a process that can be restarted.

    It is independent of the machine's real daemon: name, socket, segments, temporary files and log are its
    own, and it receives no ``SHMMAP_*`` variables (except ``SHMMAP_TEST_*``).

    Parameters
    ----------
    map_path
        Path of the map to serve.
    *arguments
        Further options of ``shmmap serve``.
    environment
        Variables that override those of this process.
    shm_dir
        Directory of the segments; by default a new one inside ``/dev/shm``.
    command
        Prefix of the daemon's command, for example ``["taskset", "-c", "1"]``.
    pass_fds
        Descriptors that the daemon inherits.

    Attributes
    ----------
    instance, endpoint, runtime_dir, shm_dir, log_path
        Name of the instance, and paths of its socket, segments and log.
    cache_dir, state_dir
        ``XDG_CACHE_HOME`` and ``XDG_STATE_HOME`` of the daemon.
    process
        Process of the current run; None if the daemon does not run.
    killed
        Whether its last run ended without cleaning up, by `kill` or `leave`.

    Used as a context manager, the daemon is ready on entry; on exit it is stopped and its directories are
    removed. Otherwise call `start`, `stop` and, in the end, `dispose`.

    Raises
    ------
    InternalError
        From starting or stopping: the daemon ended, was not ready in a minute, or did not end within half a
        minute; the message contains the end of its log.
    """

    def __init__(
        self,
        map_path: str | os.PathLike[str],
        *arguments: str,
        environment: Mapping[str, str] | None = None,
        shm_dir: str | None = None,
        command: Sequence[str] = (),
        pass_fds: Sequence[int] = (),
    ) -> None:
        self.map_path = os.path.abspath(map_path) if os.path.exists(map_path) else os.fspath(map_path)
        self.arguments = list(arguments)
        self.command = list(command)
        self.pass_fds = tuple(pass_fds)
        self.instance = f"test-{os.getpid()}-{secrets.token_hex(4)}"
        self.process: subprocess.Popen[bytes] | None = None
        self.killed = False
        self._ready: socket.socket | None = None
        self._own_shm_dir = shm_dir is None
        self._leftovers: list[str] | None = None
        self._directories: list[str] = []
        # also if the constructor is interrupted, or dispose() is never called
        self._finalizer = weakref.finalize(self, _remove, self._directories, os.getpid())
        with interrupts_later():
            # under /tmp whatever TMPDIR is: a socket's path is limited to 107 bytes
            self.runtime_dir = self._directory("/tmp")  # noqa: S108
            self.scratch_dir = self._directory("/tmp")  # noqa: S108
            self.shm_dir = shm_dir or self._directory(DEFAULT_SHM_DIR)
        self.endpoint = f"{self.runtime_dir}/{self.instance}.sock"
        self.log_path = Path(self.runtime_dir, "log.txt")
        self.cache_dir = Path(self.scratch_dir, "cache")
        self.state_dir = Path(self.scratch_dir, "state")
        self._temporary_dir = Path(self.scratch_dir, "temporary")
        for directory in (self.cache_dir, self._temporary_dir):
            directory.mkdir()
        self.environment = {
            **without_settings(),
            # compiled kernels are shared: they take seconds to compile, and depend on their source alone
            "NUMBA_CACHE_DIR": os.environ.get("NUMBA_CACHE_DIR") or _kernels_dir(),
            "TMPDIR": str(self._temporary_dir),
            "XDG_CACHE_HOME": str(self.cache_dir),
            "XDG_STATE_HOME": str(self.state_dir),
            _MARK: self.instance,
            **(environment or {}),
        }

    def _directory(self, parent: str) -> str:
        path = tempfile.mkdtemp(prefix=f"shmmap-{self.instance}-", dir=parent)
        self._directories.append(path)
        return path

    def __enter__(self: _Self) -> _Self:
        try:
            return self.start()
        except BaseException:
            self.dispose()
            raise

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with interrupts_later():
            try:
                if self.process is not None:
                    self.stop()
                self._leftovers = self.leftovers()
            finally:
                self.dispose()

    @property
    def pid(self) -> int:
        """Process id of the daemon."""
        if self.process is None:
            raise InternalError("the daemon is not running")
        return self.process.pid

    @property
    def log(self) -> str:
        """Text that the daemon wrote to stderr in all its runs."""
        return self.log_path.read_text(errors="replace") if self.log_path.exists() else ""

    # --- start and stop -----------------------------------------------------------------------------

    def spawn(self, *, arguments: Sequence[str] | None = None, notify: str = "") -> subprocess.Popen[bytes]:
        """Start the process without waiting for it to be ready."""
        environment = dict(self.environment)
        environment.pop("NOTIFY_SOCKET", None)
        if notify:
            environment["NOTIFY_SOCKET"] = notify
        command = [
            *self.command,
            sys.executable,
            "-m",
            "shmmap.daemon",
            self.map_path,
            "--instance",
            self.instance,
            "--runtime-dir",
            self.runtime_dir,
            "--shm-dir",
            self.shm_dir,
            *(self.arguments if arguments is None else arguments),
        ]
        with self.log_path.open("ab") as log:
            return self._run(command, environment, log)

    def _run(
        self, command: Sequence[str], environment: Mapping[str, str], log: IO[bytes]
    ) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            command,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            cwd="/",
            pass_fds=self.pass_fds,
            start_new_session=True,  # Ctrl-C reaches only the parent, which stops the daemon
        )

    def start(self: _Self, timeout_s: float = READY_S) -> _Self:
        """Start the daemon and wait until it is ready."""
        self.launch()
        if not self.wait_ready(timeout_s):
            raise InternalError(f"the daemon is not ready after {timeout_s:g} s:\n{self._last_words()}")
        return self

    def launch(self) -> None:
        """Start the daemon without waiting; `wait_ready` waits until it is ready."""
        path = f"{self.runtime_dir}/notify"
        self._forget_ready()
        self._ready = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
        self._ready.bind(path)
        os.chmod(path, 0o777)  # noqa: S103  the daemon may run as another user
        with interrupts_later():
            self.process = self.spawn(notify=path)

    def wait_ready(self, timeout_s: float = READY_S) -> bool:
        """Wait until the launched daemon reports that it is ready (sd_notify); return whether it does."""
        if self._ready is None:
            return True
        deadline_s = time.monotonic() + timeout_s
        end = os.pidfd_open(self.pid)
        try:
            while True:
                found = wait_readable([self._ready.fileno(), end], deadline_s - time.monotonic())
                if self._ready.fileno() in found:
                    if b"READY=1" in self._ready.recv(4096).splitlines():
                        self.killed = False
                        self._forget_ready()
                        return True
                elif found:
                    code = self.process.wait() if self.process is not None else 0
                    raise InternalError(f"the daemon ended with {code}:\n{self._last_words()}")
                else:
                    return False
        finally:
            os.close(end)

    def send(self, number: signal.Signals) -> None:
        """Send the daemon a signal."""
        os.kill(self.pid, number)

    def stop(self) -> int:
        """Stop the daemon with SIGTERM, which empties the cache; return its exit code."""
        return self._end(signal.SIGTERM)

    def leave(self) -> int:
        """Stop the daemon with SIGUSR1, which leaves the segments to its next run; return its exit code."""
        code = self._end(signal.SIGUSR1)
        self.killed = True
        return code

    def kill(self) -> None:
        """Kill the daemon with SIGKILL, without any cleanup; `start` then finds what it left."""
        self._end(signal.SIGKILL)
        self.killed = True

    def _end(self, number: signal.Signals) -> int:
        pid = self.pid
        assert self.process is not None  # noqa: S101  checked by `pid`
        process, self.process = self.process, None
        if process.poll() is None:
            process.send_signal(signal.SIGCONT)
            process.send_signal(number)
        try:
            return process.wait(STOP_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            raise InternalError(
                f"the daemon, process {pid}, did not end within {STOP_S:g} s:\n{self._last_words()}"
            ) from None

    def _forget_ready(self) -> None:
        if self._ready is not None:
            self._ready.close()
            self._ready = None
        with contextlib.suppress(FileNotFoundError):
            os.unlink(f"{self.runtime_dir}/notify")

    def _last_words(self) -> str:
        return "\n".join(self.log.splitlines()[-20:])

    # --- processes, segments, leftovers -------------------------------------------------------------

    def children(self) -> list[int]:
        """Return the ids of the daemon's living descendants, also reparented ones."""
        own = self.process.pid if self.process is not None else 0
        return sorted(pid for pid in processes_marked(self.instance, _MARK) if pid != own)

    def segments(self) -> list[str]:
        """Return the names of published and retired segments, sorted; without statistics and lock."""
        own = re.compile(rf"shmmap\.{self.instance}\.[0-9a-f]{{16}}(\.zombie)?")
        return sorted(name for name in os.listdir(self.shm_dir) if own.fullmatch(name))

    def segment_bytes(self) -> int:
        """Return the memory of the segments, counted in allocated blocks."""
        return self._measured(self.segments())

    def shm_bytes(self) -> int:
        """Return the memory of all the daemon's shared-memory files, including statistics."""
        prefix = f"shmmap.{self.instance}."
        return self._measured(name for name in os.listdir(self.shm_dir) if name.startswith(prefix))

    def _measured(self, names: Iterable[str]) -> int:
        total = 0
        for name in names:
            with contextlib.suppress(FileNotFoundError):
                total += os.stat(f"{self.shm_dir}/{name}").st_blocks * 512
        return total

    def leftovers(self) -> list[str]:
        """Return what a daemon that stopped in order must not leave: names, sockets, processes, files.

        After the context manager's exit: the leftovers found at the exit.
        """
        if self._leftovers is not None:
            return self._leftovers
        prefix = f"shmmap.{self.instance}."
        found = [f"process {pid}" for pid in self.children() if not wait_ended(pid, 10.0)]
        if self.killed:
            return found  # names stay for the next run to adopt
        found += [f"segment {name}" for name in os.listdir(self.shm_dir) if name.startswith(prefix)]
        if self._own_shm_dir:
            found += [
                f"file {n} in the shm directory" for n in os.listdir(self.shm_dir) if not n.startswith(prefix)
            ]
        found += [f"socket {name}" for name in os.listdir(self.runtime_dir) if name.endswith(".sock")]
        found += [f"temporary file {name}" for name in os.listdir(self._temporary_dir)]
        return found

    def dispose(self) -> None:
        """Kill remaining processes and remove all directories, without checks."""
        with interrupts_later():
            if self.process is not None:
                self.kill()
            self._forget_ready()
            for pid in self.children():
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
                wait_ended(pid)
            for name in os.listdir(self.shm_dir):
                if name.startswith(f"shmmap.{self.instance}."):
                    os.unlink(f"{self.shm_dir}/{name}")
            self._finalizer()


def _remove(directories: list[str], owner: int) -> None:
    """Remove directories, except in a forked child of the process that made them."""
    if os.getpid() == owner:
        for path in directories:
            shutil.rmtree(path, ignore_errors=True)


def _kernels_dir() -> str:
    """Return the directory of compiled kernels, see `shmmap.compiling`, which loads numba."""
    base = os.environ.get("XDG_CACHE_HOME", "")
    return str(Path(base if base.startswith("/") else os.path.expanduser("~/.cache"), "shmmap", "kernels"))


@contextlib.contextmanager
def isolated_daemons(kind: type[_Daemon]) -> Iterator[Callable[..., _Daemon]]:
    """Provide ``make(map_path, *options, environment=..., shm_dir=..., start=True)`` to start daemons.

    At the end each daemon still running gets SIGTERM.  It must exit with 0, and leave no name, socket,
    process or temporary file; a daemon that was killed and not restarted must only leave no process.  This
    process must have no more open files than before.

    Parameters
    ----------
    kind
        `DaemonProcess`, or a subclass.

    Raises
    ------
    InternalError
        At the end: something was left behind; the message names it and contains the daemon's log.
    """
    before = open_files()
    started: list[_Daemon] = []

    def make(map_path: str | os.PathLike[str], *options: str, start: bool = True, **more: Any) -> _Daemon:
        one = kind(map_path, *options, **more)
        started.append(one)
        return one.start() if start else one

    try:
        yield make
    finally:
        problems: list[str] = []
        for one in reversed(started):  # a later daemon may use an earlier one's directory
            problems += _stopped(one)
    gc.collect()
    problems += [
        f"descriptor {fd} -> {target}"
        for fd, target in open_files().items()
        if fd not in before and not target.startswith("/dev/null")
    ]
    if problems:
        raise InternalError("left behind:\n" + "\n".join(problems))


def _stopped(one: DaemonProcess) -> list[str]:
    """Stop a daemon and remove all its files; return its leftovers."""
    problems = []
    try:
        if one.process is not None and (code := one.stop()) != 0:
            problems.append(f"the daemon's exit code is {code}")
        problems += one.leftovers()
        return [*problems, one.log] if problems else []
    finally:
        one.dispose()


def wait_readable(fds: Sequence[int], timeout_s: float) -> list[int]:
    """Wait until a descriptor is readable; return the readable ones, none after ``timeout_s``."""
    poller = select.poll()
    for fd in fds:
        poller.register(fd, select.POLLIN)
    return [fd for fd, _ in poller.poll(max(0.0, timeout_s) * 1000)]


def wait_ended(pid: int, timeout_s: float = 30.0) -> bool:
    """Wait for a process to end; return whether it has."""
    try:
        fd = os.pidfd_open(pid)
    except ProcessLookupError:
        return True
    try:
        return bool(wait_readable([fd], timeout_s))
    finally:
        os.close(fd)


def processes_marked(mark: str, variable: str = "SHMMAP_TEST_RUN") -> list[int]:
    """Return the ids of living processes started with ``variable=mark`` in their environment."""
    wanted = f"{variable}={mark}".encode()
    found = []
    for entry in os.listdir("/proc"):
        if entry.isdigit():
            try:
                if wanted in Path(f"/proc/{entry}/environ").read_bytes().split(b"\0"):
                    found.append(int(entry))
            except OSError:  # ended meanwhile, or of another account
                continue
    return found


def open_files() -> dict[int, str]:
    """Return this process's open descriptors and their targets."""
    found = {}
    for entry in os.listdir("/proc/self/fd"):
        with contextlib.suppress(OSError):  # the descriptor that lists the directory
            found[int(entry)] = os.readlink(f"/proc/self/fd/{entry}")
    return found


def without_settings() -> dict[str, str]:
    """Return the variables without ``SHMMAP_*`` (settings of a real daemon), but with ``SHMMAP_TEST_*``."""
    return {
        name: value
        for name, value in os.environ.items()
        if not name.startswith("SHMMAP_") or name.startswith("SHMMAP_TEST_")
    }
