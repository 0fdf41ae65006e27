# SPDX-License-Identifier: Apache-2.0
"""``shmmap demo`` measures truly and leaves nothing behind, however it ends; its programs too."""

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

from shmmap.cli.screens.demo import print_report
from shmmap.demo.consumer import Pose, StepReport
from shmmap.demo.demo import run_demo
from shmmap.demo.demo_town import DemoSettings
from shmmap.demo.drive import Fleet, drive_through_outage
from shmmap.demo.program import Program, Progress, cpu_seconds
from shmmap.errors import BadRequest, InternalError
from shmmap.simulation.town import Town
from tests.support.daemon_process import DaemonProcess, Deadline, processes_marked, wait_ended
from tests.support.demo_process import SMALL, Demo, until
from tests.support.pictures import png_pixels


def test_demo_measures_and_draws(tmp_path: Path) -> None:
    words = ("--density", "4", "--json", "--svg", "picture.svg", "--keep-map", "town")
    demo = Demo(tmp_path, *words, command=("shmmap.cli", "demo"))
    out, err = demo.process.communicate()
    assert (demo.process.returncode, err) == (0, "")
    report = json.loads(out)
    assert sorted(report) == [
        "localization",
        "one_more_bytes",
        "outage",
        "png",
        "rounds",
        "seconds",
        "svg",
        "town",
    ]
    town = report["town"]
    files = list((tmp_path / "town" / "pointcloud_map.pcd").glob("*.pcd"))
    assert town["cells"] == len(files) == 320
    assert town["file_bytes"] == sum(file.stat().st_size for file in files)
    assert [each["consumers"] for each in report["rounds"]] == [1, 8]
    for each in report["rounds"]:
        _check_round(each["consumers"], each["shared"], each["private"])
    shared, private = report["rounds"][1]["shared"], report["rounds"][1]["private"]
    # one process more costs a copy, or no copy
    more = report["one_more_bytes"]
    assert more["private"] > more["shared"] + private["map_bytes"] / 2
    # no process stopped when the daemon did, and it came back with all it had
    outage = report["outage"]
    assert len(outage["counted"]) == 8
    assert min(outage["counted"]) > 0
    assert outage["poses"] >= 10
    assert outage["adopted"] == outage["segments"] >= shared["cells"]
    assert outage["down_s"] >= outage["poses"] * 0.1 / 2
    # the positions are those of the truth
    found = report["localization"]
    assert found["scans"] == found["trustworthy"] == 41
    assert 0.0 < found["error_m"] <= found["error_max_m"] < 0.1
    assert 0.0 < found["first_pose_s"] < report["seconds"]
    assert report["svg"] == str(tmp_path / "picture.svg")
    picture = ElementTree.parse(report["svg"]).getroot()
    squares = [e.get("class") or "" for e in picture.iter("{http://www.w3.org/2000/svg}rect")]
    assert sum(square.startswith("cell") for square in squares) >= 320
    assert shared["cells"] <= sum(square == "cell resident" for square in squares)
    assert report["png"] == str(tmp_path / "picture.png")
    assert png_pixels((tmp_path / "picture.png").read_bytes(), "RGB").shape == (800, 1280, 3)
    assert demo.leftovers() == []
    assert sorted(path.name for path in tmp_path.iterdir()) == ["picture.png", "picture.svg", "tmp", "town"]


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
        ("  The daemon is killed", signal.SIGTERM),
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
    """Its directories stay where temporary files are, for no process is left to remove them."""
    demo = Demo(tmp_path)
    until(demo, "Driving, 2 processes on the copy")
    demo.process.kill()
    demo.process.communicate()
    waiting = Deadline()
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
    print_report(result, "town.svg", 1.0)
    lines = [line for line in capsys.readouterr().out.splitlines() if line[:1].islower() or line[:3] == "CPU"]
    assert [line.split("  ")[0] for line in lines] == [
        "town",
        "memory",
        "one more",
        "waiting",
        "CPU",
        "kill -9",
        "position",
        "duration",
    ]
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


# --- programs beside the demonstration: read while they run or in the end, and never left behind -----


@pytest.fixture
def program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A module ``said`` that runs the code it is given."""
    (tmp_path / "said.py").write_text("import sys\nexec(sys.argv[1])\n", encoding="utf-8")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    return "said"


def test_what_it_writes_in_the_end(program: str, tmp_path: Path) -> None:
    with Program("one", program, ["print('{\"a\": 1}'); sys.exit(3)"], tmp_path) as one:
        assert json.loads(one.finish(60.0, fails=True)) == {"a": 1}
        assert one.exit_code == 3
        assert not one.running
        with pytest.raises(InternalError, match="one does not run"):
            one.read_line(60.0)
    with (
        Program("other", program, ["raise SystemExit('no map')"], tmp_path) as other,
        pytest.raises(InternalError, match="other ended with 1: no map"),
    ):
        other.finish(60.0)


def test_what_it_writes_meanwhile(program: str, tmp_path: Path) -> None:
    with Program("one", program, ["for n in range(3): print(n, flush=True)"], tmp_path) as one:
        assert [json.loads(line) for line in one.lines(60.0)] == [0, 1, 2]
        with pytest.raises(InternalError, match="one ended early"):
            one.read_line(60.0)


def test_one_that_says_nothing_is_not_waited_for_forever(program: str, tmp_path: Path) -> None:
    words = ["import signal; print('begun', flush=True); signal.pause()"]
    with Program("one", program, words, tmp_path) as one:
        said = one.lines(60.0)
        assert next(said) == "begun"
        with pytest.raises(InternalError, match="one wrote nothing"):
            next(one.lines(0.01))


def test_it_ends_with_all_that_it_has_started(program: str, tmp_path: Path) -> None:
    """It starts a child, says its number, and both would wait forever."""
    code = (
        "import signal, subprocess\n"
        "child = subprocess.Popen([sys.executable, '-c', 'import signal; signal.pause()'])\n"
        "print(child.pid, flush=True); signal.pause()"
    )
    with Program("one", program, [code], tmp_path) as one:
        child = int(next(one.lines(60.0)))
        os.kill(child, 0)
    assert wait_ended(child)
    assert not one.running


def test_processor_time_of_a_process_and_of_its_children_that_ended(program: str, tmp_path: Path) -> None:
    burn = "import time\nwhile time.process_time() < 0.4: pass"
    code = (
        f"import subprocess; subprocess.run([sys.executable, '-c', {burn!r}])\n{burn}\n"
        "print('burnt', flush=True); import signal; signal.pause()"
    )
    with Program("one", program, [code], tmp_path) as one:
        assert next(one.lines(60.0)) == "burnt"
        assert 0.75 <= cpu_seconds([one.pid]) < 60.0
        assert cpu_seconds([one.pid, os.getpid()]) > cpu_seconds([one.pid])
    with pytest.raises((ProcessLookupError, FileNotFoundError)):
        cpu_seconds([2**22 + 1])
