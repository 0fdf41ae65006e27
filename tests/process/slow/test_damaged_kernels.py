# SPDX-License-Identifier: Apache-2.0
"""Compiled kernels: missing ones are made before a client asks; whatever is wrong with some, all runs."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import shmmap
from shmmap import kernel_cache
from shmmap.chunks import applying_kernels, marking_kernels
from shmmap.layers.build import compile_kernels
from tests.process.conftest import DaemonFactory
from tests.support.command_line import Shmmap
from tests.support.daemon_process import DaemonProcess, until
from tests.support.divided_map import DividedMap


def empty(path: Path) -> None:
    path.write_bytes(b"")


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 4
    path.write_bytes(data)


def a_directory(path: Path) -> None:
    path.unlink()
    path.mkdir()


@pytest.fixture
def kernels(tmp_path: Path) -> Path:
    """Return a copy of the kernels that all tests use."""
    # they are compiled when one of them is looked for
    assert all((applying_kernels.touched_bricks, marking_kernels.mark_ends))
    compile_kernels()
    used = kernel_cache.kernel_directory()
    assert used is not None
    copy = tmp_path / "kernels"
    shutil.copytree(used, copy)
    copy.chmod(0o700)
    return copy


def one_of(kernels: Path, name: str) -> Path:
    found = list(kernels.glob(f"{name}-*.kernel"))
    assert found
    return max(found, key=lambda path: path.stat().st_mtime)


def serve(daemon: DaemonFactory, divided_map: DividedMap, tmp_path: Path, kernels: Path) -> DaemonProcess:
    file = tmp_path / "shmmap.toml"
    file.write_text(f'[live.lidar]\nresolution = 0.2\npath = "{tmp_path}/lidar"\n')
    environment = {"NUMBA_CACHE_DIR": str(kernels)}
    return daemon(divided_map.root, "--config", str(file), "--live-budget", "8MiB", environment=environment)


@pytest.mark.parametrize("damage", [empty, flip, a_directory])
def test_points_and_live_maps_are_served(
    daemon: DaemonFactory, divided_map: DividedMap, tmp_path: Path, kernels: Path,
    damage: Callable[[Path], None],
) -> None:  # fmt: skip
    harmed = one_of(kernels, "applying_kernels.end_writing")
    damage(harmed)
    one = serve(daemon, divided_map, tmp_path, kernels)
    with shmmap.connect(one.endpoint) as client:
        assert client.around(0, 0, 30).cells
        with client.live("lidar").mapper("front") as mapper:
            mapper.add(np.arange(3.0, 9.0, 0.1).reshape(20, 3), np.eye(4))
            assert mapper.wait_applied() == 1
    assert str(harmed) in one.log
    assert harmed.is_file() == (damage is not a_directory)
    if damage is a_directory:
        harmed.rmdir()
    one.stop()
    before = one.log.count("compiled kernel discarded")
    one.start()  # the cause is gone: it is kept again, as soon as the worker of live maps has compiled it
    until(harmed.is_file, lambda: one.log)
    assert one.log.count("compiled kernel discarded") == before


def test_a_program_that_finds_nothing_but_damage(kernels: Path) -> None:
    for path in kernels.glob("*.kernel"):
        empty(path)
    program = "from shmmap.chunks import applying_kernels; print('begun')"
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(kernels)}
    for expected in (1, 0):
        done = subprocess.run(
            [sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True
        )
        assert done.stdout == "begun\n"
        assert done.stderr.count("compiled kernel discarded") == expected


# --- where no kernel was compiled yet the daemon compiles those of the layers before a client asks ---


def compiled(folder: Path) -> set[str]:
    """Files of compiled kernels."""
    return {path.name for path in folder.rglob("*.kernel")}


def marks(folder: Path) -> list[Path]:
    return list(folder.glob("layers-*.compiled"))


def test_what_layers_need_is_compiled_once(
    daemon: DaemonFactory, divided_map: DividedMap, tmp_path: Path
) -> None:
    kernels = tmp_path / "kernels"
    one = daemon(divided_map.root, environment={"NUMBA_CACHE_DIR": str(kernels)})
    until(lambda: marks(kernels))
    made = compiled(kernels)
    assert {name.split("-")[0] for name in made if name.startswith("kernels.")}
    with shmmap.connect(one.endpoint) as client:
        found = client.around(0, 0, radius=5.0, layers=("ndt(leaf=2.0)", "elevation(0.5)"), wait=60.0)
        assert found.cells
        assert not found.failed
    assert compiled(kernels) == made, "nothing was left to compile"
    assert one.log.count("compiling kernels, once for this version") == 1
    other = daemon(divided_map.root, environment={"NUMBA_CACHE_DIR": str(kernels)})
    with shmmap.connect(other.endpoint) as client:
        assert client.around(0, 0, radius=5.0, wait=60.0).cells
    assert compiled(kernels) == made


def test_who_waits_for_a_layer_learns_that_kernels_are_compiled(
    daemon: DaemonFactory, divided_map: DividedMap, tmp_path: Path
) -> None:
    kernels = tmp_path / "kernels"
    kernels.mkdir(mode=0o700)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("NUMBA_CACHE_DIR", str(kernels))
        mark = kernel_cache.compiled_mark()
    assert mark is not None
    mark.touch()  # the daemon does not compile before it has to
    one = daemon(divided_map.root, environment={"NUMBA_CACHE_DIR": str(kernels)})
    query = partial(Shmmap(one, tmp_path).run, "query", "--circle", "0,0,5", "--layer", "ndt(leaf=2.0)")
    line = "shmmap: the daemon compiles kernels for this layer, once for this version\n"
    # how far the daemon is stands beside it; on a busy machine a load may have come to its deadline
    assert query("--wait", "300").stderr.count(line) == 1
    until(lambda: not query("--wait", "300").returncode, lambda: one.log)
    assert query("--wait", "300").stderr == ""


def test_a_daemon_that_ends_meanwhile_leaves_nothing(
    daemon: DaemonFactory, divided_map: DividedMap, tmp_path: Path
) -> None:
    """The test's end looks for processes that are left."""
    kernels = tmp_path / "kernels"
    one = daemon(divided_map.root, environment={"NUMBA_CACHE_DIR": str(kernels)})
    until(lambda: list(kernels.glob("layers-*.lock")))
    one.stop()
    assert not marks(kernels)
