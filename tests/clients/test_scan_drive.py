# SPDX-License-Identifier: Apache-2.0
"""The scans that ``--scans`` names, through one step, and what is written and said of each."""

from __future__ import annotations

import argparse
import json
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from shmmap_clients.scan_drive import ScanDrive
from shmmap_clients.scans.scan_sequence import Scan
from shmmap_clients.scans.scan_stream import ScanPublisher
from shmmap_clients.scans.trajectory import matrix_of, tum_line

from shmmap import BadRequest
from shmmap.errors import CannotWrite


@pytest.fixture
def scans(tmp_path: Path) -> str:
    """A directory of twelve scans, each with one point more than the one before."""
    (tmp_path / "scans").mkdir()
    for number in range(12):
        np.savez(tmp_path / "scans" / f"s_{number}.npz", xyz=np.full((number + 1, 3), 9.0, np.float32))
    return str(tmp_path / "scans")


@pytest.fixture
def poses(tmp_path: Path) -> str:
    """Their poses, a metre apart."""
    lines = [tum_line(0.5 * number, matrix_of((number, 0, 0), (0, 0, 0, 1))) for number in range(12)]
    (tmp_path / "poses.txt").write_text("\n".join(lines))
    return str(tmp_path / "poses.txt")


def options(scans: str, **other: Any) -> argparse.Namespace:
    given = {"scans": scans, "quiet": False, "allow_empty": False, "json_lines": None, "bin_columns": None}
    bag = {"topic": None, "base_frame": "base_link"}
    return argparse.Namespace(**{**given, **bag, "min_range": 0.5, **other})


class Report:
    """Counts points."""

    def __init__(self) -> None:
        self.points = 0

    def add(self, points: int) -> None:
        self.points += points

    def line(self, points: int) -> str:
        return f"\x1b[1m{points} of {self.points}"


def size(scan: Scan) -> int:
    return len(scan.xyz)


def document(points: int) -> dict[str, Any]:
    return {"points": points}


def test_each_scan_is_written_and_said_in_order(
    scans: str, poses: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    seen: list[tuple[str, float, float]] = []

    def step(scan: Scan) -> int:
        seen.append((scan.name, scan.stamp_s, float(scan.pose[0, 3])))
        return size(scan)

    args, report = options(scans, json_lines=f"{tmp_path}/lines"), Report()
    with ExitStack() as stack:
        drive = ScanDrive(args, "program", poses, stack)
        for count in (1, 2):
            assert [scan.name for scan in drive.ahead(count)] == ["s_0", "s_1"][:count]
        assert seen == []
        drive.run(step, report, document)
    assert seen == [(f"s_{number}", 0.5 * number, number) for number in range(12)]
    assert report.points == 78
    lines = (tmp_path / "lines").read_text().splitlines()
    assert [json.loads(line)["points"] for line in lines] == list(range(1, 13))
    pairs, *said = capsys.readouterr().err.splitlines()
    assert pairs.startswith("program: 12 scans have poses by ")
    assert said[:3] == ["\\x1b[1m1 of 1", "\\x1b[1m2 of 3", "\\x1b[1m3 of 6"], "no terminal obeys it"


def test_progress_is_one_line_of_a_terminal(
    scans: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with ExitStack() as stack:
        ScanDrive(options(scans), "program", None, stack, one_line=True).run(size, Report(), max_scans=2)
    assert capsys.readouterr().err == "", "stderr is no terminal"
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    with ExitStack() as stack:
        drive = ScanDrive(options(scans), "program", None, stack, one_line=True)
        drive.run(size, Report(), max_scans=2)
        drive.say("something", "a hint")
        drive.say("something else")
    shown = "\r\\x1b[1m1 of 1\r\\x1b[1m2 of 3\n"
    assert capsys.readouterr().err == shown + "program: something\nhint: a hint\nprogram: something else\n"


def test_a_quiet_drive_does_not_even_make_its_lines(scans: str, capsys: pytest.CaptureFixture[str]) -> None:
    class Mute(Report):
        def line(self, points: int) -> str:
            raise AssertionError(points)

    with ExitStack() as stack:
        ScanDrive(options(scans, quiet=True), "program", None, stack).run(size, Mute())
    assert capsys.readouterr().err == ""


def test_the_scan_after_the_last_one_is_not_waited_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    endpoint = f"ipc://{tmp_path}/publisher"
    report = Report()
    with ExitStack() as stack, ScanPublisher(endpoint) as publisher:
        drive = ScanDrive(options(endpoint), "program", None, stack)
        assert publisher.wait_for_subscriber(30.0)
        for _ in range(2):
            publisher.send(Scan("one", 0.0, {"xyz": np.full((3, 3), 9.0, np.float32)}))
        drive.run(size, report, max_scans=2)  # there is no third
    assert report.points == 6
    assert capsys.readouterr().err.splitlines()[0] == f"waiting for scans from {endpoint}"


def test_no_scan_is_a_negative_answer(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    endpoint = f"ipc://{tmp_path}/publisher"
    with ExitStack() as stack:
        drive = ScanDrive(options(endpoint, quiet=True), "program", None, stack)
        with ScanPublisher(endpoint) as publisher:
            assert publisher.wait_for_subscriber(30.0)
            publisher.send(None)
            assert drive.ahead(1) == []
        drive.run(size, Report())
        assert drive.no_scans() == 1
    assert capsys.readouterr().err == f"program: no scan came from {endpoint}\n"


def test_what_cannot_be_done_ends_the_drive(scans: str, poses: str, tmp_path: Path) -> None:
    report = Report()
    with ExitStack() as stack, pytest.raises(BadRequest, match="scan s_0 has no pose"):
        ScanDrive(options(scans), "program", None, stack).run(lambda scan: len(scan.pose), report)
    with ExitStack() as stack, pytest.raises(CannotWrite, match="nowhere"):
        ScanDrive(options(scans, json_lines=f"{tmp_path}/nowhere/lines"), "program", None, stack)
    endpoint = f"ipc://{tmp_path}/publisher"
    with ExitStack() as stack, pytest.raises(BadRequest, match="those of a publisher bring their poses"):
        ScanDrive(options(endpoint), "program", poses, stack)
    full = options(scans, json_lines="/dev/full")
    with pytest.raises(CannotWrite, match="/dev/full"), ExitStack() as stack:
        ScanDrive(full, "program", None, stack).run(size, report, document)
    assert report.points == 1
