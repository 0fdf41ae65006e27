# SPDX-License-Identifier: Apache-2.0
"""What the demonstration shows: live on a terminal, lines in a pipe, and what was measured in the end."""

from __future__ import annotations

import io
from dataclasses import replace

import pytest
from rich.console import Console
from rich.live import Live

from shmmap.cli.screens.demo_progress import LiveProgress, PlainProgress
from shmmap.cli.screens.demo_report import print_report
from shmmap.demo.consumer import Pose
from shmmap.demo.demo import DemoResult, Round
from shmmap.demo.demo_town import DemoSettings, TownMap
from shmmap.demo.drive import DriveResult
from shmmap.demo.fleet import StepReport
from shmmap.demo.localization import LocalizationResult
from shmmap.demo.outage import OutageResult
from shmmap.demo.process_memory import ProcessMemory
from shmmap.demo.three_programs import ThreeProgramsResult
from shmmap.demo.watched_daemon import Traffic

MIB = 1 << 20
REPORT = StepReport("road at 1.23 m", 1e-4, 4e-3, 2, 9, 105, 7, 8, True, 0, 0.1)


def drive(consumers: int, own_mib: int, shm_mib: int) -> DriveResult:
    return DriveResult(
        consumers, consumers, 105, 6_900_000, 110 * MIB, 0.5, 40, 0.001, 0.078, 0.002, 0, 0.0, 1, 4.1, 0.6,
        ProcessMemory((own_mib + shm_mib) * MIB, shm_mib * MIB, 0), shm_mib * MIB,
    )  # fmt: skip


def result() -> DemoResult:
    pose = (Pose(0.0, 0.0, 0.0),)
    town = TownMap("map", 320, 20_800_000, 1, (), (0.0, 0.0, 1.0, 1.0), b"", pose, pose, 1.0)
    rounds = {
        1: Round(drive(1, 80, 140), drive(1, 115, 0)),
        8: Round(replace(drive(8, 220, 140), follow_max_s=0.002, cpu_s=6.0), drive(8, 920, 0)),
    }
    outage = OutageResult(8, 1.7, 17, (1_500_000,) * 8, 0.001, 0.104, 0.1, 0.3, 144, 143)
    found = LocalizationResult(41, 41, 0.0094, 0.0142, 0.008, 2.9, 117, 1.5, {})
    return DemoResult(DemoSettings(), town, rounds, outage, Traffic(1, 2, 3, 4), [], localization=found)


def told(out: str) -> dict[str, str]:
    """The lines below the table by name; all within a terminal's width, whatever reads them."""
    lines = out.splitlines()
    assert max(map(len, lines)) <= 79
    return {line[:10].strip(): line[10:] for line in lines[lines.index("", 1) + 1 :]}


def test_lines_with_what_was_measured(capsys: pytest.CaptureFixture[str]) -> None:
    print_report(result(), "/tmp/town.svg", 31.0)
    out = capsys.readouterr().out
    lines = told(out)
    names = "town memory one more waiting CPU kill -9 position duration"
    assert " ".join(lines) == names, "a line each"
    assert "20.8 million points" in lines["town"]
    assert lines["memory"] == "8 processes, a private copy each: 920 MiB; with shmmap: 360 MiB"
    # (920 - 115) / 7 and (360 - 220) / 7
    assert lines["one more"] == "each further process: 115 MiB with a copy, 20.0 MiB with shmmap"
    assert "up to 78.0 ms for new cells; shmmap: 2.0 ms" in lines["waiting"]
    assert lines["CPU"] == "8 copies: 4.1 s; shmmap: 6.0 s, 600.0 ms of it to start the daemon"
    assert lines["kill -9"] == "back in 1.7 s with 143 of 144 cells; no process paused over 104.0 ms"
    assert lines["position"] == "41 LiDAR scans: 0.9 cm off, 1.4 cm at most; first pose after 2.9 s"
    assert lines["duration"] == "31.0 s; picture: /tmp/town.svg"
    table = [line.split() for line in out.splitlines() if line.endswith(" ms") and line[0].isdigit()]
    assert [row[0] for row in table] == ["1", "1", "8", "8"]


def test_a_map_too_small_to_gain_from_sharing_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    sparse = result()
    print_report(sparse, "town.svg", 1.0)
    assert "--density" not in capsys.readouterr().out
    sparse.rounds[8] = Round(drive(8, 220, 10), drive(8, 170, 0))
    print_report(sparse, "town.svg", 1.0)
    out = capsys.readouterr().out
    assert "is too small to gain from sharing; --density 100" in " ".join(out.split())
    assert max(map(len, out.splitlines())) <= 79


def test_a_picture_s_long_path_is_in_one_piece(capsys: pytest.CaptureFixture[str]) -> None:
    path = "/" + "/".join(["directory"] * 9) + "/town.svg"
    print_report(result(), path, 31.0)
    assert capsys.readouterr().out.splitlines()[-1].strip() == path


def test_the_three_programs_have_a_line_each(capsys: pytest.CaptureFixture[str]) -> None:
    document = {
        "scans": 81,
        "programs": {"ndt": {"frames": 80}},
        "errors": {
            "ndt": {"mean_m": 0.012, "max_m": 0.018},
            "compare": {"moving_kept": 0.83, "still_kept": 0.001},
            "elevation": {"mean_m": None, "max_m": None, "places": 0},
        },
    }
    shown = result()
    shown.localization, shown.programs = None, ThreeProgramsResult(document, "<svg/>")
    print_report(shown, "town.svg", 100.0)
    lines = told(capsys.readouterr().out)
    assert lines["position"] == "80 of 81 LiDAR scans localized: 1.2 cm off on average, 1.8 cm at most"
    assert "83% of points on cars and people, 0.1% of others" in lines["moving"]
    assert "unknown" in lines["ground"]


def test_a_pipe_gets_a_line_for_each_stage_and_event(capsys: pytest.CaptureFixture[str]) -> None:
    progress = PlainProgress()
    progress.stage("Building a town", 2)
    progress.step()
    progress.event("The daemon starts again")
    assert capsys.readouterr().out.splitlines() == ["Building a town ...", "  The daemon starts again"]


def test_a_long_stage_says_in_a_pipe_how_far_it_is(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = iter([0.0, 4.0, 11.0, 12.0, 22.0])
    monkeypatch.setattr("time.monotonic", lambda: next(clock))
    progress = PlainProgress()
    progress.stage("Driving", 4)
    for _ in range(4):
        progress.step()
    assert capsys.readouterr().out.splitlines() == ["Driving ...", "  step 2 of 4"]


@pytest.mark.parametrize("width", [80, 120])
def test_a_terminal_shows_every_consumer_up_to_eight(width: int) -> None:
    out = io.StringIO()
    console = Console(file=out, width=width, height=40, force_terminal=True, color_system=None)
    with Live(console=console, auto_refresh=False) as live:
        progress = LiveProgress(live)
        progress.stage("Building a town", 1)
        progress.step()
        progress.stage("Driving", 3)
        before = len(out.getvalue())
        progress.step([replace(REPORT, counted=2_500_000)] * 16)
        drawn = out.getvalue()[before:]
        assert "done  Building a town" in drawn
        assert drawn.count("2.5 M points read") == drawn.count("road at 1.23 m") == 8
        assert "and 8 more" in drawn
        assert "1/3" in drawn
        progress.event("The daemon is killed (SIGKILL)")
        progress.step([REPORT] * 4)
        assert "The daemon is killed (SIGKILL)" in out.getvalue()[before + len(drawn) :]
        assert max(len(line.rstrip()) for line in drawn.splitlines() if "\x1b" not in line) <= width
