# SPDX-License-Identifier: Apache-2.0
"""What the programs' options take and refuse, before any work begins."""

from __future__ import annotations

import argparse
from pathlib import Path

import pytest
from shmmap_clients.command_line import at_least, output_file, write_text
from shmmap_clients.elevation_map.cli import main as elevation
from shmmap_clients.ndt_scan_matcher.cli import main as ndt
from shmmap_clients.pose_initializer.cli import main as pose_init
from shmmap_clients.shared_options import positive

from shmmap import CannotWrite


def test_numbers_that_make_no_sense_are_refused() -> None:
    assert at_least(1)("7") == 7
    for text in ("0", "-3", "x", "1.5", "", "9" * 30):
        with pytest.raises(argparse.ArgumentTypeError, match="1 or more"):
            at_least(1)(text)
    assert positive("0.5") == 0.5
    for text in ("0", "-1", "nan", "inf", "x"):
        with pytest.raises(argparse.ArgumentTypeError, match="positive"):
            positive(text)


def test_a_file_that_cannot_be_written_is_refused_at_once(tmp_path: Path) -> None:
    assert output_file(str(tmp_path / "new.svg")) == tmp_path / "new.svg"
    assert not (tmp_path / "new.svg").exists()
    (tmp_path / "old.svg").write_text("old")
    assert output_file(str(tmp_path / "old.svg")) == tmp_path / "old.svg"
    for name in ("nowhere/new.svg", "old.svg/new.svg", "."):
        with pytest.raises(CannotWrite, match=str(tmp_path)):
            output_file(str(tmp_path / name))
        with pytest.raises(CannotWrite):
            write_text(tmp_path / name, "text")
    assert output_file("new.svg") == Path("new.svg"), "the working directory"


def test_programs_tell_it_without_a_traceback(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    nowhere = str(tmp_path / "nowhere" / "out")
    assert ndt(["follow", "--scans", str(tmp_path), "--plot", f"{nowhere}.svg"]) == 73
    assert ndt(["follow", "--scans", str(tmp_path), "--tum", nowhere]) == 73
    assert elevation(["build", "--out", f"{nowhere}.npz"]) == 73
    assert elevation(["build", "--hillshade", f"{nowhere}.png"]) == 73
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 4
    assert all("No such file or directory" in line for line in said)


@pytest.mark.parametrize(
    ("program", "words"),
    [
        (ndt, ["follow", "--scans", ".", "--frames", "0"]),
        (ndt, ["follow", "--scans", ".", "--rate", "-1"]),
        (ndt, ["follow", "--scans", ".", "--odometry-wait", "nan"]),
        (elevation, ["build", "--wait", "-1"]),
        (elevation, ["build", "--epsg", "-3"]),
        (pose_init, ["--scan", "s.pcd", "--pose", "0,0,0,0,0,0", "--seed", "-1"]),
    ],
)
def test_impossible_numbers_exit_2(
    program: object, words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert callable(program)
    with pytest.raises(SystemExit) as ended:
        program(words)
    assert ended.value.code == 2
    assert f"argument {words[-2]}: expected " in capsys.readouterr().err
