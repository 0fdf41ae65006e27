# SPDX-License-Identifier: Apache-2.0
"""shmmap is replaced under a daemon, then a process of it ends: it says so once, and closes as a whole."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import shmmap
from shmmap.errors import Replaced
from shmmap.installed import RESTART
from tests.process.conftest import DaemonFactory
from tests.support.daemon_process import DaemonProcess, counters, until, wait_ended
from tests.support.divided_map import DividedMap
from tests.support.live_reference import LIVE_TOML, worker_of


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A copy of the package, which a test may replace."""
    copy = tmp_path / "site" / "shmmap"
    shutil.copytree(Path(shmmap.__file__).parent, copy)
    return copy


@pytest.fixture
def served(
    daemon: DaemonFactory, divided_map: DividedMap, tmp_path: Path, package: Path
) -> Callable[..., DaemonProcess]:
    """Start a daemon of that copy with cells and a live map, and wait for both."""

    def make(**environment: str) -> DaemonProcess:
        settings = tmp_path / "shmmap.toml"
        settings.write_text(LIVE_TOML.format(resolution=0.5, checkpoint=0.2, path=tmp_path / "lidar"))
        words = (divided_map.root, "--config", str(settings), "--live-budget", "16M", "--workers", "1")
        copied = {"PYTHONPATH": str(package.parent), "NUMBA_DISABLE_JIT": "1", "INVOCATION_ID": ""}
        one: DaemonProcess = daemon(*words, environment={**copied, **environment})
        until_live(one)
        return one

    return make


def another_version(package: Path) -> None:
    """Put another version in its place, whose live worker would say what this daemon cannot read."""
    removed(package)
    shutil.copytree(package.with_name("old"), package)
    for name, before, after in (
        ("version.py", f'"{shmmap.__version__}"', '"99.0.0"'),
        ("live_messages.py", 'tag="begun"', 'tag="begun of another version"'),
    ):
        file = package / name
        text = file.read_text()
        assert before in text
        file.write_text(text.replace(before, after))


def removed(package: Path) -> None:
    """Nothing is left."""
    package.rename(package.with_name("old"))


def put_back(package: Path) -> None:
    """Install the old version again."""
    if package.exists():
        shutil.rmtree(package)
    package.with_name("old").rename(package)


def until_live(one: DaemonProcess, times: int = 1) -> None:
    """Wait until a daemon has its live map for the n-th time."""
    until(lambda: one.log.count("live maps ready") == times, lambda: one.log)


def kill(pid: int) -> None:
    os.kill(pid, signal.SIGKILL)
    assert wait_ended(pid)


def verb(one: DaemonProcess, *words: str) -> subprocess.CompletedProcess[str]:
    """Run the command line of this tree."""
    environment = {**os.environ, "SHMMAP_ENDPOINT": one.endpoint, "SHMMAP_SHM_DIR": one.shm_dir}
    command = [sys.executable, "-m", "shmmap.cli", *words]
    return subprocess.run(command, capture_output=True, text=True, env=environment, check=False)


@pytest.mark.parametrize("happens", [another_version, removed])
@pytest.mark.parametrize("ends", ["live worker", "loaders' parent"])
def test_a_process_of_a_replaced_daemon_ends(
    served: Callable[..., DaemonProcess],
    divided_map: DividedMap,
    package: Path,
    happens: Callable[[Path], None],
    ends: str,
) -> None:
    """It is said once, by its name; the daemon serves what it has; its end leaves nothing."""
    one = served()
    client = shmmap.connect(one.endpoint, shm_dir=one.shm_dir)
    held = client.around(0, 0, 5)
    happens(package)
    (parent,) = set(one.children()) - set(one.loaders()) - {worker_of(one)}
    kill(worker_of(one) if ends == "live worker" else parent)
    if ends != "live worker":
        assert RESTART in str(client.around(0, 40, 5, strict=None).failed[0])
    until(lambda: counters(one)["package_replaced"] == 1, lambda: one.log)
    strict = verb(one, "health", "--strict")
    assert strict.returncode == 1
    assert strict.stdout.count(f"\n  {RESTART} (") == 1
    assert one.log.count(f"ERROR   {RESTART}\n") == 1
    if ends == "live worker":
        (row,) = client.live_maps()
        assert row.problem == RESTART
        with pytest.raises(shmmap.ShmmapError, match=RESTART):
            client.live("lidar")
    assert [cell.segment for cell in client.around(0, 0, 5)] == [cell.segment for cell in held]
    client.close()
    assert one.stop() == 0, one.log
    assert "Traceback" not in one.log
    assert one.segments() == []
    if ends == "live worker":  # its chunks wait in memory for the next start
        put_back(package)
        one.start()
        until_live(one, 2)
        assert one.stop() == 0, one.log


def test_a_service_ends_and_leaves_its_memory_to_the_new_version(
    served: Callable[..., DaemonProcess], package: Path
) -> None:
    """The service manager starts a service that failed again: the new version adopts the cells."""
    one = served(INVOCATION_ID="0" * 32)
    client = shmmap.connect(one.endpoint, shm_dir=one.shm_dir)
    held = client.around(0, 0, 5)
    another_version(package)
    kill(worker_of(one))
    assert one.process is not None
    assert one.process.wait(60) == Replaced.exit_code, one.log
    assert {cell.segment for cell in held} <= {f"/{name}" for name in one.segments()}
    one.killed = True
    for name in ("live_messages.py",):  # what made it another version, but for its number
        shutil.copy(package.with_name("old") / name, package / name)
    one.start()
    until_live(one, 2)
    assert [cell.segment for cell in client.around(0, 0, 5)] == [cell.segment for cell in held]
    assert client.welcome.daemon == "99.0.0"  # a copy in no checkout
    client.close()
