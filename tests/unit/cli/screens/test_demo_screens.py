# SPDX-License-Identifier: Apache-2.0
"""What the demonstrations show: live on a terminal, lines in a pipe, and what was measured in the end."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import pytest

from shmmap.cli import main
from shmmap.cli.screens.demo import DemoProgress, print_report, progress_for
from shmmap.demo.consumer import Pose
from shmmap.demo.demo import DemoResult, Round
from shmmap.demo.demo_town import TownMap
from shmmap.demo.drive import DriveResult, OutageResult
from shmmap.demo.localization import LocalizationResult

MIB = 1 << 20


def drive(consumers: int, own_mib: int, shm_mib: int) -> DriveResult:
    return DriveResult(
        consumers=consumers, processes=consumers, cells=105, points=6_900_000, map_bytes=110 * MIB,
        start_s=0.5, follow_max_s=0.078, cpu_s=4.1, daemon_start_cpu_s=0.6, process_bytes=own_mib * MIB,
        private_bytes=0, shm_bytes=shm_mib * MIB, total_bytes=(own_mib + shm_mib) * MIB,
    )  # fmt: skip


def result() -> DemoResult:
    pose = (Pose(0.0, 0.0, 0.0),)
    town = TownMap("map", 320, 20_800_000, 1, (), (0.0, 0.0, 1.0, 1.0), b"", b"", pose, pose, 1.0)
    rounds = [
        Round(1, drive(1, 80, 140), drive(1, 115, 0)),
        Round(8, replace(drive(8, 220, 140), follow_max_s=0.002, cpu_s=6.0), drive(8, 920, 0)),
    ]
    outage = OutageResult(1.7, 17, [1_500_000] * 8, 0.104, 144, 143)
    found = LocalizationResult(41, 41, 0.0094, 0.0142, 2.9)
    return DemoResult(110.0, town, rounds, [], outage, found, "")


def printed(capsys: pytest.CaptureFixture[str], result: DemoResult) -> tuple[list[str], dict[str, str]]:
    """Lines of the table, and the texts below it by name; all within a terminal's width."""
    print_report(result, "/tmp/town.svg", 31.0)
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 79
    table = lines[1 : lines.index("", 1)]
    found: dict[str, str] = {}
    name = ""
    for line in lines[len(table) + 2 :]:
        name = line[:10].strip() or name
        found[name] = f"{found.get(name, '')} {line[10:]}".strip()
    return table, found


def test_lines_with_what_was_measured(capsys: pytest.CaptureFixture[str]) -> None:
    table, lines = printed(capsys, result())
    assert lines == {
        "town": "320 cells, 20.8 million points; a process needs 105 cells, 110 MiB",
        # 80 + 140 + 20 (n - 1) < 115 + 115 (n - 1)
        "memory": "8 processes, a private copy each: 920 MiB; with shmmap: 360 MiB; less from 3 processes on",
        # (920 - 115) / 7 and (360 - 220) / 7
        "one more": "each further process: 115 MiB with a copy, 20.0 MiB with shmmap",
        "waiting": "a control loop waits up to 78.0 ms for new cells; shmmap: 2.0 ms",
        "CPU": "8 copies: 4.1 s; shmmap: 6.0 s, 600.0 ms of it to start the daemon",
        "kill -9": "back in 1.7 s with 143 of 144 cells; no process paused over 104.0 ms",
        "position": "41 LiDAR scans: 0.9 cm off, 1.4 cm at most; first pose after 2.9 s"
        " (kernels were compiled before)",
        "duration": "31.0 s; picture: /tmp/town.svg",
    }
    assert [line.split()[0] for line in table[1:]] == ["1", "1", "8", "8"]


def test_a_map_too_small_to_gain_from_sharing_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    sparse = result()
    assert "--density" not in printed(capsys, sparse)[1]["memory"]
    sparse.rounds[1] = Round(8, drive(8, 220, 10), drive(8, 170, 0))
    memory = printed(capsys, sparse)[1]["memory"]
    assert "is too small to gain from sharing; --density 100" in memory


def test_a_picture_s_long_path_is_in_one_piece(capsys: pytest.CaptureFixture[str]) -> None:
    path = "/" + "/".join(["directory"] * 9) + "/town.svg"
    print_report(result(), path, 31.0)
    assert capsys.readouterr().out.splitlines()[-1].strip() == path


def test_a_pipe_gets_a_line_for_each_stage_and_event(capsys: pytest.CaptureFixture[str]) -> None:
    progress = DemoProgress()
    progress.stage("Building a town", 2)
    progress.step()
    progress.event("The daemon starts again")
    assert capsys.readouterr().out.splitlines() == ["Building a town ...", "  The daemon starts again"]


def test_a_long_stage_says_in_a_pipe_how_far_it_is(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = iter([0.0, 4.0, 11.0, 12.0, 22.0])
    monkeypatch.setattr("time.monotonic", lambda: next(clock))
    progress = DemoProgress()
    progress.stage("Driving", 4)
    for _ in range(4):
        progress.step()
    assert capsys.readouterr().out.splitlines() == ["Driving ...", "  step 2 of 4"]


class Terminal(io.StringIO):
    """A terminal that keeps what is written."""

    def isatty(self) -> bool:
        return True


def test_a_terminal_shows_stages_events_and_the_last_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    out = Terminal()
    monkeypatch.setattr("sys.stdout", out)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "80")
    with progress_for(quiet=False) as progress:
        progress.stage("Building a town", 1)
        progress.step()
        progress.stage("Driving", 3)
        progress.step(*(f"consumer {number}: " + "road " * 30 for number in range(8)))
        drawn = out.getvalue()
        progress.event("The daemon is killed (SIGKILL)")
        progress.step("consumer 1")
    assert drawn.startswith("Building a town ...\n  step 1 of 1\n\x1b[1A\x1b[JDriving ...\n  step 1 of 3\n")
    lines = drawn.splitlines()[-8:]
    assert [line.split(":")[0] for line in lines] == [f"    consumer {number}" for number in range(8)]
    assert max(map(len, lines)) == 79
    assert out.getvalue()[len(drawn) :] == (
        "\x1b[9A\x1b[J  The daemon is killed (SIGKILL)\n  step 2 of 3\n    consumer 1\n\x1b[2A\x1b[J"
    )


@pytest.mark.parametrize(("trustworthy", "code"), [(41, 0), (40, 1)])
def test_a_scan_that_is_not_to_be_trusted_is_the_exit_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, trustworthy: int, code: int
) -> None:
    localized = LocalizationResult(41, trustworthy, 0.0094, 0.0142, 2.9)
    measured = replace(result(), localization=localized)
    monkeypatch.setattr("shmmap.demo.demo.run_demo", lambda *_, **_also: measured)
    picture = tmp_path / "town.svg"
    assert main(["demo", "--json", "--svg", str(picture)]) == code
    assert picture.exists()
