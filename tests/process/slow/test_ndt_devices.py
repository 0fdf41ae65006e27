# SPDX-License-Identifier: Apache-2.0
"""Localization on a device with a real daemon: the same drive, the same first pose; a device that fails."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.process.conftest import DaemonFactory
from tests.support.forked_programs import run_verb
from tests.support.ndt_programs import TownDrive, town_drive_once
from tests.support.opencl_device import need_device
from tests.support.pages import read_page

NDT = "shmmap_clients.ndt_scan_matcher"
POSE_INIT = "shmmap_clients.pose_initializer"


@pytest.fixture(scope="module", autouse=True)
def device() -> None:
    need_device()


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> TownDrive:
    return town_drive_once(tmp_path_factory, blocks=(2, 2), density=5.0, frames=12, step=2.0)


def run(module: str, *words: str) -> tuple[int, Any, str]:
    done = run_verb(words, module=module)
    return done.returncode, json.loads(done.stdout) if done.stdout else None, done.stderr


def test_the_page_s_command_lists_what_there_is() -> None:
    """Its first two lines install what the machine of this test has already."""
    (command,) = (line for line in read_page("clients/README.md").commands("device") if "shmmap-ndt" in line)
    done = run_verb(shlex.split(command, comments=True)[1:], module=NDT)
    assert done.returncode == 0, done.stderr
    assert done.stdout


def follow(drive: TownDrive, one: Any, lines: Path) -> list[str]:
    words = ["follow", "--endpoint", one.endpoint, "--shm-dir", one.shm_dir, "--scans", str(drive.scans)]
    words += ["--truth", str(drive.truth), "--map-radius", "200", "--thin", "0.5", "--fine", "--json"]
    return [*words, "--json-lines", str(lines)]


def poses(lines: Path) -> np.ndarray:
    return np.array([json.loads(line)["pose"] for line in lines.read_text().splitlines()])


def test_a_drive_is_followed_on_a_device_as_without(
    drive: TownDrive, daemon: DaemonFactory, tmp_path: Path
) -> None:
    one = daemon(drive.map_dir)
    variants = {"numba": [], "copy": ["--memory", "copy"], "svm": ["--memory", "svm"]}
    found = {}
    for variant, options in variants.items():
        backend = [] if variant == "numba" else ["--backend", "opencl", *options]
        lines = tmp_path / f"{variant}.jsonl"
        code, summary, err = run(NDT, *follow(drive, one, lines), *backend)
        assert code == 0, err
        assert summary["trustworthy"] == 12
        assert summary["backend"] == ("numba" if variant == "numba" else "opencl")
        assert summary["fault"] is None
        assert summary["map_updates"] >= 1
        assert 0.0 < summary["map_prepare_ms"]["max"] <= summary["map_build_ms"]["max"]
        if variant == "copy":
            # with --fine a map is prepared twice: with its cells, and with another kind of covariance
            assert summary["map_writes"] >= 2
            assert summary["map_written_bytes"] > 100_000
        else:
            assert summary["map_writes"] == summary["map_written_bytes"] == 0
        assert summary["map_laid_out_again"] == 0
        found[variant] = poses(lines)
    for variant in ("copy", "svm"):
        np.testing.assert_allclose(found[variant], found["numba"], atol=1e-9)


def test_a_drive_goes_on_without_a_device_that_hangs(
    drive: TownDrive, daemon: DaemonFactory, tmp_path: Path
) -> None:
    one = daemon(drive.map_dir)
    hanging = ("tests.support.opencl_device", "program")
    words = [*follow(drive, one, tmp_path / "lines"), "--backend", "opencl", "--deadline", "2"]
    code, summary, err = run(*hanging, *words, "--fallback", "numba")
    assert summary is not None, err
    assert summary["frames"] == 12
    assert summary["cut_by"] == {"deadline": 1}
    assert summary["trustworthy"] == 11, "only the scan on which the device was given up"
    assert summary["backend"] == "numba"
    assert "has not answered" in summary["fault"]
    assert "the device failed at scan" in err
    assert "numba goes on" in err
    assert code == 1, "that scan was not trusted"
    code, _, err = run(*hanging, *words)
    assert code == 69
    assert "has not answered" in err
    assert "--fallback numba" in err
    assert "Traceback" not in err


def test_the_first_pose_is_the_same_on_a_device(
    drive: TownDrive, daemon: DaemonFactory, tmp_path: Path
) -> None:
    one = daemon(drive.map_dir)
    x, y, z, _, _, yaw = drive.poses[3]
    rough = f"{x + 1.0:.3f},{y - 0.8:.3f},{z:.3f},0,0,{yaw + 0.08:.4f}"
    scan = sorted(drive.scans.iterdir())[3]
    words = ["--scan", str(scan), "--pose", rough, "--height", "1.8", "--json"]
    words += ["--endpoint", one.endpoint, "--shm-dir", one.shm_dir]
    found = {}
    for backend in ("numba", "opencl"):
        code, document, err = run(POSE_INIT, *words, "--backend", backend)
        assert code == 0, err
        assert document["reliable"] is True
        found[backend] = document
    np.testing.assert_allclose(found["opencl"]["T_map_base"], found["numba"]["T_map_base"], atol=1e-9)
    assert len(found["opencl"]["alternatives"]) == len(found["numba"]["alternatives"])
    np.testing.assert_allclose(np.array(found["numba"]["T_map_base"])[:2, 3], [x, y], atol=0.2)
