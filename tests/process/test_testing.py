# SPDX-License-Identifier: Apache-2.0
"""What users test with: a daemon of one's own, judged when it ends, with pytest or without."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

import shmmap
from shmmap.errors import InternalError
from shmmap.testing.daemon_process import DaemonProcess, isolated_daemons
from tests.support.daemon_process import wait_ended
from tests.support.divided_map import DividedMap

TESTS = """
import shmmap

def test_good(shmmap_daemon):
    daemon = shmmap_daemon({map!r}, "--budget", "64M")
    with shmmap.connect(daemon.endpoint) as client:
        assert client.around(0.0, 0.0, 100.0)

def test_leaves_a_file_open(shmmap_daemon):
    shmmap_daemon({map!r})
    global left
    left = open(__file__)

def test_leaves_a_segment(shmmap_daemon):
    daemon = shmmap_daemon({map!r})
    open(f"{{daemon.shm_dir}}/shmmap.{{daemon.instance}}.left", "w").close()
"""


def test_the_fixture_for_pytest(divided_map: DividedMap, tmp_path: Path) -> None:
    (tmp_path / "conftest.py").write_text('pytest_plugins = ["shmmap.testing.fixtures"]\n', encoding="utf-8")
    (tmp_path / "test_mine.py").write_text(TESTS.format(map=str(divided_map.root)), encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--rootdir", tmp_path, tmp_path],
        capture_output=True,
        text=True,
        check=False,
    )
    assert re.search("3 passed, .*2 errors", done.stdout), done.stdout + done.stderr
    errors = [line for line in done.stdout.splitlines() if line.startswith("ERROR")]
    assert ["test_leaves_a_file_open" in errors[0], "test_leaves_a_segment" in errors[1]] == [True, True]
    assert "test_mine.py" in done.stdout.split("left behind:")[1]
    assert "segment shmmap.test-" in done.stdout


def test_no_pytest_is_needed() -> None:
    code = (
        "import sys; sys.modules['pytest'] = None\n"
        "import shmmap.testing.daemon_process, shmmap.testing.layer_conformance"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_daemon_without_a_framework(divided_map: DividedMap, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SHMMAP_INSTANCE", "another-daemon")
    with DaemonProcess(divided_map.root) as daemon:
        with shmmap.connect(daemon.endpoint) as client:
            assert len(client.around(0.0, 0.0, 100.0)) == len(divided_map.corners)
        assert daemon.segment_bytes() > 0
        assert daemon.shm_bytes() > daemon.segment_bytes(), "the statistics too"
        pid, directories = daemon.pid, (daemon.runtime_dir, daemon.shm_dir, daemon.scratch_dir)
    assert wait_ended(pid, 0.0)
    assert daemon.leftovers() == []
    assert not any(os.path.exists(path) for path in directories)
    with pytest.raises(InternalError, match="not running"):
        daemon.pid  # noqa: B018


def test_a_killed_daemon_comes_back_with_its_segments(divided_map: DividedMap) -> None:
    with isolated_daemons(DaemonProcess) as make:
        daemon = make(divided_map.root)
        with shmmap.connect(daemon.endpoint) as client:
            client.around(0.0, 0.0, 100.0)
        before = daemon.segments()
        daemon.kill()
        assert daemon.segments() == before != []
        daemon.launch()
        assert daemon.wait_ready()
        assert daemon.segments() == before
        with shmmap.connect(daemon.endpoint) as client:
            assert client.stats().counters["adopted"] == len(before)


def test_one_that_cannot_start_says_why_and_leaves_nothing(tmp_path: Path) -> None:
    daemon = DaemonProcess(tmp_path / "nowhere")
    with pytest.raises(InternalError, match="nowhere"), daemon:
        pass
    assert not os.path.exists(daemon.runtime_dir)
    assert not os.path.exists(daemon.shm_dir)


def test_a_stopped_daemon_is_not_ready(divided_map: DividedMap) -> None:
    with isolated_daemons(DaemonProcess) as make:
        daemon = make(divided_map.root, start=False)
        daemon.launch()
        daemon.send(signal.SIGSTOP)
        assert not daemon.wait_ready(0.05)
        daemon.send(signal.SIGCONT)
        assert daemon.wait_ready()


def test_directories_go_with_an_object_that_is_never_disposed_of(divided_map: DividedMap) -> None:
    daemon = DaemonProcess(divided_map.root)
    directories = (daemon.runtime_dir, daemon.shm_dir, daemon.scratch_dir)
    assert all(os.path.isdir(path) for path in directories)
    del daemon
    assert not any(os.path.exists(path) for path in directories)
