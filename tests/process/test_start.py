# SPDX-License-Identifier: Apache-2.0
"""What hinders the daemon's start: the exit code says whether that can pass."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.process.conftest import DaemonFactory
from tests.support.daemon_process import DaemonProcess
from tests.support.divided_map import DividedMap
from tests.support.raw_client import RawClient, circle

Connect = Callable[..., RawClient]


@pytest.mark.root
@pytest.mark.parametrize("flags", [[], ["--budget", "8M"]])
def test_a_full_file_system(
    daemon: DaemonFactory, divided_map: DividedMap, private_tmpfs: Callable[[str], str], flags: list[str]
) -> None:
    directory = private_tmpfs("16m")
    other = Path(directory, "other")
    with other.open("wb") as file:
        os.posix_fallocate(file.fileno(), 0, 16 << 20)
    one = daemon(divided_map.root, *flags, shm_dir=directory, start=False, forked=False)
    assert one.run_to_end() == 71
    assert f"{directory}" in one.log
    assert "hint: free some" in one.log
    other.unlink()
    one.start()


@pytest.mark.root
def test_a_file_system_that_is_not_mounted_yet(
    daemon: DaemonFactory, divided_map: DividedMap, private_tmpfs: Callable[[str], str]
) -> None:
    directory = private_tmpfs("16m") + "/not/yet"
    one = daemon(divided_map.root, shm_dir=directory, start=False, forked=False)
    assert one.run_to_end() == 71
    os.makedirs(directory)
    one.start()


def test_a_name_that_is_squatted(daemon: DaemonFactory, divided_map: DividedMap) -> None:
    """A directory stands for another account's file: not even root replaces it by renaming."""
    one = daemon(divided_map.root, start=False, forked=False)
    place = Path(one.shm_dir, f"shmmap.{one.instance}.statistics")
    place.mkdir()
    assert one.run_to_end() == 71
    assert f"the statistics cannot be {place}: there is a directory of user " in one.log
    assert f"remove it: `sudo rm -r {place}`" in one.log
    place.rmdir()
    one.start()


def test_a_second_daemon_with_another_runtime_directory(
    served: DaemonProcess, connect: Connect, short_path: Path
) -> None:
    """It would take the segments of the first one for leftovers, and remove them when it is stopped."""
    assert len(connect(served).area(circle(0, 0, 25)).cells) == 12
    segments = served.segments()
    place = short_path / "run"
    served.arguments = ["--runtime-dir", str(place)]
    assert served.run_to_end() == 75
    assert f"another daemon (pid {served.pid}, listening at {served.endpoint})" in served.log
    os.kill(served.pid, signal.SIGSTOP)  # a process keeps its locks while it exists
    assert served.run_to_end() == 75
    os.kill(served.pid, signal.SIGCONT)
    assert (served.segments(), os.listdir(place)) == (segments, [])
    served.arguments = []
    assert len(connect(served).area(circle(0, 0, 25)).cells) == 12


def test_endless_metadata(daemon: DaemonFactory, divided_map: DividedMap) -> None:
    """A number without an end: the map is wrong, which is said in a few words."""
    metadata = divided_map.root / "pointcloud_map_metadata.yaml"
    good = metadata.read_text()
    metadata.write_text(f"{good}a.pcd: [{'7' * 1_000_000}, 0]\n")
    one = daemon(divided_map.root, start=False, forked=False)
    assert one.run_to_end() == 65
    assert f"shmmap: {metadata}: line " in one.log
    assert "a.pcd: the corner must be two numbers, not [777" in one.log
    assert "Traceback" not in one.log
    assert len(one.log) < 2000
    metadata.write_text(good)
    one.start()
