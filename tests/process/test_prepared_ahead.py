# SPDX-License-Identifier: Apache-2.0
"""The setting ``prepare``: what operators see of it, and what a wait for a layer says without it."""

from __future__ import annotations

import os
import signal
from functools import partial
from pathlib import Path

import pytest

from tests.process.conftest import DaemonFactory
from tests.support.command_line import Shmmap
from tests.support.daemon_process import first_answer
from tests.support.divided_map import DividedMap, make_map

LAYER = "crop(z_max=4.0)"


@pytest.fixture
def small_map(tmp_path: Path) -> DividedMap:
    return make_map(tmp_path / "map", columns=3, rows=3, points=60)


def counters(shmmap: Shmmap) -> dict[str, int]:
    found: dict[str, int] = shmmap.json("status")["counters"]
    return found


def test_status_and_metrics_show_how_far_it_is(
    daemon: DaemonFactory, small_map: DividedMap, tmp_path: Path
) -> None:
    (small_map.pcd_dir / "0_0.pcd").write_bytes(b"VERSION 0.7\nnonsense\n")
    for made in (8, 0):  # another run finds what the first one made
        one = daemon(
            small_map.root, "--prepare", "crop(z_max=4)", "--cache-dir", str(tmp_path / "cache"), "--strict"
        )
        shmmap = Shmmap(one, tmp_path)
        found = first_answer(partial(counters, shmmap), lambda now: now["prepare_failed"] == 1)
        found = first_answer(partial(counters, shmmap), lambda now: now["prepare_done"] == 8)
        assert (found["prepare_cells"], found["layers_prepared"]) == (9, made)
        line = f"{LAYER}: 8 of 9 cells, 1 cannot be made: the log names them"
        assert line in " ".join(shmmap("status").split())
        assert 'shmmap_prepare_done{daemon="' in shmmap("metrics")
        assert one.log.count("layer not prepared") == 1
        assert "0_0.pcd" in one.log
        reply = shmmap.json("query", "--id", "20_0.pcd", "--layer", LAYER)
        assert [cell["layer"] for cell in reply["cells"]] == [LAYER]
        assert counters(shmmap)["layers_computed"] == 0
        one.stop()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--prepare", "corp(z_max=4.0)"], "command line: --prepare: unknown layer 'corp'"),
        (["--prepare", LAYER, "--cache-size", "0"], "command line: prepare keeps layers in the disk cache"),
    ],
)
def test_what_cannot_be_prepared_is_refused_at_the_start(
    daemon: DaemonFactory, small_map: DividedMap, options: list[str], said: str
) -> None:
    one = daemon(small_map.root, *options, start=False)
    assert one.run_to_end() == 78
    assert said in one.log


def test_a_published_map_has_its_layers_already(daemon: DaemonFactory, tmp_path: Path) -> None:
    """A directory with a file CURRENT is one; nothing else of it is read."""
    (tmp_path / "published").mkdir()
    (tmp_path / "published" / "CURRENT").write_text("")
    one = daemon(tmp_path / "published", "--prepare", LAYER, start=False)
    assert one.run_to_end() == 78
    assert "--prepare is not for a published map" in one.log
    assert "`shmmap publish URL --join RUN`" in one.log


def test_who_waits_for_a_layer_reads_that_it_can_be_prepared(
    daemon: DaemonFactory, small_map: DividedMap, tmp_path: Path
) -> None:
    one = daemon(small_map.root)
    shmmap = Shmmap(one, tmp_path)
    shmmap("query", "--id", "0_0.pcd")
    loaders = one.stop_loaders()
    try:
        done = shmmap.run("query", "--id", "0_0.pcd", "--layer", LAYER, "--wait", "4")
    finally:
        for pid in loaders:
            os.kill(pid, signal.SIGCONT)
    assert done.returncode == 1
    assert "shmmap: 0 loads done, 0 computed, " in done.stderr
    assert "`shmmap prepare` or the setting prepare computes layers ahead of time" in done.stderr
