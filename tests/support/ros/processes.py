# SPDX-License-Identifier: Apache-2.0
"""``shmmap-ros-node`` and ROS clients as processes, in a DDS domain of their own, over Fast DDS."""

from __future__ import annotations

import contextlib
import fcntl
import importlib.util
import os
import pickle
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from tests.support.bridge_process import dds_domain
from tests.support.daemon_process import ROOT, DaemonProcess, until
from tests.support.ros.replies import Reply

WITHIN_S: Final = 120.0
_ATTEMPTS: Final = 6

NODE: Final = "/map/pointcloud_map_loader"
SERVICES: Final = {
    "partial": ("autoware_map_msgs/srv/GetPartialPointCloudMap", "/map/get_partial_pointcloud_map"),
    "differential": (
        "autoware_map_msgs/srv/GetDifferentialPointCloudMap",
        "/map/get_differential_pointcloud_map",
    ),
    "selected": ("autoware_map_msgs/srv/GetSelectedPointCloudMap", "/map/get_selected_pointcloud_map"),
}
"""Type and name, by what is asked for."""

_SHM: Final = Path("/dev/shm")
_SHARED: Final = re.compile(r"/dev/shm/(fastrtps_\S+)")


class RosDomain:
    """A domain of one test; use `ros_domain`.

    Attributes
    ----------
    program
        The node in C++, in place of ``shmmap-ros-node``.
    """

    def __init__(self, number: int, python: Path, folder: Path) -> None:
        self.number = number
        self.python = python
        self.folder = folder
        self.program: Path | None = None
        self._processes: list[subprocess.Popen[Any]] = []
        self._shared: set[str] = set()

    @property
    def environment(self) -> dict[str, str]:
        """Variables of the processes in it."""
        return {
            **os.environ,
            "PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'clients'}",
            "RMW_IMPLEMENTATION": os.environ.get("SHMMAP_TEST_RMW", "rmw_fastrtps_cpp"),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "ROS_DOMAIN_ID": str(self.number),
            "ROS_LOG_DIR": str(self.folder / "log"),
            "XDG_RUNTIME_DIR": "",
        }

    def start(
        self, *words: str, program: Path | None = None, numba: bool = False, **options: Any
    ) -> subprocess.Popen[Any]:
        """Start a program, or the interpreter that has rclpy; numba is that of this interpreter."""
        environment = self.environment
        if numba:
            found = importlib.util.find_spec("numba")
            assert found is not None
            assert found.origin is not None
            environment["PYTHONPATH"] += f"{os.pathsep}{Path(found.origin).parents[1]}"
        if program is not None:
            libraries = (str(program.parents[1]), environment.get("LD_LIBRARY_PATH", ""))
            environment["LD_LIBRARY_PATH"] = os.pathsep.join(filter(None, libraries))
        command: list[str | Path] = [program or self.python, *words]
        process = subprocess.Popen(command, env=environment, cwd=ROOT, **options)
        self._processes.append(process)
        return process

    def note_files(self) -> None:
        """Note which files of Fast DDS these processes have: one that is killed leaves them behind."""
        for process in self._processes:
            with contextlib.suppress(OSError):  # it has ended
                self._shared.update(_SHARED.findall(Path(f"/proc/{process.pid}/maps").read_text()))

    def node(self, daemon: DaemonProcess, *arguments: str) -> RosNode:
        """Start the node; arguments are what follows ``--ros-args``."""
        return RosNode(self, daemon, arguments)

    def peer(self) -> RosPeer:
        """Start a ROS client."""
        return RosPeer(self)

    def close(self) -> None:
        """Kill what is left, and remove what Fast DDS leaves then."""
        self.note_files()
        for process in self._processes:
            process.kill()
            process.communicate()
        for name in self._shared:
            _remove_unused(name)


def _remove_unused(name: str) -> None:
    """Remove a file of Fast DDS, and what belongs to it, unless some process has it (again)."""
    lock = _SHM / f"{name}_el"
    try:
        with open(lock) as held:
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
            for path in (_SHM / name, _SHM / f"sem.{name}_mutex", lock):
                path.unlink(missing_ok=True)
    except (FileNotFoundError, BlockingIOError):
        pass


@contextmanager
def ros_domain(python: Path, folder: Path) -> Iterator[RosDomain]:
    """Have a domain to oneself."""
    with dds_domain() as number:
        domain = RosDomain(number, python, folder)
        try:
            yield domain
        finally:
            domain.close()


class RosProgram:
    """A program of this tree with rclpy.

    Parameters
    ----------
    domain
    words
        Module and arguments.
    output
        File of its standard output, if that is wanted.
    program
        Another program, whose arguments the words are.
    numba
        Whether it needs that.
    """

    def __init__(
        self,
        domain: RosDomain,
        words: Sequence[str],
        *,
        output: Path | None = None,
        program: Path | None = None,
        numba: bool = False,
    ) -> None:
        self._domain = domain
        self._words = ["-m", *words] if program is None else [*words]
        self._output, self._program, self._numba = output, program, numba
        self._said: list[str] = []
        self.start()

    def start(self) -> None:
        """Start it (again)."""
        with open(self._output or os.devnull, "w", encoding="utf-8") as stdout:
            self.process = self._domain.start(
                *self._words,
                program=self._program,
                numba=self._numba,
                stdin=subprocess.DEVNULL,
                stdout=stdout,
                stderr=subprocess.PIPE,
                text=True,
            )
        self._listener = threading.Thread(target=self._listen, args=(self.process,))
        self._listener.start()

    def _listen(self, process: subprocess.Popen[str]) -> None:
        assert process.stderr is not None
        for line in process.stderr:
            self._said.append(line)
            print(line, end="", file=sys.stderr)  # shown where a test fails

    @property
    def pid(self) -> int:
        """Its process id."""
        return int(self.process.pid)

    @property
    def log(self) -> str:
        """All that it said."""
        return "".join(self._said)

    def wait_said(self, text: str) -> None:
        """Wait until it has said something."""
        until(lambda: text in self.log, lambda: self.log)

    def end(self, number: signal.Signals) -> int:
        """Send a signal that it ends by; returns its exit code."""
        self._domain.note_files()
        self.process.send_signal(number)
        try:
            return int(self.process.wait(WITHIN_S))
        finally:
            self.process.kill()
            self._listener.join()


class RosNode(RosProgram):
    """``shmmap-ros-node``, or the domain's program."""

    def __init__(self, domain: RosDomain, daemon: DaemonProcess, arguments: Sequence[str]) -> None:
        words = ["--ros-args", "-p", f"endpoint:={daemon.endpoint}", *arguments]
        if domain.program is None:
            words.insert(0, "shmmap_clients.ros_node")
        super().__init__(domain, words, program=domain.program)


class RosPeer:
    """A process with ROS nodes that ask; ``who`` is one node of it, with a participant of its own."""

    def __init__(self, domain: RosDomain) -> None:
        self._domain = domain
        self.process = domain.start(
            "-m", "tests.support.ros.peer", stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        self._clients: list[RosClient] = []

    def ask(self, method: str, *arguments: Any, who: str = "", **keywords: Any) -> Any:
        """Call one of the methods of `tests.support.ros.peer.Peer`."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        pickle.dump((who, method, arguments, keywords), self.process.stdin)
        self.process.stdin.flush()
        done, result = pickle.load(self.process.stdout)
        assert done, result
        return result

    def client(self, verb: str, *, depth: int = 10, who: str = "") -> RosClient:
        """A client of a map service."""
        return self.client_of(*SERVICES[verb], depth=depth, who=who)

    def client_of(self, type_name: str, name: str, *, depth: int = 10, who: str = "") -> RosClient:
        """A client of any service."""
        self._clients.append(RosClient(self, who, self.ask("client", type_name, name, depth, who=who)))
        return self._clients[-1]

    def asked(self, verb: str, *, area: Sequence[float] = (), ids: Sequence[str] = ()) -> Reply:
        """Ask a map service as a client of its own."""
        client = self.client(verb)
        reply: Reply = client.call(**fields(verb, area=area, ids=ids))
        return reply

    def subscribed(self, type_name: str, name: str, *, latched: bool = True) -> Subscription:
        """Subscribe to a topic."""
        return Subscription(self, self.ask("subscribe", type_name, name, latched))

    def advertised(self, type_name: str, name: str, *, latched: bool = False) -> Publication:
        """Advertise a topic."""
        return Publication(self, self.ask("advertise", type_name, name, latched))

    def send_all(self, clients: Sequence[RosClient], requests: Sequence[dict[str, Any]]) -> list[int]:
        """Send requests at once, one by each client; returns their numbers."""
        return list(self.ask("send", [one.number for one in clients], list(requests)))

    def servers(self, verb: str) -> set[bytes]:
        """Both ends of each server of a map service."""
        return {*self.ask("servers", SERVICES[verb][1])}

    def wait_other_server(self, verb: str, before: set[bytes]) -> None:
        """Wait until there is another: the one before counts as there for 20 s after its death."""
        until(lambda: len(self.servers(verb) - before) == 2)
        for client in self._clients:
            client.met = False


def fields(verb: str, *, area: Sequence[float] = (), ids: Sequence[str] = ()) -> dict[str, Any]:
    """Fields of a request to a map service."""
    found: dict[str, Any] = {}
    if area:
        found["area"] = dict(zip(("center_x", "center_y", "radius"), map(float, area), strict=True))
    if verb != "partial":
        found["cached_ids" if verb == "differential" else "cell_ids"] = list(ids)
    return found


class RosClient:
    """A client of one service.

    Attributes
    ----------
    met
        Whether its server has found it: before, ROS loses answers to it, although the service is ready.
    """

    def __init__(self, peer: RosPeer, who: str, number: int) -> None:
        self._peer, self._who, self.number = peer, who, number
        self.met = False

    def wait_ready(self) -> None:
        """Wait until the service is there."""
        assert self._peer.ask("ready", self.number, WITHIN_S, who=self._who), "the service is not there"

    def send(self, **fields: Any) -> int:
        """Send a request once the service is there; returns its number."""
        self.wait_ready()
        (number,) = self._peer.ask("send", [self.number], [fields], who=self._who)
        return int(number)

    def receive(self, number: int) -> Any:
        """Wait for the answer."""
        found = self._peer.ask("receive", number, WITHIN_S, who=self._who)
        assert found is not None, "no answer"
        return found

    def call(self, **fields: Any) -> Any:
        """Send a request, and wait for the answer; again where the server may not have found it yet."""
        attempts = 1 if self.met else _ATTEMPTS
        for _ in range(attempts):
            number = self.send(**fields)
            found = self._peer.ask("receive", number, WITHIN_S / attempts, who=self._who)
            if found is not None:
                self.met = True
                return found
        raise AssertionError("no answer")


class Subscription:
    """What comes of a topic, one after another."""

    def __init__(self, peer: RosPeer, number: int) -> None:
        self._peer, self._number, self._taken = peer, number, 0

    def next(self) -> Any:
        """Wait for the next message."""
        found = self._peer.ask("message", self._number, self._taken, WITHIN_S)
        assert found is not None, "no message"
        self._taken += 1
        return found

    def end(self) -> None:
        """Subscribe no longer."""
        self._peer.ask("unsubscribe", self._number)


class Publication:
    """A topic that is published."""

    def __init__(self, peer: RosPeer, number: int) -> None:
        self._peer, self._number = peer, number

    def send(self, **fields: Any) -> None:
        """Publish a message."""
        self._peer.ask("publish", self._number, fields)

    def repeat(self, **fields: Any) -> None:
        """Publish a message again and again, in place of the one before."""
        self._peer.ask("repeat", self._number, fields)

    def rest(self) -> None:
        """Repeat no longer."""
        self._peer.ask("rest", self._number)
