# SPDX-License-Identifier: Apache-2.0
"""What ``shmmap-rolling`` takes and refuses before it asks a daemon; the rest is in ``tests/process``."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from shmmap_clients.rolling_map.cli import main

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib


@pytest.fixture
def words(tmp_path: Path) -> list[str]:
    """The command for a drive of one scan."""
    scans = tmp_path / "scans"
    scans.mkdir()
    (scans / "scan_0.npz").touch()
    poses = tmp_path / "poses.txt"
    poses.write_text("0.0 0.0 2.0 0.5 0 0 0 1\n", encoding="utf-8")
    files = ["--scans", str(scans), "--poses", str(poses)]
    return ["run", "--live", "lidar", *files, "--endpoint", str(tmp_path / "none.sock")]


@pytest.mark.parametrize(
    ("more", "code", "said"),
    [
        (["--max-range", "0.3"], 2, "--max-range 0.3: need more than --min-range 0.5"),
        (["--min-z", "2"], 2, "--max-z 2.0: need more than --min-z 2.0"),
        (["--params", "nowhere.yaml"], 66, "there is no file nowhere.yaml"),
        (["--picture", "nowhere/map.svg"], 73, "cannot write nowhere/map.svg"),
        (["--poses", "nowhere.txt"], 66, "nowhere.txt"),
        (["--scans", "tcp://127.0.0.1:9", "--resume"], 2, "--resume is for a directory"),
    ],
)
def test_refused_before_any_daemon_is_asked(
    words: list[str], capsys: pytest.CaptureFixture[str], more: list[str], code: int, said: str
) -> None:
    assert main([*words, *more]) == code, "69: there is no daemon"
    assert said in capsys.readouterr().err


@pytest.mark.parametrize(
    "more",
    [
        ["--max-range", "0"],
        ["--min-range", "-1"],
        ["--min-z", "nan"],
        ["--max-z", "inf"],
        ["--show", "everything"],
        ["--show", ""],
        ["--wait", "-1"],
    ],
)
def test_impossible_values_exit_2(
    words: list[str], capsys: pytest.CaptureFixture[str], more: list[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main([*words, *more])
    assert ended.value.code == 2
    assert f"argument {more[0]}: expected " in capsys.readouterr().err


def test_config_prints_or_writes_the_section(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    params = tmp_path / "p.yaml"
    params.write_text("m_resolution: 0.1\nrobot_frame: base\nc_chunk_folder_path: /maps\n")
    assert main(["config", str(params), "--name", "lidar"]) == 0
    said = capsys.readouterr()
    section = tomllib.loads(said.out)["live"]["lidar"]
    assert (section["resolution"], section["path"]) == (0.1, "/maps")
    assert said.err.startswith(f"shmmap-rolling: warning: {params}: no effect here: robot_frame")
    assert said.err.count("\n") == 1
    out = tmp_path / "live.toml"
    assert main(["config", str(params), "--name", "l", "--path", "/else", "--out", str(out)]) == 0
    assert capsys.readouterr().out == ""
    assert tomllib.loads(out.read_text())["live"]["l"]["path"] == "/else"


def test_config_refuses_with_the_file_and_the_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    params = tmp_path / "p.yaml"
    params.write_text("m_resolution: 0.1\ns_max_rage: 3\n")
    assert main(["config", str(params), "--name", "lidar"]) == 78
    said = capsys.readouterr()
    assert said.out == ""
    assert f"{params}:2: Rolling-Bonxai has no parameter s_max_rage" in said.err
    assert "hint: the nearest is s_max_range" in said.err
    params.write_text("m_resolution: 0.1\n")
    assert main(["config", str(params), "--name", "a.b"]) == 2
