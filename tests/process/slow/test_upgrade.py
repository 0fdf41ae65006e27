# SPDX-License-Identifier: Apache-2.0
"""shmmap is upgraded or removed while a daemon runs: what needs a new loader says "restart the daemon"."""

from __future__ import annotations

import os
import shutil
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

import shmmap
from tests.process.conftest import DaemonFactory
from tests.support.daemon_process import wait_ended
from tests.support.divided_map import DividedMap
from tests.support.raw_client import RawClient, circle

Connect = Callable[..., RawClient]
LOADER = "daemon/loading/worker_main.py"


def upgraded(package: Path) -> None:
    """Another version, whose loaders start and speak as ours do."""
    path = package / "version.py"
    text = path.read_text(encoding="utf-8")
    changed = text.replace(f'"{shmmap.__version__}"', '"99.0.0"')
    assert changed != text
    path.write_text(changed, encoding="utf-8")


def renamed(package: Path) -> None:
    """Another version, in which the loader has another name."""
    (package / LOADER).rename(package / "daemon/loading/loader.py")


def half_installed(package: Path) -> None:
    """An unfinished upgrade: the loader program is there, and needs what is not."""
    (package / LOADER).write_text("from shmmap.daemon import not_there_yet\n")


def removed(package: Path) -> None:
    """Nothing is left of it (and the copy that the tests run from is not found either)."""
    shutil.rmtree(package)
    package.with_suffix(".py").touch()


@pytest.mark.parametrize("happens", [upgraded, renamed, half_installed, removed])
def test_a_loader_that_cannot_start_after_an_upgrade(
    daemon: DaemonFactory,
    connect: Connect,
    divided_map: DividedMap,
    tmp_path: Path,
    happens: Callable[[Path], None],
) -> None:
    package = tmp_path / "site" / "shmmap"
    shutil.copytree(Path(shmmap.__file__).parent, package, ignore=shutil.ignore_patterns("__pycache__"))
    one = daemon(divided_map.root, "--workers", "1", environment={"PYTHONPATH": str(package.parent)})
    client = connect(one)
    warm = client.area(circle(0, 0, 5))
    assert len(warm.cells) == 4
    happens(package)
    assert len(client.area(circle(30, 0, 5)).cells) == 2, "the loader that runs goes on"
    for pid in one.loaders():
        os.kill(pid, signal.SIGKILL)
        assert wait_ended(pid)
    assert len(client.area(circle(-30, 0, 5)).cells) == 2, "another one has the code that its parent had"
    parent = one.loaders_parent()
    os.kill(parent, signal.SIGKILL)
    assert wait_ended(parent)
    reply = client.area(circle(0, 40, 5))
    assert not reply.cells
    assert len(reply.failed) == len(divided_map.in_circle(0, 40, 5))
    for failure in reply.failed:
        assert failure.code == "load_failed"
        assert "restart the daemon" in failure.message
    assert "restart the daemon" in one.log
    assert [handle.segment for handle in client.area(circle(0, 0, 5)).cells] == [
        handle.segment for handle in warm.cells
    ]
