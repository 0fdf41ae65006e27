# SPDX-License-Identifier: Apache-2.0
"""What the programs' options take and refuse, before any work begins."""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from shmmap_clients.command_line import at_least, output_file, positive, write_text
from shmmap_clients.compare_map_filter.cli import main as compare
from shmmap_clients.elevation_map.cli import main as elevation
from shmmap_clients.ndt_scan_matcher.cli import main as ndt
from shmmap_clients.pose_initializer.cli import main as pose_init
from shmmap_clients.rolling_map.cli import main as rolling

from shmmap import read_cloud, write_pcd
from shmmap.errors import CannotWrite
from tests.support.forked_programs import run_verb


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
        with pytest.raises(CannotWrite, match=f"cannot write {tmp_path / name}: "):
            output_file(str(tmp_path / name))
        with pytest.raises(CannotWrite):
            write_text(tmp_path / name, "text")
    assert output_file("new.svg") == Path("new.svg"), "the working directory"


def test_a_mapper_is_named_as_other_programs_are(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The option is known: only the scans are missing."""
    words = ["run", "--live", "lidar", "--scans", str(tmp_path / "none"), "--name", "front"]
    assert rolling(words) != 2
    assert "unrecognized" not in capsys.readouterr().err


def test_an_output_that_cannot_be_written_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
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
        (pose_init, ["--scan", "s.pcd", "--pose", "0,0,0,0,0,0", "--height", "nan"]),
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


def test_a_scan_without_points_is_said_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scan, cloud = tmp_path / "none.bin", tmp_path / "map.bin"
    scan.touch()
    np.zeros((1, 4), np.float32).tofile(cloud)
    for program, verb in ((ndt, "align"), (compare, "apply")):
        words = [verb, "--map", str(cloud), "--scan", str(scan), "--backend", "numpy"]
        assert program(words) == 1
        assert "none.bin has no" in capsys.readouterr().err.replace("has none", "has no points")
        assert program([*words, "--allow-empty"]) == 0


def test_no_returns_are_left_out_and_counted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(0)
    ground = np.column_stack([rng.uniform(-20, 20, (20_000, 2)), np.zeros(20_000)]).astype(np.float32)
    seen = ground[:4000] - np.array([0, 0, 1.8], np.float32)
    near = np.array([[0, 0, 0]] * 60 + [[0.1, -0.2, 0.3]] * 7 + [[np.nan, 1, 1]] * 3, np.float32)
    new = np.array([[5, 5, 0.7]] * 11, np.float32)
    scan = np.concatenate([near[:30], seen, near[30:], new])
    np.savez(tmp_path / "map.npz", xyz=ground)
    np.savez(tmp_path / "scan.npz", xyz=scan, ring=np.arange(len(scan), dtype=np.uint32))
    np.column_stack([scan, np.arange(len(scan)) % 7]).astype("<f4").tofile(tmp_path / "scan.bin")
    write_pcd(tmp_path / "scan.pcd", {"xyz": scan})
    for suffix in ("npz", "bin", "pcd"):
        words = ["apply", "--map", f"{tmp_path}/map.npz", "--scan", f"{tmp_path}/scan.{suffix}"]
        words += ["--pose", "0,0,1.8,0,0,0", "--mode", "distance", "--backend", "numpy", "--json"]
        assert compare([*words, "--out", f"{tmp_path}/out"]) == 0
        found = json.loads(capsys.readouterr().out)
        assert {name: found[name] for name in ("points", "kept", "too_near", "not_finite")} == {
            "points": 4011,
            "kept": 11,
            "too_near": 67,
            "not_finite": 3,
        }
        index = read_cloud(tmp_path / "out" / "scan.pcd").columns["index"]
        assert index.tolist() == [*range(len(scan) - 11, len(scan))], "rows of the file"
        assert compare([*words, "--min-range", "0.3"]) == 0
        found = json.loads(capsys.readouterr().out)
        assert (found["kept"], found["too_near"], found["not_finite"]) == (18, 60, 3)
        assert compare([*words, "--min-range", "0"]) == 0
        found = json.loads(capsys.readouterr().out)
        assert (found["kept"], found["too_near"], found["not_finite"]) == (78, 0, 3)
        words = ["align", "--map", f"{tmp_path}/map.npz", "--scan", f"{tmp_path}/scan.{suffix}"]
        ndt([*words, "--backend", "numpy", "--json", "--thin", "0"])
        found = json.loads(capsys.readouterr().out)
        assert (found["points"], found["too_near"], found["not_finite"]) == (4011, 67, 3)
    words = ["apply", "--map", f"{tmp_path}/map.npz", "--scan", f"{tmp_path}/scan.pcd", "--backend", "numpy"]
    assert compare(words) == 0
    assert "left out: 67 points nearer than 0.5 m, 3 not finite" in capsys.readouterr().out


def test_bin_columns_are_named_or_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(0)
    xyz = rng.uniform(1, 20, (3000, 3))
    np.column_stack([xyz, rng.uniform(0, 1, 3000)]).tofile(tmp_path / "doubles.bin")
    words = ["apply", "--map", f"{tmp_path}/doubles.bin", "--scan", f"{tmp_path}/doubles.bin", "--json"]
    words += ["--backend", "numpy", "--allow-empty"]
    assert compare(words) == 0
    output = capsys.readouterr()
    assert json.loads(output.out)["points"] == 3000
    assert "rows of 4 float64, x y z intensity, by the look of its numbers; --bin-columns" in output.err
    assert compare([*words, "--bin-columns", "x:f8,y,z,_"]) == 0
    output = capsys.readouterr()
    assert json.loads(output.out)["points"] == 3000
    assert "--bin-columns" not in output.err
    assert compare([*words, "--bin-columns", "x,y,z,_"]) == 65
    assert "doubles.bin: read as rows of 4 float32" in capsys.readouterr().err
    with pytest.raises(SystemExit) as ended:
        compare([*words, "--bin-columns", "x,y"])
    assert ended.value.code == 2
    assert "x, y and z must be among them" in capsys.readouterr().err


def test_a_pipe_among_scans_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    os.mkfifo(tmp_path / "scan_1.bin")
    for suffix in ("bin", "npz", "pcd"):
        pipe = tmp_path / f"pipe.{suffix}"
        os.mkfifo(pipe)
        assert ndt(["align", "--map", str(pipe), "--scan", str(pipe), "--backend", "numpy"]) == 65
        assert f"pipe.{suffix}: " in capsys.readouterr().err


def test_names_that_are_no_text_are_printed_escaped(tmp_path: Path) -> None:
    """As arguments of a process: what is not UTF-8 comes as surrogates."""
    odd, missing, bad = f"{tmp_path}/scan_\udcff.npz", f"{tmp_path}/none_\udcff.npz", "\udcfe"
    with open(odd, "wb") as file:
        np.savez(file, xyz=np.random.default_rng(0).uniform(1, 9, (500, 3)))
    for program, words in (
        ("ndt_scan_matcher", ["align", "--scan", odd, "--map"]),
        ("compare_map_filter", ["apply", "--scan", odd, "--map"]),
        ("ndt_scan_matcher", ["follow", "--scans", str(tmp_path), "--truth"]),
        ("rolling_map", ["run", "--live", "lidar", "--scans", str(tmp_path), "--poses"]),
    ):
        for value in (missing, bad):
            done = run_verb([*words, value], module=f"shmmap_clients.{program}")
            assert done.returncode in (65, 66), done.stderr
            assert "Traceback" not in done.stderr
            assert "\\udcf" in done.stderr
    for program, verb in (("ndt_scan_matcher", "align"), ("compare_map_filter", "apply")):
        words = [verb, "--backend", "numpy", "--allow-empty", "--map", odd, "--scan", odd]
        done = run_verb(words, module=f"shmmap_clients.{program}")
        assert done.returncode in (0, 1), done.stderr
        assert "Traceback" not in done.stderr


PROGRAMS = {
    "ndt_scan_matcher": (ndt, ["align"], ["follow"], ["devices"]),
    "compare_map_filter": (compare, ["apply"], ["follow"]),
    "elevation_map": (elevation, ["build"]),
    "pose_initializer": (pose_init, []),
    "rolling_map": (rolling, ["run"]),
}


def help_of(program: object, words: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    assert callable(program)
    with contextlib.suppress(SystemExit):
        program([*words, "--help"])
    return capsys.readouterr().out


def options_of(text: str) -> dict[str, str]:
    """Each option of a help text with its value's name, and what is said of it."""
    found: dict[str, str] = {}
    for line in text.split("options:", 1)[1].splitlines():
        if line.startswith("  -"):
            name = line.split()[0].rstrip(",")
            found[name] = line.strip()
        elif line.startswith("     ") and found:
            found[name] += " " + line.strip()
        else:
            name = ""
            found.setdefault(name, "")
    return {name: " ".join(said.split()) for name, said in found.items() if name}


def test_the_same_option_is_the_same_everywhere(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    seen: dict[str, set[str]] = {}
    with_daemon = 0
    for main, *verbs in PROGRAMS.values():
        for words in verbs:
            assert isinstance(words, list)
            text = help_of(main, words, capsys)
            assert max(map(len, text.splitlines())) <= 80
            assert "Exit code: 0; 1 when" in text
            options = options_of(text)
            assert {"--json", "--allow-empty"} <= options.keys()
            addresses = {"--instance", "--endpoint", "--runtime-dir", "--shm-dir", "--timeout"}
            assert options.keys() & addresses in (set(), addresses)
            with_daemon += "--instance" in options
            for name, said in options.items():
                seen.setdefault(name, set()).add(said)
    assert with_daemon == 5
    # these differ in their defaults, or in what they are of
    own = {"--thin", "--height", "--update-distance", "--wait", "--out", "--mask", "--pose", "--picture"}
    own |= {"--backend", "--threads", "--min-range"}
    assert {name: said for name, said in seen.items() if len(said) > 1 and name not in own} == {}


@pytest.mark.parametrize("package", [*PROGRAMS])
def test_a_missing_package_is_one_clear_line(package: str, tmp_path: Path) -> None:
    """As in a client-only install."""
    scan = str(tmp_path / "scan.npz")
    np.savez(scan, xyz=np.zeros((9, 3), np.float32))
    words = {
        "ndt_scan_matcher": ["align", "--map", scan, "--scan", scan],
        "compare_map_filter": ["apply", "--map", scan, "--scan", scan],
        "elevation_map": ["build", "--cache", str(tmp_path)],
        "pose_initializer": ["--scan", scan, "--pose", "0,0,0,0,0,0"],
        "rolling_map": ["run", "--live", "lidar", "--scans", str(tmp_path)],
    }[package]
    code = (
        "import sys\nfor name in ('numba', 'xxhash', 'lzf', 'yaml', 'open3d'):\n"
        "    sys.modules[name] = None\n"
        f"from shmmap_clients.{package}.cli import main\nsys.exit(main(sys.argv[1:]))"
    )
    done = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True)
    assert done.returncode == 69, done.stderr
    lines = done.stderr.splitlines()
    assert len(lines) == 2, done.stderr
    assert re.match(r"shmmap-\S+: .*package (numba|xxhash).* not installed", lines[0])
    assert lines[1].startswith("hint: ")
    asked = subprocess.run([sys.executable, "-c", code, "--help"], capture_output=True, text=True)
    assert asked.returncode == 0, "the help needs no package"
    assert asked.stdout.startswith("usage: ")


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        ([], 2, "give --scans DIR, BAG or ENDPOINT, or --topic TOPIC"),
        (["--scans", ".", "--publish-tf"], 2, "--publish-tf and --ros-args are for --topic"),
        (["--scans", ".", "--ros-args", "-r", "a:=b"], 2, "--publish-tf and --ros-args are for --topic"),
        (["--topic", "/points", "--truth", "poses.txt"], 2, "--truth is for --scans"),
    ],
)
def test_scans_of_a_running_system(
    words: list[str], code: int, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert ndt(["follow", *words]) == code
    assert said in capsys.readouterr().err


@pytest.mark.skipif(importlib.util.find_spec("rclpy") is not None, reason="ROS 2 is here")
def test_a_running_system_without_ros(capsys: pytest.CaptureFixture[str]) -> None:
    assert ndt(["follow", "--topic", "/points"]) == 69
    error = capsys.readouterr().err
    assert "--topic without --scans needs " in error
    assert "source ROS 2 first" in error
