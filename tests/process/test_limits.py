# SPDX-License-Identifier: Apache-2.0
"""A daemon that a limit hinders says which one, whatever it hinders: at its start and at one cell."""

from __future__ import annotations

import grp
import os
import re
import resource
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import shmmap
from shmmap.daemon.config import DaemonConfig
from shmmap.daemon.prerequisites import access_of_segments
from shmmap.errors import ConfigError
from shmmap.testing.environment import without_settings
from tests.support.daemon_process import DaemonProcess
from tests.support.divided_map import DividedMap, random_points

Factory = Callable[..., DaemonProcess]
KIB = 1024


def started_under(limit: int, value: int, arguments: list[str]) -> tuple[int, str]:
    """Start a daemon that cannot; returns its exit code and what it says."""
    done = subprocess.run(
        [sys.executable, "-m", "shmmap.daemon", *arguments],
        preexec_fn=lambda: resource.setrlimit(limit, (value, value)),
        capture_output=True, text=True, check=False, env=without_settings(),
    )  # fmt: skip
    return done.returncode, done.stderr


@pytest.mark.parametrize(
    ("limit", "value", "name"),
    [
        (resource.RLIMIT_FSIZE, 50 * KIB, "RLIMIT_FSIZE is 51,200 bytes"),
        (resource.RLIMIT_NOFILE, 12, "12 (RLIMIT_NOFILE)"),
        (resource.RLIMIT_DATA, 60_000 * KIB, "RLIMIT_DATA"),
    ],
)
def test_a_start_that_a_limit_forbids(
    divided_map: DividedMap, tmp_path: Path, limit: int, value: int, name: str
) -> None:
    (tmp_path / "shm").mkdir()
    arguments = [str(divided_map.root), "--instance", "limited", "--runtime-dir", str(tmp_path / "run")]
    code, said = started_under(limit, value, [*arguments, "--shm-dir", str(tmp_path / "shm")])
    assert code == 71, said
    assert name in said
    assert "raise the limit" in said or "raise it" in said
    assert "internal error" not in said
    assert os.listdir(tmp_path / "shm") == []


def test_a_segment_that_the_limit_on_files_forbids(daemon: Factory, divided_map: DividedMap) -> None:
    """The cell's file is blameless; the others are served, and this one as soon as the limit is gone."""
    large = random_points(np.random.default_rng(1), (0, 0), 200_000)
    divided_map.write_cell("0_0.pcd", (0, 0), large)
    one = daemon(divided_map.root)
    for pid in (one.pid, *one.children()):
        resource.prlimit(pid, resource.RLIMIT_FSIZE, (1 << 20, resource.RLIM_INFINITY))
    with shmmap.connect(one.endpoint) as client:
        cells = client.around(0, 0, 15, wait=60)
        assert len(cells) == 3
        (failed,) = cells.failed
        assert failed.cell_id.endswith("/0_0.pcd")
        assert "RLIMIT_FSIZE is 1,048,576 bytes" in failed.message
        assert "ulimit -f" in failed.message


def test_a_daemon_with_limited_files_says_so_at_its_start(daemon: Factory, divided_map: DividedMap) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (16 << 20, hard))
    try:
        one = daemon(divided_map.root, "--budget", "32M", forked=False)  # a fork has its parent's limits
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert re.search(
        r"WARNING files are limited in size RLIMIT_FSIZE=16777216 budget_bytes=33554432", one.log
    )


def test_a_group_that_the_daemon_s_user_is_not_in(monkeypatch: pytest.MonkeyPatch) -> None:
    """Said before anything is made, with the command that mends it."""
    group = grp.getgrgid(0).gr_name
    monkeypatch.setattr(os, "geteuid", lambda: 12345)
    monkeypatch.setattr(os, "getegid", lambda: 12345)
    monkeypatch.setattr(os, "getgroups", lambda: [12345, 7])
    with pytest.raises(ConfigError, match=f"no member of the group {group}") as refused:
        access_of_segments(DaemonConfig(group=group))
    assert f"usermod -aG {group} 12345" in refused.value.hint
    monkeypatch.setattr(os, "getgroups", lambda: [12345, 0])
    assert access_of_segments(DaemonConfig(group=group)) == (0, 0o440)
