# SPDX-License-Identifier: Apache-2.0
"""SLICES.md is true: its commands and scripts make slices as they stand, and the example with dask does."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.support.command_line import Verbs
from tests.support.daemon_process import ROOT, wait_ended
from tests.support.divided_map import make_map
from tests.support.map_stores import BucketServer
from tests.support.pages import read_page
from tests.support.published_maps import PublishedMapReader

PAGE = read_page("shmmap/publishing/SLICES.md")
EXAMPLE = "clients/examples/slices_with_dask.py"

pytestmark = pytest.mark.usefixtures("layer_kernels")
pytest.importorskip("zstandard", reason="zstandard is not installed")


class Machine:
    """Runs the page's commands: with `shmmap` on the path, a town, and a bucket."""

    def __init__(self, folder: Path, buckets: BucketServer) -> None:
        self.folder = folder
        make_map(folder / "town", columns=2, rows=2, points=300)
        self._shmmap = folder / "bin/shmmap"
        self._shmmap.parent.mkdir()
        self._shmmap.write_text(f'#!/bin/sh\nexec {sys.executable} -m shmmap.cli "$@"\n')
        self._shmmap.chmod(0o755)
        self.environment = {k: v for k, v in os.environ.items() if not k.startswith(("SHMMAP_", "AWS_"))}
        self.environment |= {
            "HOME": str(folder),
            "PYTHONPATH": str(ROOT),
            "XDG_CACHE_HOME": str(folder / "cache"),
            "PATH": f"{self._shmmap.parent}:{Path(sys.executable).parent}:{os.environ['PATH']}",
            "DASK_TEMPORARY_DIRECTORY": str(folder / "dask"),
        }
        exports = PAGE.commands("credentials")
        self.environment |= dict(line.removeprefix("export ").split("=", 1) for line in exports)
        assert self.environment["AWS_ENDPOINT_URL"].startswith("http://127.0.0.1:")
        self.environment["AWS_ENDPOINT_URL"] = buckets.endpoint
        self.name = f"maps/{folder.name}"

    def run(self, script: str, **environment: str) -> str:
        """Run a script in a shell, with a map of its own in the bucket."""
        done = subprocess.run(
            ["/bin/sh", "-euc", script.replace("maps/town", self.name)],
            env={**self.environment, **environment},
            cwd=ROOT,
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stderr + done.stdout
        return done.stdout

    def publish(self) -> None:
        self.run(PAGE.commands("by-hand")[0])


@pytest.fixture
def machine(tmp_path: Path, buckets: BucketServer) -> Machine:
    return Machine(tmp_path, buckets)


def run_in(text: str) -> str:
    """The name of the run that a slice prints."""
    (found,) = set(re.findall(r"^run +(\S+)$", text, re.MULTILINE))
    return str(found)


def test_every_block_is_tested() -> None:
    assert set(PAGE.blocks) == {
        "install", "credentials", "by-hand", "parallel", "slurm", "kubernetes", "dask",
    }  # fmt: skip
    assert PAGE.fences == len(PAGE.blocks) - 2  # a script and a manifest are no commands to type
    assert PAGE.commands("install") == read_page("shmmap/publishing/PUBLISHING.md").commands("install")


def test_by_hand(machine: Machine) -> None:
    *commands, join = PAGE.commands("by-hand")
    printed = [machine.run(command) for command in commands]
    run = run_in("\n".join(printed))
    assert "version  2\nlayers   ndt(leaf=2.0) points\njoined   2 slices\n" in machine.run(
        join.replace("RUN", run)
    )


def test_gnu_parallel(machine: Machine) -> None:
    if "GNU parallel" not in _version_of("parallel"):
        pytest.skip("GNU parallel is not installed")
    machine.publish()
    (command,) = PAGE.commands("parallel")
    run = run_in(machine.run(command))
    assert run.endswith("-4")
    assert "joined   4 slices" in machine.run(f"shmmap publish s3://maps/town --join {run}")


def _version_of(program: str) -> str:
    if shutil.which(program) is None:
        return ""
    return subprocess.run([program, "--version"], capture_output=True, text=True).stdout


def test_the_script_for_slurm_and_the_manifest_for_kubernetes_make_their_slices(machine: Machine) -> None:
    """Of four shards in 64 slices the second is in the 17th; nothing is in the 18th."""
    machine.publish()
    script = "\n".join(PAGE.blocks["slurm"])
    assert "--array=1-64 " in script
    made = machine.run(script, SLURM_ARRAY_TASK_ID="17")
    assert "17 of 64, 1 cell\n" in made
    job = yaml.safe_load("\n".join(PAGE.blocks["kubernetes"]))
    assert (job["kind"], job["spec"]["completions"], job["spec"]["completionMode"]) == ("Job", 64, "Indexed")
    (container,) = job["spec"]["template"]["spec"]["containers"]
    assert container["command"] == ["sh", "-c"]
    (command,) = container["args"]
    again = machine.run(command, JOB_COMPLETION_INDEX="16")
    assert "17 of 64, 1 cell: it had been made before\n" in again
    empty = machine.run(command, JOB_COMPLETION_INDEX="17")
    assert "18 of 64, 0 cells\n" in empty
    assert run_in(made) == run_in(again) == run_in(empty)


# --- dask ---------------------------------------------------------------------------------------------


def test_dask_on_this_machine(machine: Machine) -> None:
    pytest.importorskip("distributed", reason="dask.distributed is not installed")
    machine.publish()
    install, example = PAGE.commands("dask")
    assert install == "pip install -q distributed"
    assert EXAMPLE in example
    printed = machine.run(example)
    assert printed.count(" bytes sent") == 4
    assert "joined   4 slices" in printed


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
                env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, text=True,
            )  # fmt: skip
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
    import json

    made = make_map(tmp_path / "town", columns=2, rows=2, points=300)
    layer = ["--layer", "voxel(leaf=1.0)"]
    one: Any = shmmap.json("publish", made.root, tmp_path / "one", "--id-prefix", "/t/", *layer)
    shmmap("publish", made.root, tmp_path / "two", "--id-prefix", "/t/")
    address = json.loads((tmp_path / "scheduler.json").read_bytes())["address"]
    assert address.startswith("tcp://127.0.0.1:")
    example = subprocess.Popen(
        [sys.executable, EXAMPLE, str(tmp_path / "two"), *layer, "--slices", "4", "--scheduler", address],
        env=shmmap.environment, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
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
