# SPDX-License-Identifier: Apache-2.0
"""The example with dask: a worker that is killed changes nothing."""

from __future__ import annotations

import contextlib
import json
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.support.command_line import Verbs
from tests.support.daemon_process import ROOT, wait_ended
from tests.support.divided_map import make_map
from tests.support.published_maps import PublishedMapReader

EXAMPLE = "clients/examples/slices_with_dask.py"

pytestmark = pytest.mark.usefixtures("layer_kernels")
pytest.importorskip("zstandard", reason="zstandard is not installed")


@pytest.fixture
def cluster(tmp_path: Path, shmmap: Verbs) -> Iterator[dict[str, subprocess.Popen[str]]]:
    """A scheduler and two workers on loopback, without nannies that would start others in their place."""
    pytest.importorskip("distributed", reason="dask.distributed is not installed")
    environment = shmmap.environment | {"DASK_TEMPORARY_DIRECTORY": str(tmp_path / "dask")}
    file = tmp_path / "scheduler.json"
    common = ["--scheduler-file", str(file), "--host", "127.0.0.1"]
    words = {
        "scheduler": ["scheduler", *common, "--port", "0", "--no-dashboard", "--no-show"],
        "first": ["worker", *common, "--no-nanny", "--no-dashboard", "--nthreads", "1", "--name", "first"],
        "second": ["worker", *common, "--no-nanny", "--no-dashboard", "--nthreads", "1", "--name", "second"],
    }
    started: dict[str, subprocess.Popen[str]] = {}
    try:
        for name, what in words.items():
            started[name] = subprocess.Popen(
                [sys.executable, "-m", "dask", *what],
                env=environment,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                text=True,
            )
            while name == "scheduler" and not file.exists():
                assert started[name].poll() is None
                time.sleep(0.01)
        yield started
    finally:
        for process in started.values():
            process.kill()
            process.wait()


def commands_of(worker: subprocess.Popen[str]) -> list[int]:
    """Processes that a worker has started to make slices."""
    found = []
    for task in Path(f"/proc/{worker.pid}/task").iterdir():
        for pid in (task / "children").read_text().split():
            with contextlib.suppress(OSError):
                if b"prepare" in Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0"):
                    found.append(int(pid))
    return found


def test_a_dask_worker_that_is_killed_changes_nothing(
    cluster: dict[str, subprocess.Popen[str]], tmp_path: Path, shmmap: Verbs
) -> None:
    """The same root as in one go; a worker is killed while it makes a slice."""
    made = make_map(tmp_path / "town", columns=2, rows=2, points=300)
    layer = ["--layer", "voxel(leaf=1.0)"]
    one: Any = shmmap.json("publish", made.root, tmp_path / "one", "--id-prefix", "/t/", *layer)
    shmmap("publish", made.root, tmp_path / "two", "--id-prefix", "/t/")
    address = json.loads((tmp_path / "scheduler.json").read_bytes())["address"]
    assert address.startswith("tcp://127.0.0.1:")
    example = subprocess.Popen(
        [sys.executable, EXAMPLE, str(tmp_path / "two"), *layer, "--slices", "4", "--scheduler", address],
        env=shmmap.environment,
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        victim = cluster["first"]
        while not (making := commands_of(victim)):
            assert victim.poll() is None
            assert example.poll() is None, example.communicate()
            time.sleep(0.001)
        victim.send_signal(signal.SIGKILL)
        printed, errors = example.communicate()
        for pid in making:  # it continues without its parent, which is harmless
            wait_ended(pid)
    finally:
        example.kill()
    assert example.returncode == 0, errors
    assert len(re.findall(r"^slice \d of 4: ", printed, re.MULTILINE)) == 4
    assert cluster["second"].poll() is None
    assert PublishedMapReader(tmp_path / "two").current["root"] == one["root"]
