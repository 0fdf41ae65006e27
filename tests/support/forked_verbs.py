# SPDX-License-Identifier: Apache-2.0
"""Runs ``shmmap`` and its programs in forks of a process that has imported them: a second less for each.

Whatever a process does after its imports is done: arguments, environment, directory, exit code, a crash at a
step.  Command lines of the pages, programs that are sent signals, and what depends on the interpreter's
start (``PYTHONPATH``, ``LD_PRELOAD``, the locale) are processes of their own elsewhere.

As a program: ``python -m tests.support.forked_verbs FD`` serves requests on a socket until its end.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import pkgutil
import runpy
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from typing import Any, Final

from tests.support.daemon_process import ROOT

__all__ = ["forking", "run_verb"]

_AT_START: Final = ("PYTHON", "LD_", "LC_", "LANG", "NUMBA_")
_PACKAGES: Final = (
    "shmmap.cli.verbs",
    "shmmap.daemon.live",
    "shmmap.publishing",
    "shmmap.origin.remote",
    "shmmap_clients.compare_map_filter",
    "shmmap_clients.elevation_map",
    "shmmap_clients.ndt_scan_matcher",
    "shmmap_clients.pose_initializer",
    "shmmap_clients.rolling_map",
)
_MODULES: Final = (
    "shmmap.cli.entry",
    "shmmap.client.client",
    "cryptography.hazmat.primitives.serialization",
    "numba",
    "obstore",
    "securesystemslib.signer",
    "tuf.api.metadata",
    "tuf.ngclient",
    "zstandard",
)
_REQUEST_BYTES: Final = 1 << 18
_FDS: Final = 2


def run_verb(
    words: Sequence[str],
    environment: Mapping[str, str] | None = None,
    cwd: str | os.PathLike[str] = ".",
    *,
    module: str = "shmmap.cli",
) -> subprocess.CompletedProcess[str]:
    """Run ``python -m MODULE WORDS``, as `subprocess.run` does, and return its output and exit code."""
    environment = dict(os.environ if environment is None else environment)
    server = _server()
    if not server.may_run(environment) or not server.lock.acquire(blocking=False):
        return subprocess.run(
            [sys.executable, "-m", module, *words],
            env=environment,
            cwd=cwd,
            capture_output=True,
            text=True,
            check=False,
        )
    try:
        directory = os.path.abspath(cwd)
        return server.run(
            {"words": list(words), "environment": environment, "cwd": directory, "module": module}
        )
    finally:
        server.lock.release()


class _Server:
    """Its socket is open from the start, so that no test seems to leak it; it runs from the first verb on."""

    def __init__(self) -> None:
        self._socket, self._theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._process: subprocess.Popen[bytes] | None = None
        self._start = _at_start(os.environ)
        self.lock = threading.Lock()

    def _begin(self) -> None:
        with self._theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "tests.support.forked_verbs", str(self._theirs.fileno())],
                cwd=ROOT,
                env={**os.environ, "PYTHONPATH": str(ROOT)},
                pass_fds=[self._theirs.fileno()],
                stdin=subprocess.DEVNULL,
                start_new_session=True,
            )

    def may_run(self, environment: Mapping[str, str]) -> bool:
        return _at_start(environment) == self._start

    def run(self, request: dict[str, Any]) -> subprocess.CompletedProcess[str]:
        if self._process is None:
            self._begin()
        with tempfile.TemporaryFile("w+") as out, tempfile.TemporaryFile("w+") as errors:
            fds = [out.fileno(), errors.fileno()]
            socket.send_fds(self._socket, [json.dumps(request).encode()], fds)
            code = int(self._socket.recv(64))
            texts = []
            for file in (out, errors):
                file.seek(0)
                texts.append(file.read())
        return subprocess.CompletedProcess(request["words"], code, *texts)

    def close(self) -> None:
        self._socket.close()
        self._theirs.close()
        if self._process is not None:
            self._process.wait()


@cache
def _server() -> _Server:
    return _Server()


@contextlib.contextmanager
def forking() -> Iterator[None]:
    """Fork verbs until this ends."""
    server = _server()
    try:
        yield
    finally:
        server.close()
        _server.cache_clear()


def _at_start(environment: Mapping[str, str]) -> dict[str, str]:
    """What an interpreter reads once, less the path of this project."""
    found = {name: value for name, value in environment.items() if name.startswith(_AT_START)}
    if found.get("PYTHONPATH") in ("", str(ROOT)):
        del found["PYTHONPATH"]
    return found


def _import_all() -> None:
    names = list(_MODULES)
    for package in _PACKAGES:
        path = importlib.import_module(package).__path__
        names += [one.name for one in pkgutil.iter_modules(path, f"{package}.") if "__main__" not in one.name]
    for name in names:
        with contextlib.suppress(ImportError):  # an extra that is not installed
            importlib.import_module(name)


def _become(request: dict[str, Any], fds: list[int]) -> None:
    """Make of this fork the process that was asked for."""
    for place, fd in enumerate(fds, 1):
        os.dup2(fd, place)
        os.close(fd)
    os.environ.clear()
    os.environ.update(request["environment"])
    os.chdir(request["cwd"])
    sys.argv[1:] = request["words"]
    from shmmap import failpoints

    old = failpoints.step
    new = importlib.reload(failpoints).step
    if new is not old:
        for module in list(sys.modules.values()):
            if getattr(module, "step", None) is old:
                module.step = new  # type: ignore[attr-defined]


def main() -> int:
    """Fork for each request; a fork ends as its program does."""
    requests = socket.socket(fileno=int(sys.argv[1]))
    _import_all()
    while True:
        data, fds, _, _ = socket.recv_fds(requests, _REQUEST_BYTES, _FDS)
        if not data:
            return 0
        pid = os.fork()
        if pid == 0:
            requests.close()
            request = json.loads(data)
            _become(request, fds)
            runpy.run_module(request["module"], run_name="__main__", alter_sys=True)
            return 0
        for fd in fds:
            os.close(fd)
        _, status = os.waitpid(pid, 0)
        requests.send(str(os.waitstatus_to_exitcode(status)).encode())


if __name__ == "__main__":
    sys.exit(main())
