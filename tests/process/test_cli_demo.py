# SPDX-License-Identifier: Apache-2.0
"""``shmmap demo`` tells the truth and leaves nothing behind, however it ends."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree

import pytest

from shmmap import cli
from shmmap.cli.screens.demo import print_report, town_report
from shmmap.demo.consumer import Pose, StepReport
from shmmap.demo.demo import run_demo
from shmmap.demo.demo_town import DemoSettings
from shmmap.demo.drive import Fleet, drive_through_outage
from shmmap.demo.progress import Progress
from shmmap.errors import BadRequest
from shmmap.simulation.town import Town
from tests.support.daemon_process import DaemonProcess, processes_marked, wait_ended
from tests.support.demo_process import SMALL, Demo, until
from tests.support.patience import Patience


def test_demo_measures_and_draws(tmp_path: Path) -> None:
    words = ("--density", "4", "--json", "--svg", "picture.svg", "--keep-map", "town")
    demo = Demo(tmp_path, *words, command=("shmmap.cli", "demo"))
    out, err = demo.process.communicate()
    assert (demo.process.returncode, err) == (0, "")
    told = json.loads(out)
    assert sorted(told) == ["localization", "one_more_bytes", "outage", "rounds", "seconds", "svg", "town"]
    town = told["town"]
    files = list((tmp_path / "town" / "pointcloud_map.pcd").glob("*.pcd"))
    assert town["cells"] == len(files) == 320
    assert town["file_bytes"] == sum(file.stat().st_size for file in files)
    assert [each["consumers"] for each in told["rounds"]] == [1, 8]
    for each in told["rounds"]:
        _check_round(each["consumers"], each["shared"], each["private"])
    shared, private = told["rounds"][1]["shared"], told["rounds"][1]["private"]
    # one process more costs a copy, or no copy
    more = told["one_more_bytes"]
    assert more["private"] > more["shared"] + private["map_bytes"] / 2
    # no process stopped when the daemon did, and it came back with all it had
    outage = told["outage"]
    assert len(outage["counted"]) == 8
    assert min(outage["counted"]) > 0
    assert outage["poses"] >= 10
    assert outage["adopted"] == outage["segments"] >= shared["cells"]
    assert outage["down_s"] >= outage["poses"] * 0.1 / 2
    # the positions are those of the truth
    found = told["localization"]
    assert found["scans"] == found["trustworthy"] == 41
    assert 0.0 < found["error_m"] <= found["error_max_m"] < 0.1
    assert 0.0 < found["first_pose_s"] < told["seconds"]
    assert told["svg"] == str(tmp_path / "picture.svg")
    picture = ElementTree.parse(told["svg"]).getroot()
    squares = [e.get("class") or "" for e in picture.iter("{http://www.w3.org/2000/svg}rect")]
    assert sum(square.startswith("cell") for square in squares) >= 320
    assert shared["cells"] <= sum(square == "cell resident" for square in squares)
    assert demo.leftovers() == []
    assert sorted(path.name for path in tmp_path.iterdir()) == ["picture.svg", "tmp", "town"]


def _check_round(count: int, shared: dict[str, float], private: dict[str, float]) -> None:
    """Both drives saw the same map; the memory is where it should be."""
    assert shared["consumers"] == private["consumers"] == count
    for name in ("cells", "points", "map_bytes"):
        assert shared[name] == private[name] > 0
    assert private["processes"] == count
    assert shared["processes"] >= count + 2
    assert min(shared["cpu_s"], private["cpu_s"]) > 0
    assert shared["total_bytes"] == shared["process_bytes"] + shared["shm_bytes"]
    # every private copy is private memory; the shared one is there once, with little beside it
    assert private["private_bytes"] > count * private["map_bytes"]
    assert shared["map_bytes"] < shared["shm_bytes"] < 1.6 * shared["map_bytes"] + (1 << 20)


@pytest.mark.parametrize(
    ("stage", "number"),
    [
        ("Building a town", signal.SIGHUP),
        ("Simulating", signal.SIGTERM),
        ("Driving, 2 processes on the copy", signal.SIGINT),
        ("  The daemon is killed", signal.SIGINT),
        ("Localizing", signal.SIGINT),
    ],
)
def test_an_interrupted_demo_leaves_nothing(tmp_path: Path, stage: str, number: signal.Signals) -> None:
    demo = Demo(tmp_path)
    until(demo, stage)
    demo.process.send_signal(number)
    assert wait_ended(demo.process.pid)
    _, err = demo.process.communicate()
    assert (demo.process.returncode, err) == (130, "")
    assert demo.leftovers() == []
    assert [path.name for path in tmp_path.iterdir()] == ["tmp"], "no picture of half a drive"


def test_a_killed_demo_leaves_no_process_and_no_memory(tmp_path: Path) -> None:
    """Its directories stay where temporary files are, for nobody is left to remove them."""
    demo = Demo(tmp_path)
    until(demo, "Driving, 2 processes on the copy")
    demo.process.kill()
    demo.process.communicate()
    waiting = Patience()
    while waiting(bool(processes_marked(demo.mark))):
        pass
    directories = [*Path("/dev/shm").glob(f"shmmap-test-{demo.process.pid}-*")]
    assert [list(one.iterdir()) for one in directories] == [[]] * len(directories)
    for left in (*directories, *Path("/tmp").glob(f"shmmap-test-{demo.process.pid}-*")):
        shutil.rmtree(left)


def test_a_demo_whose_daemon_dies_says_so_and_leaves_nothing(tmp_path: Path) -> None:
    demo = Demo(tmp_path)
    until(demo, "Driving, 1 process on the copy")
    for pid in processes_marked(demo.mark):
        with contextlib.suppress(OSError):  # it has just ended
            if b"shmmap.daemon\0" in Path(f"/proc/{pid}/cmdline").read_bytes():
                os.kill(pid, signal.SIGKILL)
    _, err = demo.process.communicate()
    assert demo.process.returncode not in (0, -signal.SIGKILL)
    assert err.startswith("shmmap: ")
    assert demo.leftovers() == []


def test_without_numba_the_demo_says_what_is_left_out(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A client-only install has no compiler, and so no localization; all else is shown."""
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    result = run_demo(SMALL, Progress())
    assert (result.localization, result.missing) == (None, "numba")
    print_report(town_report(result), "town.svg", 1.0)
    lines = [line for line in capsys.readouterr().out.splitlines() if line[:1].islower() or line[:3] == "CPU"]
    assert [line.split("  ")[0] for line in lines] == [
        "town", "memory", "one more", "waiting", "CPU", "kill -9", "position", "duration",
    ]  # fmt: skip
    assert "the package numba is not installed" in lines[6]


def test_an_occupied_directory_is_refused_before_anything_is_built(tmp_path: Path) -> None:
    class NothingMayBegin(Progress):
        def stage(self, text: str, total: int) -> None:
            pytest.fail(f"{text}, {total} steps")

    (tmp_path / "town").mkdir()
    (tmp_path / "town" / "mine").touch()
    with pytest.raises(BadRequest, match="is not a divided map: it has mine"):
        run_demo(DemoSettings(), NothingMayBegin(), map_dir=str(tmp_path / "town"))
    assert [path.name for path in (tmp_path / "town").iterdir()] == ["mine"]


def test_the_full_demonstration_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["demo", "--full"]) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "--full" in said
    assert "python -m tests.benchmarks.memory" in said
    assert "python -m tests.benchmarks.three_programs" in said


class WatchedFleet(Fleet):
    """Looks at every pose whether there is a daemon, and what the consumers have counted."""

    def __init__(self, source: DaemonProcess, consumers: int, route: list[Pose], work: Path) -> None:
        super().__init__(source, 60.0, consumers, route, work)
        self.alone: list[list[int]] = []
        self.reports: list[StepReport] = []

    def move_to(self, pose: Pose, progress: Progress, *, drive_on: bool = False) -> list[StepReport]:
        self.reports = super().move_to(pose, progress, drive_on=drive_on)
        assert self.daemon is not None
        # by the kernel's word: neither the daemon nor one of its loaders is alive
        if not processes_marked(self.daemon.instance, "SHMMAP_TEST_DAEMON"):
            self.alone.append([report.counted for report in self.reports])
        return self.reports


class Events(Progress):
    """Keeps what has happened, and the last lines of a step."""

    def __init__(self) -> None:
        self.events: list[str] = []
        self.lines: tuple[str, ...] = ()

    def step(self, *lines: str) -> None:
        self.lines = lines

    def event(self, text: str) -> None:
        self.events.append(text)


def test_consumers_go_on_without_the_daemon(daemon: Callable[..., DaemonProcess], tmp_path: Path) -> None:
    town = Town(seed=4, blocks=(3, 2), density=6.0)
    town.write(tmp_path / "map")
    one = daemon(tmp_path / "map")
    first_pid = one.pid
    route = [Pose(*pose) for pose in town.route(length=40.0, step=1.0).tolist()]
    seen = Events()
    fleet = WatchedFleet(one, 3, route, tmp_path)
    with fleet:
        fleet.move_to(route[0], seen)
        # a spectator sees each process and the daemon
        assert [line.split()[0] for line in seen.lines] == ["localization", "mapping", "perception", "shared"]
        held = one.segments()
        result = drive_through_outage(fleet, one, route, seen, pace_s=0.02)
    assert one.pid != first_pid
    # every control loop read more points with every pose of the outage
    assert len(fleet.alone) >= 10
    for before, after in pairwise(fleet.alone):
        assert all(a < b for a, b in zip(before, after, strict=True))
    assert len(result.counted) == 3
    assert result.poses >= len(fleet.alone)
    assert min(result.counted) > 0
    # the next daemon has what the first one had, and all is as before
    assert result.adopted == result.segments >= len(held) > 0
    assert all(report.current for report in fleet.reports)
    assert "killed" in seen.events[0]
    assert "starts again" in seen.events[1]
    assert str(result.adopted) in seen.events[2]
