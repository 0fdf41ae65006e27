# SPDX-License-Identifier: Apache-2.0
"""``shmmap demo`` tells the truth and leaves nothing behind, however it ends."""

from __future__ import annotations

import json
import os
import secrets
import signal
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest

from tests.support.daemon_process import ROOT, processes_marked, wait_ended


class Demo:
    """A demonstration in its own process, with marked descendants and a temporary directory of its own."""

    def __init__(self, cwd: Path, *words: str) -> None:
        self.mark = secrets.token_hex(8)
        self.cwd = cwd
        self.scratch = cwd / "tmp"
        self.scratch.mkdir()
        self.process = subprocess.Popen(
            [sys.executable, "-m", "shmmap.cli", "demo", "--density", "4", *words],
            cwd=cwd,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={k: v for k, v in os.environ.items() if not k.startswith("SHMMAP_")}
            | {"PYTHONPATH": str(ROOT), "TMPDIR": str(self.scratch), "SHMMAP_TEST_RUN": self.mark}
            # settings of a real daemon must not matter
            | {"SHMMAP_SHM_DIR": "/nowhere", "SHMMAP_ENDPOINT": "/nowhere.sock", "SHMMAP_INSTANCE": "other"},
        )

    def leftovers(self) -> list[str]:
        """Processes, segments, sockets and files that should not be there any more."""
        found = [f"process {pid}" for pid in processes_marked(self.mark)]
        found += [f"segment {n}" for n in os.listdir("/dev/shm") if f"test-{self.process.pid}-" in n]
        found += [f"/tmp/{n}" for n in os.listdir("/tmp") if n.startswith(f"shmmap-{self.process.pid}-")]
        return found + [str(path) for path in self.scratch.iterdir()]


def test_demo_measures_and_draws(tmp_path: Path) -> None:
    demo = Demo(tmp_path, "--json", "--svg", "picture.svg", "--keep-map", "town")
    out, err = demo.process.communicate()
    assert (demo.process.returncode, err) == (0, "")
    told = json.loads(out)
    assert sorted(told) == ["private", "seconds", "shared", "svg", "town", "wire"]
    town, shared, private = told["town"], told["shared"], told["private"]
    files = list((tmp_path / "town" / "pointcloud_map.pcd").glob("*.pcd"))
    assert town["cells"] == len(files) == 320
    assert town["file_bytes"] == sum(file.stat().st_size for file in files)
    # both drives saw the same map
    for name in ("cells", "points", "map_bytes", "handed_bytes", "updates"):
        assert shared[name] == private[name] > 0
    assert private["processes"] == 4
    assert shared["processes"] >= 6
    assert shared["total_bytes"] == shared["process_bytes"] + shared["shm_bytes"]
    # every private copy is private memory; the shared one is there once, with little beside it
    assert private["private_bytes"] > 4 * private["map_bytes"]
    assert shared["map_bytes"] < shared["shm_bytes"] < 1.6 * shared["map_bytes"] + (1 << 20)
    # handles travel, points do not
    wire = told["wire"]
    assert wire["reply_bytes"] < 250 * wire["handles"]
    assert wire["request_bytes"] + wire["reply_bytes"] < shared["handed_bytes"] / 20
    assert told["svg"] == str(tmp_path / "picture.svg")
    picture = ElementTree.parse(told["svg"]).getroot()
    squares = [e.get("class") or "" for e in picture.iter("{http://www.w3.org/2000/svg}rect")]
    assert sum(square.startswith("cell") for square in squares) >= 320
    assert shared["cells"] <= sum(square == "cell resident" for square in squares)
    assert demo.leftovers() == []
    assert sorted(path.name for path in tmp_path.iterdir()) == ["picture.svg", "tmp", "town"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("stage", ["Building", "Driving", "The same drive"])
def test_an_interrupted_demo_leaves_nothing(tmp_path: Path, stage: str, number: signal.Signals) -> None:
    demo = Demo(tmp_path)
    assert demo.process.stdout is not None
    for line in demo.process.stdout:
        if line.startswith(stage):
            break
    demo.process.send_signal(number)
    assert wait_ended(demo.process.pid)
    _, err = demo.process.communicate()
    assert (demo.process.returncode, err) == (130, "")
    assert demo.leftovers() == []
    assert [path.name for path in tmp_path.iterdir()] == ["tmp"], "no picture of half a drive"


def test_a_demo_whose_daemon_dies_says_so_and_leaves_nothing(tmp_path: Path) -> None:
    demo = Demo(tmp_path)
    assert demo.process.stdout is not None
    for line in demo.process.stdout:
        if line.startswith("Driving"):
            break
    for pid in processes_marked(demo.mark):
        if b"shmmap.daemon\0" in Path(f"/proc/{pid}/cmdline").read_bytes():
            os.kill(pid, signal.SIGKILL)
    _, err = demo.process.communicate()
    assert demo.process.returncode not in (0, -signal.SIGKILL)
    assert err.startswith("shmmap: ")
    assert demo.leftovers() == []


def test_an_occupied_directory_is_refused_before_anything_is_built(tmp_path: Path) -> None:
    from shmmap.demo.demo import run_demo
    from shmmap.demo.demo_town import DemoSettings
    from shmmap.errors import BadRequest

    class NothingMayBegin:
        def stage(self, text: str, total: int) -> None:
            pytest.fail(f"{text}, {total} steps")

        def step(self, *args: object) -> None:
            pytest.fail(f"a step: {args}")

    (tmp_path / "town").mkdir()
    (tmp_path / "town" / "mine").touch()
    with pytest.raises(BadRequest, match="not an empty"):
        run_demo(DemoSettings(), NothingMayBegin(), map_dir=str(tmp_path / "town"))
    assert [path.name for path in (tmp_path / "town").iterdir()] == ["mine"]
