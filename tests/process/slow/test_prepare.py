# SPDX-License-Identifier: Apache-2.0
"""Preparing a map: whole, resumable, robust against bad cells; a daemon then computes nothing."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from shmmap.layers.build import build_layer
from tests.process.conftest import DaemonFactory
from tests.support.daemon_process import ROOT, wait_ended
from tests.support.divided_map import DividedMap, make_map
from tests.support.forked_programs import run_verb
from tests.support.layer_oracles import install
from tests.support.raw_client import RawClient, circle
from tests.support.segment_reader import read_segment

pytestmark = pytest.mark.usefixtures("layer_kernels")

Connect = Callable[..., RawClient]
NDT = "ndt(leaf=2.0,min_points=3)"


@pytest.fixture
def small_map(tmp_path: Path) -> DividedMap:
    return make_map(tmp_path / "map", columns=3, rows=3, points=400)


def command(made: DividedMap, cache: Path, *layers: str) -> list[str]:
    return [
        sys.executable, "-m", "shmmap.cli", "prepare", str(made.root), "--cache-dir", str(cache), "--json",
        "--layer", *layers,
    ]  # fmt: skip


def prepare(made: DividedMap, cache: Path, *layers: str, code: int = 0, **environment: str) -> dict[str, Any]:
    done = run_verb(command(made, cache, *layers)[3:], {**os.environ, **environment})
    assert done.returncode == code, done.stderr + done.stdout
    answer = json.loads(done.stdout)
    assert isinstance(answer, dict)
    return answer


def counters(client: RawClient) -> dict[str, int]:
    found = client.ask("stats")[4]
    assert isinstance(found, dict)
    return found


def test_serve_after_prepare_computes_nothing(
    daemon: DaemonFactory, connect: Connect, small_map: DividedMap, tmp_path: Path
) -> None:
    cache = tmp_path / "cache"
    first = prepare(small_map, cache, "points", NDT)
    assert (first["cells"], first["built"], first["kept"], first["failed"]) == (9, 18, 0, [])
    again = prepare(small_map, cache, NDT, "points")
    assert (again["built"], again["kept"], again["bytes"]) == (0, 18, first["bytes"])
    client = connect(daemon(small_map.root, "--cache-dir", str(cache)))
    reply = client.cells_reply(client.ask("area", circle(0.0, 0.0, 100.0), ["points", NDT], 60.0, None))
    assert len(reply.cells) == 18
    found = counters(client)
    assert (found["layers_computed"], found["loads_from_cache"]) == (0, 18)
    for handle in reply.cells:
        source = small_map.points(handle.id.rsplit("/", 1)[1])
        xyz = np.column_stack([source["x"], source["y"], source["z"]])
        table = build_layer(handle.layer, {"xyz": xyz, "intensity": source["intensity"]})
        segment = read_segment(client.path(handle))
        assert segment.fields["cell_id"] == handle.id
        for name, column in table.columns.items():
            assert segment.columns[name].tobytes() == column.tobytes()


def test_what_a_daemon_computed_the_next_one_finds(
    daemon: DaemonFactory, connect: Connect, small_map: DividedMap, tmp_path: Path
) -> None:
    cache = str(tmp_path / "cache")
    for computed in (9, 0):
        one = daemon(small_map.root, "--cache-dir", cache)
        client = connect(one)
        reply = client.cells_reply(client.ask("area", circle(0.0, 0.0, 100.0), [NDT], 60.0, None))
        assert len(reply.cells) == 9
        assert counters(client)["layers_computed"] == computed
        client.close()
        one.stop()


def test_a_copied_map_is_not_computed_again(small_map: DividedMap, tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    prepare(small_map, cache, NDT)
    copied = DividedMap(tmp_path / "copy", small_map.size, small_map.corners)
    shutil.copytree(small_map.root, copied.root)
    done = prepare(copied, cache, NDT, "voxel(leaf=1.0)")
    by_how = (done["kept"], done["built"], done["recognised"])
    assert by_how == (0, 9, 9)
    again = prepare(copied, cache, NDT)
    assert again["kept"] == 9


def test_a_bad_cell_costs_itself(small_map: DividedMap, tmp_path: Path) -> None:
    (small_map.pcd_dir / "0_0.pcd").write_bytes(b"VERSION 0.7\nnonsense\n")
    path = install(tmp_path / "offered")
    done = prepare(
        small_map, tmp_path / "cache", NDT, "broken", "around(2)", code=1, PYTHONPATH=f"{ROOT}:{path}"
    )
    failed = {(Path(one["id"]).name, one["layer"]) for one in done["failed"]}
    names = set(small_map.corners)
    assert failed == {("0_0.pcd", NDT), ("0_0.pcd", "around(radius=2.0)")} | {(n, "broken") for n in names}
    assert done["built"] == 16


def test_a_cell_that_kills_its_worker_costs_itself(small_map: DividedMap, tmp_path: Path) -> None:
    path = install(tmp_path / "offered")
    done = prepare(small_map, tmp_path / "cache", "broken(how=1)", code=1, PYTHONPATH=f"{ROOT}:{path}")
    assert len(done["failed"]) == 9
    assert all("SIGABRT" in one["message"] for one in done["failed"])


def test_a_killed_run_leaves_no_worker_and_goes_on_where_it_was(tmp_path: Path) -> None:
    made = make_map(tmp_path / "map", columns=8, rows=8, points=300)
    cache = tmp_path / "cache"
    run = subprocess.Popen(
        command(made, cache, NDT), env={**os.environ, "PYTHONPATH": str(ROOT)}, stdout=subprocess.DEVNULL
    )
    try:
        entries = cache / "layers" / "version"
        while run.poll() is None and not list(entries.rglob("*.layer")):
            pass
        workers = [int(pid) for pid in Path(f"/proc/{run.pid}/task/{run.pid}/children").read_text().split()]
    finally:
        run.send_signal(signal.SIGKILL)
        run.wait()
    for pid in workers:
        assert wait_ended(pid)
    done = prepare(made, cache, NDT)
    assert done["kept"] >= 1
    assert done["kept"] + done["recognised"] + done["built"] == 64


def test_a_cache_that_cannot_be_written_is_said_at_once(small_map: DividedMap, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    done = run_verb(command(small_map, tmp_path / "file", NDT)[3:])
    assert done.returncode == 73
    assert f"{tmp_path}/file/layers: Not a directory" in done.stderr


def test_usage(small_map: DividedMap, tmp_path: Path) -> None:
    for words, message in (
        ([], "leaf"),
        (["--layer", "nonsense"], "leaf"),
        (["--layer", "ndt"], "leaf"),
        (["--layer", "points", "--cache-size", "much"], "no size"),
    ):
        environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path)}
        done = run_verb(["prepare", str(small_map.root), *words], environment)
        assert done.returncode == 2, done.stderr
        assert message in done.stderr
