# SPDX-License-Identifier: Apache-2.0
"""Where no kernel was compiled yet the daemon compiles those of the layers before a client asks."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import shmmap
from tests.support.daemon_process import DaemonProcess
from tests.support.divided_map import DividedMap
from tests.support.patience import Patience

DaemonFactory = Callable[..., DaemonProcess]


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
    waiting = Patience()
    while waiting(not marks(kernels)):
        pass
    made = compiled(kernels)
    assert {name.split("-")[0] for name in made if name.startswith("kernels.")}
    with shmmap.connect(one.endpoint) as client:
        found = client.around(0, 0, radius=5.0, layers=("ndt(leaf=2.0)", "elevation(0.5)"), wait=60.0)
        assert found.cells
        assert not found.failed
    assert compiled(kernels) == made, "nothing was left to compile"
    other = daemon(divided_map.root, environment={"NUMBA_CACHE_DIR": str(kernels)})
    with shmmap.connect(other.endpoint) as client:
        assert client.around(0, 0, radius=5.0, wait=60.0).cells
    assert compiled(kernels) == made


def test_a_daemon_that_ends_meanwhile_leaves_nothing(
    daemon: DaemonFactory, divided_map: DividedMap, tmp_path: Path
) -> None:
    """The test's end looks for processes that are left."""
    kernels = tmp_path / "kernels"
    one = daemon(divided_map.root, environment={"NUMBA_CACHE_DIR": str(kernels)})
    waiting = Patience()
    while waiting(not list(kernels.glob("layers-*.lock"))):
        pass
    one.stop()
    assert not marks(kernels)
