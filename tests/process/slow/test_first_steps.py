# SPDX-License-Identifier: Apache-2.0
"""First steps of a newcomer, by the pages' own text: each in under ten commands.

Where ``SHMMAP_TEST_FROM_NOTHING`` is set, as in ``.ci/run``, they begin with nothing but a clone: on Python
3.13 with the README's line, on 3.10 with the line that leaves Open3D out.  Elsewhere the steps are taken in
the environment that runs the tests, where the commands that install do nothing.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from shmmap_clients.scans.trajectory import read_trajectory

from shmmap.simulation.town import Town
from tests.support.cloud_bytes import write_las
from tests.support.daemon_process import ROOT
from tests.support.pages import Reader, Terminal, read_page, write_program

README = read_page("README.md")
INSTALL = read_page("shmmap/INSTALL.md")
CLONE = README.commands("clone")
(FULL,) = README.commands("demo")
(SLIM,) = INSTALL.commands("slim")
pytestmark = [pytest.mark.minutes, pytest.mark.more_as_root]  # other Pythons may lie in root's home
WITHOUT_OPEN3D, WHOLE = "python3.10", "python3.13"
WHERE = [WITHOUT_OPEN3D, WHOLE] if os.environ.get("SHMMAP_TEST_FROM_NOTHING") else ["installed"]
SLIM_BYTES = 360 << 20


def interpreter(name: str) -> Path | None:
    """Return a Python such as ``python3.10``, from the path or of pyenv; None where there is none."""
    on_path = [Path(one) for one in [shutil.which(name)] if one]
    versions = Path.home() / ".pyenv" / "versions"
    for candidate in [*on_path, *sorted(versions.glob(f"{name.removeprefix('python')}.*/bin/python3"))]:
        asked = subprocess.run(
            [candidate, "-c", "import ensurepip, sys; print(sys.executable)"],
            check=False,
            capture_output=True,
            text=True,
        )
        if asked.returncode == 0:  # pyenv puts programs on the path that start nothing
            return Path(asked.stdout.strip())
    return None


@dataclass
class Newcomer:
    """A reader with the first terminal open, in the clone, and shmmap installed.

    Attributes
    ----------
    typed
        Commands that led here.
    printed
        What the last of them printed.
    service
        What stands for ``/opt/shmmap``.
    """

    reader: Reader
    terminal: Terminal
    service: Path
    typed: list[str] = field(default_factory=list)
    printed: str = ""

    @property
    def clone(self) -> Path:
        """Where the first terminal is after the clone."""
        return self.reader.home / "shmmap"

    def another_terminal(self) -> Terminal:
        """Open a terminal in the clone and activate the environment there, as the pages say."""
        terminal = self.reader.terminal(self.clone)
        if (self.clone / ".venv").exists():
            terminal.run(". .venv/bin/activate")
        return terminal


@pytest.fixture(scope="module")
def published(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a repository with one commit: the tree as it stands on disk."""
    if not (ROOT / ".git").exists():
        pytest.skip("this tree is no checkout: nothing to clone")
    repository = tmp_path_factory.mktemp("published") / "shmmap.git"
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT,
        check=True,
        capture_output=True,
        text=True,
    ).stdout
    for name in filter(None, listed.split("\0")):
        if (ROOT / name).is_file():
            (repository / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, repository / name)
    identity = ["-c", "user.name=test", "-c", "user.email=test@localhost"]
    for words in (["init", "-q"], ["add", "-A"], [*identity, "commit", "-q", "-m", "all"]):
        subprocess.run(["git", *words], cwd=repository, check=True, capture_output=True)
    return repository


@pytest.fixture(scope="module", params=WHERE)
def newcomer(
    request: pytest.FixtureRequest, published: Path, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Newcomer]:
    """Clone and install, once for all walks."""
    home = tmp_path_factory.mktemp("newcomer")
    programs = home / "bin"
    programs.mkdir()
    write_program(programs / "sudo", 'exec "$@"')
    if request.param == "installed":
        reader = Reader(home, [programs], {"PYTHONPATH": f"{ROOT}:{ROOT / 'clients'}"})
        _pretend_installed(home, programs)
        service, install = home / "opt", []
    else:
        python = interpreter(request.param)
        if python is None and request.param == WHOLE:  # the README's line is tried on any Python
            python = Path(sys.base_prefix) / "bin" / "python3"
        if python is None:
            pytest.skip(f"no {request.param} on PATH or in ~/.pyenv")
        write_program(programs / "python3", f'exec "{python}" "$@"')
        pip = {"PIP_CACHE_DIR": str(Path.home() / ".cache" / "pip"), "PIP_DISABLE_PIP_VERSION_CHECK": "1"}
        kernels = {"NUMBA_CACHE_DIR": str(home / ".cache" / "kernels")}
        reader = Reader(home, [programs], pip | kernels)
        service, install = home / "shmmap" / ".venv", [SLIM if request.param == WITHOUT_OPEN3D else FULL]
    terminal = reader.terminal()
    one = Newcomer(reader, terminal, service)
    try:
        for command in [*CLONE, *install]:
            one.printed = terminal.run(command.replace(" URL ", f" '{published}' "))
            one.typed.append(command)
        yield one
    finally:
        reader.leave()
        shutil.rmtree(home)


def _pretend_installed(home: Path, programs: Path) -> None:
    """Let the programs be those of the environment that runs the tests; installing does nothing."""
    modules = {
        "shmmap": "shmmap.cli",
        "shmmap-ndt": "shmmap_clients.ndt_scan_matcher",
        "shmmap-pose-init": "shmmap_clients.pose_initializer",
    }
    for name, module in modules.items():
        write_program(programs / name, f'exec "{sys.executable}" -m {module} "$@"')
    write_program(programs / "python", f'exec "{sys.executable}" "$@"')
    write_program(programs / "python3", '[ "$1 $2" = "-m venv" ]')
    write_program(programs / "pip", '[ "$1" = install ]')
    (home / "opt").mkdir()
    (home / "opt" / "bin").symlink_to(programs)


def under_ten(newcomer: Newcomer, *blocks: list[str]) -> None:
    """A walk is short."""
    assert len(newcomer.typed) + sum(map(len, blocks)) < 10


@pytest.mark.parametrize("newcomer", [one for one in WHERE if one != "installed"], indirect=True)
def test_from_the_clone_to_the_demonstration(newcomer: Newcomer) -> None:
    under_ten(newcomer, ["shmmap demo"])
    printed = newcomer.printed if newcomer.typed[-1] == FULL else newcomer.terminal.run("shmmap demo")
    assert re.search(r"^8 with shmmap  ", printed, re.MULTILINE)
    assert (newcomer.clone / "shmmap-demo.svg").is_file()


@pytest.mark.parametrize("newcomer", [one for one in WHERE if one == WITHOUT_OPEN3D], indirect=True)
def test_the_install_without_open3d_is_small_and_reads_other_clouds(newcomer: Newcomer) -> None:
    files = [path for path in newcomer.service.rglob("*") if path.is_file() and not path.is_symlink()]
    assert sum(path.stat().st_blocks * 512 for path in files) < SLIM_BYTES
    another = newcomer.another_terminal()
    printed = another.run("printf '0 0 0\\n' >one.xyz; shmmap inspect one.xyz 2>&1 || echo exit $?")
    assert "points  1\n" in printed
    assert "exit " not in printed


def test_from_a_las_file_to_a_served_map(newcomer: Newcomer) -> None:
    page = read_page("shmmap/dividing/OWN_CLOUD.md")
    install, (inspect, divide, serve), look = (page.commands(name) for name in ("install", "serve", "query"))
    under_ten(newcomer, install, [inspect, divide, serve], look)
    rng = np.random.default_rng(0)
    points = 60_000
    columns = {
        "x": rng.uniform(0.0, 400.0, points) + 691_000.0,
        "y": rng.uniform(0.0, 300.0, points) + 5_334_000.0,
        "z": rng.uniform(510.0, 520.0, points),
        "intensity": rng.integers(0, 65_536, points),
    }
    write_las(newcomer.reader.home / "city.las", columns, offset=(691_000.0, 5_334_000.0, 500.0))
    first = newcomer.terminal
    for command in install:
        first.run(command)
    assert "points  60,000" in first.run(inspect)
    assert "60,000 of 60,000" in first.run(divide)
    with first.serving(serve):
        another = newcomer.another_terminal()
        query, export = (another.run(command) for command in look)
        counted = re.search(r"cells, ([\d,]+) points", query)
        assert counted is not None
        assert int(counted[1].replace(",", "")) > 1000
        assert "around.pcd" in export
        of_file, of_daemon = (another.run(command) for command in page.commands("view"))
        assert "wrote city.png: 60,000 points of 1 file" in of_file
        assert "wrote place.png: " in of_daemon
    assert (newcomer.clone / "around.pcd").stat().st_size > 10_000


def test_from_an_autoware_map_to_the_first_query(newcomer: Newcomer) -> None:
    page = read_page("shmmap/origin/AUTOWARE_MAP.md")
    (serve,), look = page.commands("serve"), page.commands("query")
    under_ten(newcomer, [serve], look, ["python"])
    map_dir = newcomer.reader.home / "autoware_map"
    Town(seed=1, blocks=(2, 2), origin=(89_560.0, 42_200.0), density=4.0).write(map_dir)
    with newcomer.terminal.serving(serve):
        another = newcomer.another_terminal()
        status, query, ls, _ = (another.run(command) for command in look)
        assert "healthy" in status
        assert str(map_dir) in status
        assert "town_89600_42240.pcd" in query
        assert "town_89600_42240.pcd" in ls
        assert "town_89600_42240.pcd" in (newcomer.clone / "map.html").read_text()
        printed = another.python(page.blocks["python"]).splitlines()
    assert len(printed) > 5
    assert all(re.search(r"pcd \(\d+, 3\) float32 \('xyz', 'intensity'\)$", line) for line in printed)


def test_from_nothing_to_the_first_localized_scan(newcomer: Newcomer) -> None:
    page = read_page("clients/README.md")
    (make, divide, serve), (initialize, follow) = page.commands("first-scan-map"), page.commands("first-scan")
    under_ten(newcomer, [make, divide, serve], [initialize, follow])
    newcomer.terminal.run(make)
    newcomer.terminal.run(divide)
    with newcomer.terminal.serving(serve):
        another = newcomer.another_terminal()
        found = another.run(initialize)
        followed = another.run(follow)
    assert ": reliable" in found
    poses = read_trajectory(newcomer.clone / "poses.txt").T_map_sensor
    truth = read_trajectory(newcomer.clone / "data/street/scan_poses.txt").T_map_sensor
    assert np.linalg.norm(poses[:, :3, 3] - truth[:, :3, 3], axis=1).max() < 0.1, followed


def test_the_service_is_installed_below_a_root_directory(newcomer: Newcomer) -> None:
    """The program is in the image already; `tests/unit/service` has what else may be there."""
    page = read_page("systemd/README.md")
    commands = page.commands("environment") + page.commands("image")
    assert len(CLONE) + len(commands) < 10
    image = newcomer.clone / "image"
    for name in ("usr/bin/python3", "opt/shmmap/bin/shmmapd", "opt/shmmap/bin/shmmap-ros-bridge"):
        (image / name).parent.mkdir(parents=True, exist_ok=True)
        (image / name).write_text("#!/usr/bin/python3\n")
        (image / name).chmod(0o755)
    (image / "srv/map").mkdir(parents=True)
    for command in commands:
        newcomer.terminal.run(command.replace("/opt/shmmap", str(newcomer.service)))
    unit = (image / "etc/systemd/system/shmmapd.service").read_text()
    assert "\nExecStart=/opt/shmmap/bin/shmmapd --config %E/shmmap/shmmap.toml\n" in unit
    assert '\nmap_path = "/srv/map"\n' in (image / "etc/shmmap/shmmap.toml").read_text()
