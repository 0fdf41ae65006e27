# SPDX-License-Identifier: Apache-2.0
"""Runs ``shmmap``, its programs and daemons in forks of a process that has imported them, which is quicker.

Whatever a process does after its imports is done: arguments, environment, directory, exit code, a crash at a
step, other modules on the path, what is registered for its end.  Command lines of the pages, programs other
than the daemon that are sent signals, and what depends on the interpreter's start (another ``shmmap`` on the
path, ``LD_PRELOAD``, the locale) are processes of their own elsewhere.  So is what a program starts in turn,
except for what `_starts_children` knows: a daemon's live worker, and others, are forks, too.

As a program: ``python -m tests.support.forked_programs FD`` serves requests on a socket until its end.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import gc
import importlib
import importlib.util
import json
import os
import pkgutil
import runpy
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import IO, Any, Final, NoReturn

from shmmap.installed import refuse_if_replaced
from shmmap.processes.end_with_parent import die_with
from shmmap.processes.start_child import ForkedProcess, channel
from tests.support.kernels_once import watch

ROOT: Final = Path(__file__).resolve().parents[2]

_STARTERS: Final = (
    "shmmap.daemon.live_relay",
    "shmmap.dividing.served_cloud",
    "shmmap.origin.remote.verify_apart",
    "shmmap.prepare.task_pool",
)
"""Modules that start children of a program, other than loaders."""
_AT_START: Final = ("PYTHON", "LD_", "LC_", "LANG", "NUMBA_")
_PACKAGES: Final = (
    "shmmap.cli.verbs",
    "shmmap.live_worker",
    "shmmap.prepare",
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
    "shmmap.dividing.child_main",
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
_ADOPTED_S: Final = 60.0
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
        with _adopting():  # also the fork, when the process that forked it ends
            pid = server.ask(request, [fd, fd])
    finally:
        server.lock.release()
    return _Adopted(pid, [sys.executable, "-m", module, *words])


def fork_child(module: str) -> tuple[ForkedProcess, socket.socket] | None:
    """Do what `shmmap.processes.start_child.fork_child` does, for a process that has threads and sockets."""
    server = _ready_for(os.environ)
    if server is None:
        return None
    ours, theirs = channel()
    request = _request(module, (), os.environ, "/", adopted=True, program=os.getpid())
    try:
        with theirs, _adopting():
            return ForkedProcess(server.ask(request, [theirs.fileno(), 2])), ours
    finally:
        server.lock.release()


def _request(
    module: str,
    words: Sequence[str],
    environment: Mapping[str, str],
    cwd: str,
    *,
    adopted: bool,
    program: int = 0,
) -> dict[str, Any]:
    """Describe a process; ``program`` is the one that it is a child of, with a channel to it."""
    return {
        "module": module,
        "words": list(words),
        "environment": dict(environment),
        "cwd": cwd,
        "adopted": adopted,
        "program": program,
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
    failures = _failures()
    os.environ.clear()
    os.environ.update(request["environment"])
    _show(request)
    if request["adopted"]:
        os.setsid()
    tempfile.tempdir = None
    os.chdir(request["cwd"])
    sys.argv[1:] = request["words"]
    sys.path[1:1] = _other_paths(os.environ)
    if failures != _failures():
        from shmmap import failpoints

        old = failpoints.step
        new = importlib.reload(failpoints).step
        for module in list(sys.modules.values()):
            if getattr(module, "step", None) is old:
                module.step = new  # type: ignore[attr-defined]


def _failures() -> list[str | None]:
    """Return what `shmmap.failpoints` reads as it is imported."""
    return [os.environ.get(name) for name in ("SHMMAP_TEST_CRASH", "SHMMAP_TEST_DEFECT")]


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


def _start(request: dict[str, Any], fds: list[int], requests: socket.socket) -> NoReturn:
    """Run in this fork what was asked for."""
    requests.close()
    _become(request, fds)
    if _starts_children(request["module"], request["words"]):
        stem = _Stem()
        for name in _STARTERS:
            vars(sys.modules[name])["start_child"] = stem.start_child
    _run(request["module"])


def _starts_children(module: str, words: list[str]) -> bool:
    """Whether a program is likely to start a live worker, workers, or a process that divides or verifies."""
    if module == "shmmap.daemon":
        return "--live-budget" in words or not os.path.isdir(words[0])
    return module == "shmmap.cli" and (words[:1] in (["publish"], ["prepare"]) or "--trust" in words)


def _run(module: str) -> NoReturn:
    """Run a module as a program, to its end.

    This process ends as `multiprocessing` ends its own: modules that it shares are not taken apart.  That
    would copy all their memory, and take twenty times the CPU of the fork.
    """
    code = 0
    try:
        runpy.run_module(module, run_name="__main__", alter_sys=True)
    except SystemExit as end:
        if isinstance(end.code, str):
            raise  # the interpreter prints it
        code = end.code or 0
    threading._shutdown()  # type: ignore[attr-defined]
    atexit._run_exitfuncs()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def _fork_for_adoption(run: Callable[[], NoReturn]) -> int:
    """Fork, and end between: the fork's parent is the nearest ancestor that adopts orphans."""
    ours, theirs = socket.socketpair()
    with ours:
        between = os.fork()
        if between == 0:
            ours.close()
            pid = os.fork()
            if pid == 0:
                theirs.close()
                run()
            theirs.send(str(pid).encode())
            os._exit(0)
        theirs.close()
        os.waitpid(between, 0)
        return int(ours.recv(64))


class _Stem:
    """A fork of a program that is about to run; workers that the program starts are forks of it in turn.

    It is made before the program has threads, and ends with it, a moment later: so it shows nothing of the
    program's environment, and keeps none of its files open.
    """

    def __init__(self) -> None:
        self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        program = os.getpid()
        if os.fork() == 0:
            self._socket.close()
            die_with(program)
            signal.signal(signal.SIGINT, signal.SIG_IGN)
            _show({"module": __name__, "words": [], "environment": {}})
            nowhere = os.open(os.devnull, os.O_RDWR)
            for fd in range(3):
                os.dup2(nowhere, fd)
            os.close(nowhere)
            os.chdir("/")
            theirs.send(b"ready")
            _fork_workers(theirs)
        theirs.close()
        self._socket.recv(64)
        self._lock = threading.Lock()

    def start_child(
        self, module: str, *arguments: str, new_session: bool
    ) -> tuple[subprocess.Popen[bytes], socket.socket]:
        """Do what `shmmap.processes.start_child.start_child` does."""
        refuse_if_replaced(module)
        ours, theirs = channel()
        request = _request(module, arguments, os.environ, "/", adopted=new_session, program=os.getpid())
        with self._lock, theirs, _adopting():
            socket.send_fds(self._socket, [json.dumps(request).encode()], [theirs.fileno(), 2])
            pid = int(self._socket.recv(64))
        return _Adopted(pid, [sys.executable, "-m", module]), ours


def _fork_workers(requests: socket.socket) -> NoReturn:
    """Fork workers of a program, whenever it asks for one."""
    while True:
        data, fds, _, _ = socket.recv_fds(requests, _REQUEST_BYTES, _FDS)
        if not data:
            os._exit(0)  # the program has ended
        pid = _fork_for_adoption(partial(_work, json.loads(data), fds, requests))
        requests.send(str(pid).encode())
        for fd in fds:
            os.close(fd)


def _work(request: dict[str, Any], fds: list[int], requests: socket.socket) -> NoReturn:
    """Be a worker of a program, once this fork is its child; ``fds``: its socket and the program's stderr."""
    requests.close()
    (fd, errors), program = fds, request["program"]
    end_s = time.monotonic() + _ADOPTED_S
    while os.getppid() != program and time.monotonic() < end_s:
        time.sleep(0.0005)
    request["words"] = [str(fd), str(program), *request["words"]]
    _become(request, [os.open(os.devnull, os.O_WRONLY), errors])
    _run(request["module"])


@contextlib.contextmanager
def _adopting() -> Iterator[None]:
    """Have orphans among this process's descendants become its children meanwhile."""
    _prctl(_PR_SET_CHILD_SUBREAPER, 1)
    try:
        yield
    finally:
        _prctl(_PR_SET_CHILD_SUBREAPER, 0)


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
        start = partial(_work if request["program"] else _start, request, fds, requests)
        if request["adopted"]:
            answer = _fork_for_adoption(start)
        else:
            pid = os.fork()
            if pid == 0:
                start()
            answer = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        for fd in fds:
            os.close(fd)
        requests.send(str(answer).encode())


if __name__ == "__main__":
    main()
