# SPDX-License-Identifier: Apache-2.0
"""What ``shmmap-rolling`` takes and refuses, and what it asks of a live map; with a map that only listens."""

from __future__ import annotations

import contextlib
import json
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray
from shmmap_clients.rolling_map.cli import main
from shmmap_clients.rolling_map.cli import run as run_module

from shmmap import Counts, NoAnswer, Occupancy, ScanFilter

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

SCANS = 3


class Row(NamedTuple):
    key: tuple[int, int, int]
    state: str


class Usage(NamedTuple):
    active: int = 12345
    bytes: int = 2_500_000
    chunks: int = 2
    waiting_bytes: int = 0


@dataclass
class ListeningMapper:
    """Counts scans; ``stuck``: nothing gets to the disk."""

    first: int = 41
    stuck: bool = False
    counts: Counts = field(default_factory=lambda: Counts(5, 3, 1, 1, 0))
    scans: list[tuple[NDArray[Any], NDArray[Any]]] = field(default_factory=list)
    applied: int = 0
    durable: int = 0

    def add(self, points: NDArray[Any], pose: NDArray[Any]) -> int:
        self.scans.append((points, pose))
        self.applied = self.first + len(self.scans) - 2
        return self.first + len(self.scans) - 1

    def wait_applied(self, timeout_s: float) -> None:
        assert timeout_s > 0
        self.applied = self.first + len(self.scans) - 1

    def wait_durable(self, timeout_s: float) -> None:
        if self.stuck:
            raise NoAnswer("nothing came")
        self.wait_applied(timeout_s)
        self.durable = self.applied


@dataclass
class ListeningMap:
    name: str = "lidar"
    resolution: float = 0.05
    frame_id: str = "map"
    occupancy: Occupancy = field(default_factory=Occupancy)
    made: ListeningMapper = field(default_factory=ListeningMapper)
    asked: list[Any] = field(default_factory=list)
    moves: list[tuple[float, float, float]] = field(default_factory=list)

    def live(self, name: str) -> ListeningMap:
        assert name == self.name
        return self

    def mapper(self, name: str, *, scan_filter: ScanFilter, frame_id: str) -> ListeningMapper:
        self.asked.append((name, scan_filter, frame_id))
        return self.made

    def move_to(self, x: float, y: float, z: float) -> None:
        self.moves.append((x, y, z))

    def chunks(self) -> list[Row]:
        return [Row((0, 0, 0), "dirty"), Row((1, 0, 0), "saved"), Row((2, 0, 0), "saved")]

    def occupied(self) -> NDArray[np.float64]:
        self.asked.append("occupied")
        return np.array([[0.025, 0.025, 0.025]])

    def free(self) -> NDArray[np.float64]:
        self.asked.append("free")
        return np.array([[1.025, 0.025, 0.025]])

    def usage(self) -> Usage:
        return Usage()


@pytest.fixture
def live(monkeypatch: pytest.MonkeyPatch) -> ListeningMap:
    made = ListeningMap()

    @contextlib.contextmanager
    def connected(args: Any, name: str) -> Iterator[ListeningMap]:
        yield made

    monkeypatch.setattr(run_module, "connect", connected)
    return made


@pytest.fixture
def words(tmp_path: Path) -> list[str]:
    """The command for a drive of three scans, a metre apart."""
    scans = tmp_path / "scans"
    scans.mkdir()
    lines = []
    for number in range(SCANS):
        xyz = np.random.default_rng(number).uniform(-4, 4, (10, 3)).astype(np.float32)
        np.savez(scans / f"scan_{number}.npz", xyz=xyz)
        lines.append(f"{number}.0 {number}.0 2.0 0.5 0 0 0 1")
    poses = tmp_path / "poses.txt"
    poses.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return ["run", "--live", "lidar", "--scans", str(scans), "--poses", str(poses)]


def test_every_scan_goes_into_the_map_at_its_pose(
    live: ListeningMap, words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*words, "--json"]) == 0
    assert live.asked == [("shmmap-rolling", ScanFilter(), "map")]
    assert live.moves == [(0.0, 2.0, 0.5), (1.0, 2.0, 0.5), (2.0, 2.0, 0.5)]
    for number, (points, pose) in enumerate(live.made.scans):
        wanted = np.random.default_rng(number).uniform(-4, 4, (10, 3)).astype(np.float32)
        assert np.array_equal(points, wanted)
        assert pose[:3, 3].tolist() == [number, 2.0, 0.5]
    said = capsys.readouterr()
    document = json.loads(said.out)
    assert document.pop("add_ms").keys() == {"p50", "p99", "max"}
    assert document == {
        "map": "lidar", "scans": 3, "points": 30,
        "counts": {"near": 15, "far": 9, "too_near": 3, "outside_z": 3, "not_finite": 0},
        "first_scan": 41, "last_scan": 43, "applied": 43, "durable": 43,
        "usage": {"active": 12345, "bytes": 2_500_000, "chunks": 2, "waiting_bytes": 0},
        "chunks": {"dirty": 1, "saved": 2},
    }  # fmt: skip
    lines = said.err.splitlines()
    assert len(lines) == SCANS
    assert lines[0].startswith("scan_0: 10 points, 5 in range, 3 beyond, 1 too near, 1 too low or high; ")
    assert lines[0].endswith("; 12 345 active cells, 2.5 MB, 2 chunks")


def test_the_summary_in_words(
    live: ListeningMap, words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*words, "--quiet"]) == 0
    said = capsys.readouterr()
    assert said.err == ""
    first, second = said.out.splitlines()
    assert first.startswith("3 scans, 30 points, 24 count; left out: 3 too near, 3 too low or high; ")
    assert second == "live map lidar: 12 345 active cells, 2.5 MB, 2 chunks; 2 saved, 1 dirty"


def test_options_count_before_the_parameter_file(
    live: ListeningMap, words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    params = tmp_path / "p.yaml"
    params.write_text(
        "s_max_range: 30.0\ns_min_z: -1.0\nmap_frame: map\nsensor_frame: lidar\nc_chunk_dim: 32\n"
    )
    command = [*words, "--params", str(params), "--max-range", "20", "--max-z", "-0.5"]
    assert main([*command, "--mapper", "front"]) == 0
    assert live.asked == [("front", ScanFilter(max_range=20.0, min_z=-1.0, max_z=-0.5), "map")]
    lines = capsys.readouterr().err.splitlines()
    assert [line for line in lines if "warning" in line] == lines[:1]
    assert "sensor_frame" in lines[0]
    assert "c_chunk_dim: 32" in lines[0]
    assert not any("active" in line for line in lines), "viz_usage is false where a file does not say"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("\nm_resolution: 0.1", "p.yaml:2: m_resolution is 0.1, but the live map lidar has 0.05"),
        ("map_frame: odom", "map_frame is odom, but the live map lidar has map"),
        ("s_probability_hit: 0.8", "s_probability_hit is 0.8, but the live map lidar has 0.7"),
        ("m_occupancy_min_thresh: 0.2", "m_occupancy_min_thresh is 0.2, but the live map lidar has 0.12"),
    ],
)
def test_a_map_that_is_not_as_the_file_has_it_is_refused(
    live: ListeningMap,
    words: list[str],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    text: str,
    said: str,
) -> None:
    params = tmp_path / "p.yaml"
    params.write_text(text)
    assert main([*words, "--params", str(params)]) == 78
    err = capsys.readouterr().err
    assert said in err
    assert "hint: `shmmap-rolling config`" in err
    assert not live.asked
    params.write_text("s_max_range: 9.0")
    live.resolution = 0.2
    assert main([*words, "--params", str(params)]) == 0, "the file does not say"


def test_the_frame_is_passed_on(live: ListeningMap, words: list[str]) -> None:
    live.frame_id = "odom"
    assert main(words) == 0
    assert main([*words, "--frame", "map"]) == 0
    assert [frame for _, _, frame in live.asked] == ["odom", "map"], "the daemon refuses another than its own"


@pytest.mark.parametrize(
    ("show", "asked", "seen", "unseen"),
    [
        ([], ["occupied"], ["height", "dirty", "active cells"], ["free"]),
        (["--show", "free"], ["free"], ["free"], ["height", "dirty", "active cells"]),
        (
            ["--show", "occupied,free,chunks,usage"],
            ["occupied", "free"],
            ["height", "free", "dirty", "active"],
            [],
        ),
        (["--show", "usage"], [], ["active cells"], ["height", "free", "dirty"]),
    ],
)
def test_the_picture_shows_what_is_chosen(
    live: ListeningMap, words: list[str], tmp_path: Path, show: list[str], asked: list[str], seen: list[str],
    unseen: list[str],
) -> None:  # fmt: skip
    picture = tmp_path / "map.svg"
    assert main([*words, "--picture", str(picture), *show]) == 0
    assert live.asked[1:] == asked
    root = ElementTree.parse(picture).getroot()
    text = " ".join(element.text or "" for element in root.iter("{http://www.w3.org/2000/svg}text"))
    assert "live map lidar" in text
    assert "3 scans, voxels of 0.05 m, frame map" in text
    assert "sensor's path" in text
    assert all(word in text for word in seen)
    assert not any(word in text for word in unseen)


def test_what_did_not_get_to_the_disk_is_told(
    live: ListeningMap, words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    live.made.stuck = True
    assert main([*words, "--wait", "0.5"]) == 1
    assert "scan 43 is not on the disk after 0.5 s" in capsys.readouterr().err
    assert main([*words, "--wait", "0"]) == 0


def test_nothing_found_exits_1(
    live: ListeningMap, words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    live.made.counts = Counts(0, 0, 10, 0, 0)
    assert main(words) == 1
    assert "no point of any scan counted: of 30 points 30 too near" in capsys.readouterr().err
    assert main([*words, "--allow-empty"]) == 0


def test_scans_without_poses_are_refused(
    live: ListeningMap, words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(words[:-2]) == 2
    said = capsys.readouterr().err
    assert "scan scan_0 has no pose" in said
    assert "hint: give poses with --poses FILE" in said
    assert not live.made.scans


@pytest.mark.parametrize(
    ("more", "code", "said"),
    [
        (["--max-range", "0.3"], 2, "--max-range 0.3: need more than --min-range 0.5"),
        (["--min-z", "2"], 2, "--max-z 2.0: need more than --min-z 2.0"),
        (["--params", "nowhere.yaml"], 66, "there is no file nowhere.yaml"),
        (["--picture", "nowhere/map.svg"], 73, "cannot write nowhere/map.svg"),
        (["--poses", "nowhere.txt"], 66, "nowhere.txt"),
    ],
)
def test_refused_before_any_daemon_is_asked(
    words: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, more: list[str],
    code: int, said: str,
) -> None:  # fmt: skip
    monkeypatch.setattr(run_module, "connect", None)
    assert main([*words, *more]) == code
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
