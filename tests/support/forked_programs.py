# SPDX-License-Identifier: Apache-2.0
"""Runs ``shmmap``, its programs and daemons in forks of a process that has imported them, which is quicker.

Whatever a process does after its imports is done: arguments, environment, directory, exit code, a crash at a
step, other modules on the path.  Command lines of the pages, programs other than the daemon that are sent
signals, and what depends on the interpreter's start (another ``shmmap`` on the path, ``LD_PRELOAD``, the
locale) are processes of their own elsewhere.

As a program: ``python -m tests.support.forked_programs FD`` serves requests on a socket until its end.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import importlib
import importlib.util
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
from pathlib import Path
from typing import IO, Any, Final

from tests.support.kernels_once import watch

ROOT: Final = Path(__file__).resolve().parents[2]

_AT_START: Final = ("PYTHON", "LD_", "LC_", "LANG", "NUMBA_")
_PACKAGES: Final = (
    "shmmap.cli.verbs",
    "shmmap.live_worker",
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
    "shmmap.daemon.loading.worker_main",
    "shmmap.daemon.main",
    "shmmap.daemon.map.published_origin",
    "cryptography.hazmat.primitives.serialization",
    "numba",
    "obstore",
    "securesystemslib.signer",
    "tuf.api.metadata",
    "tuf.ngclient",
    "zstandard",
)
_ROOM: Final = 1 << 14
"""Bytes of a command line, and of an environment, more than the fork server has itself."""
_PR_SET_CHILD_SUBREAPER: Final = 36
_prctl: Final = ctypes.CDLL(None).prctl
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
    server = _ready_for(environment)
    if server is None:
        return subprocess.run(
            [sys.executable, "-m", module, *words],
            env=environment,
            cwd=cwd,
            capture_output=True,
            text=True,
            check=False,
        )
    try:
        return server.run(_request(module, words, environment, os.path.abspath(cwd), adopted=False))
    finally:
        server.lock.release()


def fork_program(
    module: str, words: Sequence[str], environment: Mapping[str, str], output: IO[bytes]
) -> subprocess.Popen[bytes] | None:
    """Start ``python -m MODULE WORDS`` in ``/`` and in a session of its own; None if it cannot be a fork.

    It is this process's child, and has its command line and environment in ``/proc``.
    """
    server = _ready_for(environment)
    if server is None:
        return None
    request = _request(module, words, environment, "/", adopted=True)
    fd = output.fileno()
    try:
        # an orphan becomes this process's child, and so does the fork, when the process that forked it ends
        _prctl(_PR_SET_CHILD_SUBREAPER, 1)
        pid = server.ask(request, [fd, fd])
    finally:
        _prctl(_PR_SET_CHILD_SUBREAPER, 0)
        server.lock.release()
    return _Adopted(pid, [sys.executable, "-m", module, *words])


def _request(
    module: str, words: Sequence[str], environment: Mapping[str, str], cwd: str, *, adopted: bool
) -> dict[str, Any]:
    return {
        "module": module,
        "words": list(words),
        "environment": dict(environment),
        "cwd": cwd,
        "adopted": adopted,
    }


class _Adopted(subprocess.Popen[bytes]):
    """A child that `subprocess` has not started."""

    def __init__(self, pid: int, arguments: list[str]) -> None:  # instead of its own, which would start one
        self.pid = pid
        self.args = arguments
        self.stdin = self.stdout = self.stderr = None
        self.returncode: Any = None
        self._child_created = True
        self._waitpid_lock = threading.Lock()
        self._communication_started = False
        self._sigint_wait_secs = 0.25


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
                [
                    sys.executable,
                    "-m",
                    "tests.support.forked_programs",
                    str(self._theirs.fileno()),
                    "." * _ROOM,
                ],
                cwd=ROOT,
                env={**os.environ, "PYTHONPATH": str(ROOT), "PYTEST_ROOM": "." * _ROOM},
                pass_fds=[self._theirs.fileno()],
                stdin=subprocess.DEVNULL,
                start_new_session=True,
            )

    def may_run(self, environment: Mapping[str, str]) -> bool:
        return _at_start(environment) == self._start

    def ask(self, request: dict[str, Any], fds: Sequence[int]) -> int:
        if self._process is None:
            self._begin()
        socket.send_fds(self._socket, [json.dumps(request).encode()], fds)
        return int(self._socket.recv(64))

    def run(self, request: dict[str, Any]) -> subprocess.CompletedProcess[str]:
        with tempfile.TemporaryFile("w+") as out, tempfile.TemporaryFile("w+") as errors:
            code = self.ask(request, [out.fileno(), errors.fileno()])
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


_servers: Final[list[_Server]] = []
"""The one that forks, where there is one."""


@contextlib.contextmanager
def forking() -> Iterator[None]:
    """Fork programs until this ends; outside of it, as in benchmarks, each is an interpreter of its own."""
    _servers.append(_Server())
    try:
        yield
    finally:
        _servers.pop().close()


def _ready_for(environment: Mapping[str, str]) -> _Server | None:
    """Return the server, locked, where it may and can fork a program with this environment now."""
    for server in _servers:
        if server.may_run(environment) and server.lock.acquire(blocking=False):
            return server
    return None


def _at_start(environment: Mapping[str, str]) -> dict[str, str]:
    """What an interpreter reads once, less a module path that a fork can add to its own."""
    found = {name: value for name, value in environment.items() if name.startswith(_AT_START)}
    if not any(map(_hides_a_module, _other_paths(environment))):
        found.pop("PYTHONPATH", None)
    return found


def _other_paths(environment: Mapping[str, str]) -> list[str]:
    """Return the module path that an environment gives, less this project's."""
    path = environment.get("PYTHONPATH", "").split(os.pathsep)
    return [one for one in path if one not in ("", str(ROOT))]


def _hides_a_module(folder: str) -> bool:
    """Whether a folder has a module of a name that a fork may have imported from elsewhere."""
    names = {path.stem for path in Path(folder).glob("[!_]*") if path.stem.isidentifier()}
    return "sitecustomize" in names or any(importlib.util.find_spec(name) is not None for name in names)


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
    _show(request)
    if request["adopted"]:
        os.setsid()
    tempfile.tempdir = None
    os.chdir(request["cwd"])
    sys.argv[1:] = request["words"]
    sys.path[1:1] = _other_paths(os.environ)
    from shmmap import failpoints

    old = failpoints.step
    new = importlib.reload(failpoints).step
    if new is not old:
        for module in list(sys.modules.values()):
            if getattr(module, "step", None) is old:
                module.step = new  # type: ignore[attr-defined]


def _show(request: dict[str, Any]) -> None:
    """Write the command line and the environment to where ``/proc/PID`` has them from, see proc(5)."""
    command = [sys.executable, "-m", request["module"], *request["words"]]
    environment = [f"{name}={value}" for name, value in request["environment"].items()]
    fields = Path("/proc/self/stat").read_text().rsplit(")", 1)[1].split()
    first, end_of_command, start, end = map(int, fields[45:49])
    for what, begin, behind in ((command, first, end_of_command), (environment, start, end)):
        text = b"".join(os.fsencode(one) + b"\0" for one in what)
        assert len(text) <= behind - begin
        ctypes.memset(begin, 0, behind - begin)
        ctypes.memmove(begin, text, len(text))


def _fork(request: dict[str, Any], fds: list[int], *sockets: socket.socket) -> int:
    """Fork for a request; the fork closes these sockets."""
    pid = os.fork()
    if pid:
        return pid
    for one in sockets:
        one.close()
    _become(request, fds)
    runpy.run_module(request["module"], run_name="__main__", alter_sys=True)
    sys.exit(0)


def _fork_for_adoption(request: dict[str, Any], fds: list[int], requests: socket.socket) -> int:
    """Fork, and end between: the fork's parent is the nearest ancestor that adopts orphans."""
    ours, theirs = socket.socketpair()
    with ours:
        between = os.fork()
        if between == 0:
            ours.close()
            theirs.send(str(_fork(request, fds, theirs, requests)).encode())
            os._exit(0)
        theirs.close()
        os.waitpid(between, 0)
        return int(ours.recv(64))


def main() -> None:
    """Fork for each request; a fork ends as its program does."""
    requests = socket.socket(fileno=int(sys.argv[1]))
    if "NUMBA_CACHE_DIR" in os.environ:
        watch(late=False)
    _import_all()
    gc.freeze()
    while True:
        data, fds, _, _ = socket.recv_fds(requests, _REQUEST_BYTES, _FDS)
        if not data:
            return
        request = json.loads(data)
        if request["adopted"]:
            answer = _fork_for_adoption(request, fds, requests)
        else:
            answer = os.waitstatus_to_exitcode(os.waitpid(_fork(request, fds, requests), 0)[1])
        for fd in fds:
            os.close(fd)
        requests.send(str(answer).encode())


if __name__ == "__main__":
    main()
