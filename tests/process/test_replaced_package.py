# SPDX-License-Identifier: Apache-2.0
"""The package is removed or replaced under programs that run: all they have goes on, the rest is refused."""

from __future__ import annotations

import json
import os
import re
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import shmmap
from tests.process.conftest import DaemonFactory
from tests.support.daemon_process import DaemonProcess, LineProcess, until
from tests.support.divided_map import DividedMap
from tests.support.live_reference import LIVE_TOML

PROGRAM = Path(__file__).parents[1] / "support" / "upgraded_program.py"
REPLACED = "shmmap.errors.Replaced shmmap was replaced while this program runs: start it again"
BROKEN, GOOD = "-60_-60.pcd", "0_0.pcd"

HURRIED = ("client.around#1", "client.around#2", "stream.next#0", "window.error")
"""Uses without a wait: what they return depends on how far the daemon is, or what the window has noticed."""

_FILES = {"shmmap.read_cloud", "shmmap.read_cloud#0", "shmmap.write_pcd", "shmmap.write_pcd#0"}
_LAYERS = {"layers", "shmmap.layers"}
_WINDOWS = {"MapWindow", "Retention", "RetentionCandidate", "RetentionPolicy", "WindowUpdate"}
MAY_BE_REFUSED = {
    "client": {
        *(_FILES | _LAYERS),
        *(f"shmmap.{name}" for name in _WINDOWS),
        *("client.futures", "client.live#0", "client.live#1"),
        *("events", "live", "shmmap.events", "shmmap.live"),
    },
    "all": {*(_FILES | _LAYERS), "client.futures", "live", "shmmap.live"},
}
"""Uses of what a program had not loaded before."""

SILENT = [kind.__name__ for kind in shmmap.errors.DaemonUnreachable.__subclasses__()]
Outcomes = list[dict[str, str]]


def removed(package: Path) -> None:
    """Nothing is left."""
    package.rename(package.with_name("gone"))


def replaced(package: Path) -> None:
    """Another version is there, whose modules would all load."""
    old = package.with_name("old")
    package.rename(old)
    shutil.copytree(old, package)
    version = package / "version.py"
    version.write_text(version.read_text().replace(f'"{shmmap.__version__}"', '"99.0.0"'))


def nothing(package: Path) -> None:
    """Leave it as it is."""


@pytest.fixture
def served(daemon: DaemonFactory, divided_map: DividedMap, tmp_path: Path) -> DaemonProcess:
    """A daemon with a cell that cannot be read, and a live map."""
    (divided_map.pcd_dir / f"{BROKEN}").write_bytes(b"no cloud")
    settings = tmp_path / "shmmap.toml"
    settings.write_text(LIVE_TOML.format(resolution=0.5, checkpoint=0.2, path=tmp_path / "lidar"))
    one: DaemonProcess = daemon(
        divided_map.root, "--config", str(settings), "--live-budget", "16M", start=False
    )
    started(one)
    return one


def started(one: DaemonProcess) -> None:
    """Start a daemon, and wait for its live map."""
    before = one.log.count("live maps ready")
    one.start()
    until(lambda: one.log.count("live maps ready") > before, lambda: one.log)


def copied(site: Path) -> Path:
    """A copy of the package, which a test may replace."""
    package = site / "shmmap"
    shutil.copytree(Path(shmmap.__file__).parent, package)
    return package


def walked(
    served: DaemonProcess, divided_map: DividedMap, tmp_path: Path, has: str, happens: Callable[[Path], None]
) -> tuple[Outcomes, str]:
    """Outcomes of all uses before the daemon's end, after it, and with the next daemon; what was loaded."""
    site = tmp_path / f"{has}-{happens.__name__}"
    package = copied(site)
    environment = {**os.environ, "PYTHONPATH": str(site), "NUMBA_DISABLE_JIT": "1"}
    words: list[str | Path] = [
        sys.executable,
        PROGRAM,
        served.endpoint,
        has,
        divided_map.id(GOOD),
        divided_map.id(BROKEN),
    ]
    with LineProcess(*words, str(site), site.name, env=environment) as program:
        assert program.read() == "ready"
        happens(package)
        found: Outcomes = []
        for state in ("alive", "dead", "back"):
            if state == "dead":
                served.kill()
            elif state == "back":
                started(served)
            program.write(state)
            found.append(json.loads(program.read()))
        program.write("end")
        return [{use: reached(ended) for use, ended in one.items()} for one in found], program.read()


def reached(ended: str) -> str:
    """Return an outcome in which a daemon that just died or came is out of reach, however it was noticed."""
    if ended in SILENT:  # a property's value
        return "DaemonUnreachable"
    return re.sub(rf"shmmap\.errors\.({'|'.join(SILENT)})\b", "shmmap.errors.DaemonUnreachable", ended)


@pytest.mark.parametrize("has", ["client", pytest.param("all", marks=pytest.mark.slow)])
def test_a_program_goes_on(served: DaemonProcess, divided_map: DividedMap, tmp_path: Path, has: str) -> None:
    """Whatever was made before goes on as without an upgrade, and a name not used before says what to do."""
    expected, _ = walked(served, divided_map, tmp_path, has, nothing)
    uncalled = {use for use, ended in expected[0].items() if "missing" in ended}
    assert not uncalled, "the program needs arguments for these"
    for happens in (removed, replaced):
        found, loaded = walked(served, divided_map, tmp_path, has, happens)
        new, version, _ = json.loads(loaded)
        assert (new, version) == ([], shmmap.__version__)
        for stage, outcomes in enumerate(found):
            for use, ended in outcomes.items():
                if ended.startswith("raised "):
                    assert ended == expected[stage].get(use), (stage, use)
                if not ended.startswith(REPLACED) and use not in HURRIED:
                    assert ended == expected[stage].get(use, ended), (happens.__name__, stage, use)
        refused = {use for outcomes in found for use, ended in outcomes.items() if ended.startswith(REPLACED)}
        assert refused <= MAY_BE_REFUSED[has], refused - MAY_BE_REFUSED[has]
