# SPDX-License-Identifier: Apache-2.0
"""The disk of a live map is full: mapping goes on in memory, status shows it, and all is saved later."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

import shmmap
from tests.process.conftest import DaemonFactory
from tests.support.daemon_process import DaemonProcess, Deadline
from tests.support.live_drive import FILTER, RESOLUTION, drive
from tests.support.live_reference import held, reference


@pytest.mark.root
def test_a_disk_that_is_full(
    daemon: DaemonFactory, tmp_path: Path, private_tmpfs: Callable[[str], str]
) -> None:
    disk, scans = private_tmpfs("96k"), drive()
    file = tmp_path / "shmmap.toml"
    file.write_text(
        f"[live.lidar]\nresolution = {RESOLUTION}\nlinger_s = 0.05\ncheckpoint_s = 0.2\n"
        f'path = "{disk}/lidar"\n'
    )
    one: DaemonProcess = daemon("", "--config", str(file), "--live-budget", "16M")
    with shmmap.connect(one.endpoint) as client:
        live = client.live("lidar")
        with live.mapper("front", FILTER) as mapper:
            for points, pose in scans:
                mapper.add(points, pose)
            mapper.wait_applied()
            waiting = Deadline()
            while waiting("cannot be saved: No space left" not in (status := live.status()).problem):
                pass
            assert status.scans == len(scans)
            assert status.dirty + status.saving > 0
            assert mapper.durable < len(scans)
            assert held(live) == reference(scans), "what has no file is in memory"
            mapper.add(*scans[0])
            mapper.wait_applied()
            assert live.status().scans == len(scans) + 1
            subprocess.run(["mount", "-o", "remount,size=16m", disk], check=True)
            mapper.wait_durable()
        status = live.status()
        assert (status.problem, status.dirty, status.saving) == ("", 0, 0)
        assert held(live, "disk") == reference([*scans, scans[0]])
    assert one.log.count("chunk not saved") < 20, "it is retried each second, and logged once"
    assert one.stop() == 0
