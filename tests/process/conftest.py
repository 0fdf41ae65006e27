# SPDX-License-Identifier: Apache-2.0
"""Fixtures for tests with real daemons: each isolated, each judged from outside when it ends."""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import pytest

from shmmap.errors import ShmmapError
from shmmap.testing.fixtures import judged_daemons
from tests.support.command_line import Shmmap, Verbs
from tests.support.daemon_process import DaemonProcess
from tests.support.divided_map import DividedMap, make_map
from tests.support.live_reference import LIVE_TOML, LiveDaemon
from tests.support.map_stores import _buckets, buckets, signed_maps, web  # noqa: F401  fixtures
from tests.support.raw_client import RawClient

RESOLUTION = 0.2  # that of ``live_drive``, which compiles kernels: before pytest has said where they are kept

if TYPE_CHECKING:
    from tests.support.bridge_process import BridgeProcess
    from tests.support.ros.processes import RosDomain
    from tests.support.ros_peer import RosPeer

DaemonFactory = Callable[..., DaemonProcess]
Meanwhile = Callable[[str, Callable[[], object]], list[object]]


@pytest.fixture
def meanwhile(monkeypatch: pytest.MonkeyPatch) -> Meanwhile:
    """Do something when a publisher reaches a step for the first time; returns its result or error."""
    from shmmap.origin.remote import map_versions
    from shmmap.publishing import joining, new_version, prune, publish, restore

    def arrange(label: str, act: Callable[[], object]) -> list[object]:
        outcome: list[object] = []
        acting: list[bool] = []

        def step(at: str) -> None:
            if at == label and not acting:
                acting.append(True)
                try:
                    outcome.append(act())
                except ShmmapError as error:
                    outcome.append(error)

        for module in (map_versions, publish, new_version, restore, joining, prune):
            if hasattr(module, "step"):
                monkeypatch.setattr(module, "step", step)
        return outcome

    return arrange


@pytest.fixture
def private_tmpfs(tmp_path: Path) -> Iterator[Callable[[str], str]]:
    """Mount tmpfs file systems of their own, ``private_tmpfs("16m")``: no other program fills them."""
    mounted: list[str] = []

    def mount(size: str) -> str:
        path = tmp_path / f"tmpfs{len(mounted)}"
        path.mkdir()
        done = subprocess.run(
            ["mount", "-t", "tmpfs", "-o", f"size={size},mode=755", "tmpfs", str(path)],
            capture_output=True,
            text=True,
        )
        if done.returncode:
            pytest.skip(f"cannot mount a tmpfs: {done.stderr.strip()}")
        mounted.append(str(path))
        return str(path)

    yield mount
    for path in mounted:
        subprocess.run(["umount", path], check=True)


@pytest.fixture
def shmmap(tmp_path: Path) -> Verbs:
    """The command line without a daemon, with a home of its own."""
    return Verbs(tmp_path)


@pytest.fixture
def short_path() -> Iterator[Path]:
    """Make a directory for sockets: ``tmp_path`` may be too long for them, by a user's name or a worker's."""
    with tempfile.TemporaryDirectory(prefix="shmmap-test-") as path:
        yield Path(path)


@pytest.fixture
def daemon(private_tmpfs: Callable[[str], str], layer_kernels: None) -> Iterator[DaemonFactory]:
    """Start daemons, ``daemon(map_path, *flags, environment=..., shm_dir=..., start=True)``.

    What they may leave behind: `shmmap.testing.daemon_process.isolated_daemons`.
    """
    yield from judged_daemons(DaemonProcess)


@pytest.fixture(scope="module")
def standing_map(tmp_path_factory: pytest.TempPathFactory) -> DividedMap:
    """The same map as `divided_map`, for tests of one module that do not change it."""
    return make_map(tmp_path_factory.mktemp("standing") / "map")


@pytest.fixture(scope="module")
def standing(standing_map: DividedMap, layer_kernels: None) -> Iterator[DaemonProcess]:
    """One daemon of that map for the tests of a module that only read; judged at the module's end."""
    with contextmanager(judged_daemons)(DaemonProcess) as make:
        yield make(standing_map.root)


@pytest.fixture
def reading(standing: DaemonProcess, tmp_path: Path) -> Shmmap:
    """The command line of that daemon."""
    return Shmmap(standing, tmp_path)


@pytest.fixture
def connect(daemon: DaemonFactory) -> Iterator[Callable[..., RawClient]]:
    """Open raw sessions, ``connect(daemon, timeout=..., name=...)``; closed at the end of the test."""
    opened: list[RawClient] = []

    def factory(to: DaemonProcess, **options: Any) -> RawClient:
        client = RawClient(to.endpoint, **options)
        opened.append(client)
        return client

    yield factory
    for client in opened:
        client.close()


@pytest.fixture
def divided_map(tmp_path: Path) -> DividedMap:
    """Return a map of 6 x 6 cells of 20 m, 500 points each, about the origin."""
    return make_map(tmp_path / "map")


@pytest.fixture
def live_daemon(daemon: DaemonFactory, tmp_path: Path) -> LiveDaemon:
    """Start a daemon that keeps the live map ``lidar`` alone."""

    def make(
        *flags: str, resolution: float = RESOLUTION, checkpoint: float = 0.2, start: bool = True
    ) -> DaemonProcess:
        file = tmp_path / "shmmap.toml"
        file.write_text(
            LIVE_TOML.format(resolution=resolution, checkpoint=checkpoint, path=tmp_path / "lidar")
        )
        one: DaemonProcess = daemon("", "--config", str(file), "--live-budget", "16M", *flags, start=start)
        return one

    return make


@pytest.fixture
def dds() -> Iterator[int]:
    """Have a DDS domain that no other test is in; the test is skipped where there is no DDS."""
    pytest.importorskip(
        "cyclonedds", reason="needs the package cyclonedds, which has no wheel for this machine"
    )
    from tests.support.bridge_process import dds_domain

    with dds_domain() as number:
        yield number


@pytest.fixture
def domain(daemon: DaemonFactory, tmp_path: Path) -> Iterator[RosDomain]:
    """A domain of ROS 2 of its own; it ends before the daemons are judged."""
    from tests.support.ros.environment import ros_python
    from tests.support.ros.processes import ros_domain

    python = ros_python()
    if python is None:
        pytest.skip("there is no ROS 2: python -m tests.support.ros makes it, or says why not (280 MB)")
    with ros_domain(python, tmp_path) as one:
        yield one


@pytest.fixture
def served(daemon: DaemonFactory, divided_map: DividedMap) -> DaemonProcess:
    """A daemon that serves the divided map."""
    one: DaemonProcess = daemon(divided_map.root)
    return one


@pytest.fixture
def client(served: DaemonProcess, connect: Callable[..., RawClient]) -> RawClient:
    """A raw session of that daemon."""
    return connect(served)


@pytest.fixture
def bridge(served: DaemonProcess, dds: int) -> Iterator[BridgeProcess]:
    """A bridge of that daemon, in the test's domain."""
    from tests.support.bridge_process import BridgeProcess

    with BridgeProcess(served, dds) as one:
        yield one


@pytest.fixture
def peer(dds: int, monkeypatch: pytest.MonkeyPatch) -> Iterator[RosPeer]:
    """A participant of that domain, to make clients with."""
    from tests.support.ros_peer import ros_peer

    monkeypatch.delenv("CYCLONEDDS_URI", raising=False)
    with ros_peer(dds) as one:
        yield one


# --- requests that are under way together -------------------------------------------------------------

COLD: Final = (50.0, 50.0, 5.0)
"""Where nothing is loaded before the loaders of `one` stand still."""


@pytest.fixture
def one(daemon: DaemonFactory, divided_map: DividedMap) -> DaemonProcess:
    """Return a daemon with one loader, and the cells about the origin in memory."""
    one = daemon(divided_map.root, "--workers", "1")
    with RawClient(one.endpoint) as client:
        client.area(["circle", 0.0, 0.0, 20.0])
    return one
