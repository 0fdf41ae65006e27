# SPDX-License-Identifier: Apache-2.0
"""``shmmap-ros-bridge`` as a process: what it says, and its ends."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import TracebackType
from typing import Any

from tests.support.daemon_process import ROOT, DaemonProcess
from tests.support.dds_domain import URI

__all__ = ["PROGRAM", "BridgeProcess", "bridge_environment"]

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
        """What it tells doctor."""
        told: dict[str, Any] = json.loads(self._status.read_text())
        return told

    def wait_status(self, within_s: float = WITHIN_S, **wanted: Any) -> None:
        """Wait until it tells this."""
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
        code = self.process.wait(WITHIN_S)
        self._listener.join()
        return code

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
