# SPDX-License-Identifier: Apache-2.0
"""A real daemon in a process of its own, for demonstrations and tests; it leaves nothing behind."""

from __future__ import annotations

import contextlib
import os
import secrets
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Final

from shmmap.demo.environment import without_settings
from shmmap.demo.interrupts import interrupts_later, scratch_directory
from shmmap.demo.process_memory import descendants
from shmmap.errors import InternalError
from shmmap.segment.directory import DEFAULT_SHM_DIR

__all__ = ["DaemonProcess"]

_STOP_S: Final = 10.0
_LOG_LINES: Final = 20


class DaemonProcess:
    """Runs ``python -m shmmap.daemon`` with a name, socket and log of its own; ``SHMMAP_*`` does not matter.

    Parameters
    ----------
    map_path
        The map to serve.
    options
        More command-line options of ``shmmap serve``.
    shm_dir
        Directory of the segments.
    start_s
        How long the daemon may take until it is ready.

    Used as a context manager: ready on entry; on exit it is stopped, killed if it does not
    stop within ten seconds, and whatever it left then is removed.

    Raises
    ------
    InternalError
        From entering: the daemon ended or was not ready in time; the message holds its last words.
    """

    def __init__(
        self,
        map_path: str | os.PathLike[str],
        *,
        options: Sequence[str] = (),
        shm_dir: str = DEFAULT_SHM_DIR,
        start_s: float = 60.0,
    ) -> None:
        self.instance = f"test-{os.getpid()}-{secrets.token_hex(4)}"
        self.shm_dir = shm_dir
        self._map_path = os.fspath(map_path)
        self._options = list(options)
        self._start_s = start_s
        self._process: subprocess.Popen[bytes] | None = None
        self._directory: Path | None = None
        self._scratch = contextlib.ExitStack()

    @property
    def pid(self) -> int:
        """Process id of the daemon."""
        if self._process is None:
            raise InternalError("the daemon is not running")
        return self._process.pid

    @property
    def directory(self) -> Path:
        """Directory of its socket and log."""
        if self._directory is None:
            raise InternalError("the daemon is not running")
        return self._directory

    @property
    def endpoint(self) -> str:
        """Path of its request socket."""
        return str(self.directory / f"{self.instance}.sock")

    @property
    def log(self) -> str:
        """What it wrote to stderr so far."""
        return (self.directory / "log").read_text(encoding="utf-8", errors="replace")

    def pids(self) -> list[int]:
        """Return the daemon and its workers."""
        return descendants(self.pid)

    def __enter__(self) -> DaemonProcess:
        # under /tmp whatever TMPDIR says: a socket's path holds 107 bytes
        directory = self._scratch.enter_context(scratch_directory(f"shmmap-{os.getpid()}-", "/tmp"))  # noqa: S108
        self._directory = Path(directory)
        try:
            self._start(self._directory)
        except BaseException:
            self.stop()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def _start(self, directory: Path) -> None:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as ready:
            ready.bind(str(directory / "notify"))
            command = [sys.executable, "-m", "shmmap.daemon", self._map_path, *self._options]
            command += ["--instance", self.instance, "--runtime-dir", str(directory)]
            command += ["--shm-dir", self.shm_dir]
            with open(directory / "log", "wb") as log, interrupts_later():
                self._process = subprocess.Popen(
                    command,
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=log,
                    env=without_settings() | {"NOTIFY_SOCKET": str(directory / "notify")},
                    start_new_session=True,  # a Ctrl-C is ours to handle, in order
                )
            self._wait_until_ready(ready)

    def _wait_until_ready(self, ready: socket.socket) -> None:
        deadline = time.monotonic() + self._start_s
        end = os.pidfd_open(self.pid)
        try:
            while (left := deadline - time.monotonic()) > 0:
                events, _, _ = select.select([ready.fileno(), end], [], [], left)
                if ready.fileno() in events and b"READY=1" in ready.recv(4096).split(b"\n"):
                    return
                if end in events:
                    break
        finally:
            os.close(end)
        last_words = "\n".join(self.log.splitlines()[-_LOG_LINES:])
        raise InternalError(f"the daemon did not become ready:\n{last_words}")

    def stop(self) -> None:
        """Stop the daemon, and remove whatever a killed one leaves."""
        with interrupts_later(), self._scratch:
            if self._process is None:
                return
            family = self.pids()
            self._process.terminate()
            try:
                self._process.wait(_STOP_S)
            except subprocess.TimeoutExpired:
                for pid in family:
                    with contextlib.suppress(ProcessLookupError):
                        os.kill(pid, signal.SIGKILL)
                self._process.wait()
            self._process = None
            prefix = f"shmmap.{self.instance}."
            for name in os.listdir(self.shm_dir):
                if name.startswith(prefix):
                    Path(self.shm_dir, name).unlink(missing_ok=True)
