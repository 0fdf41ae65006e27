# SPDX-License-Identifier: Apache-2.0
"""``shmmap-rolling run`` against real daemons: every voxel is right, from files and from a socket."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from shmmap_clients.rolling_map.live_map import all_voxels
from shmmap_clients.scans.scan_sequence import Scan, ScanSequence
from shmmap_clients.scans.scan_stream import ScanPublisher
from shmmap_clients.scans.trajectory import read_trajectory, tum_line

import shmmap
from tests.support.daemon_process import DaemonProcess, Deadline
from tests.support.forked_programs import run_verb
from tests.support.live_drive import FILTER, RESOLUTION, Voxel, drive
from tests.support.live_reference import LiveDaemon, held, reference, worker_of
from tests.support.pages import read_page, reader_with_programs

PROGRAM = [sys.executable, "-m", "shmmap_clients.rolling_map"]
LONG_S = 120.0
LIMITS = ["--min-range", "0.2", "--max-range", "9", "--min-z", "-5", "--max-z", "5"]
"""As `FILTER` has them."""
SVG = "{http://www.w3.org/2000/svg}"


def run(*words: str, code: int = 0) -> subprocess.CompletedProcess[str]:
    """Run the program, which is to end with this code."""
    done = run_verb(words, module=PROGRAM[-1])
    assert done.returncode == code, done.stderr
    return done


def write_drive(directory: Path, scans: int) -> list[str]:
    """Write a drive as files; returns the options that name them."""
    (directory / "scans").mkdir()
    lines = []
    for number, (points, pose) in enumerate(drive(scans)):
        np.savez(directory / "scans" / f"scan_{number}.npz", xyz=points.astype(np.float32))
        lines.append(tum_line(0.1 * number, pose))
    (directory / "poses.txt").write_text("\n".join(lines))
    return ["--scans", f"{directory}/scans", "--poses", f"{directory}/poses.txt"]


def read_drive(directory: Path) -> list[Scan]:
    """The same as it is read."""
    return list(ScanSequence(directory / "scans", read_trajectory(directory / "poses.txt")))


def expected(scans: Sequence[Scan], scan_filter: shmmap.live.ScanFilter = FILTER) -> dict[Voxel, int]:
    """What the map must have."""
    posed = [(scan.xyz, scan.T_map_sensor) for scan in scans if scan.T_map_sensor is not None]
    assert len(posed) == len(scans)
    return reference(posed, scan_filter)


def on_disk(one: DaemonProcess) -> dict[Voxel, int]:
    with shmmap.connect(one.endpoint) as client:
        return held(client.live("lidar"), "disk")


def scans_of(one: DaemonProcess) -> int:
    """How many scans the map has taken in."""
    with shmmap.connect(one.endpoint) as client:
        return client.live("lidar").status().scans


Words = Callable[..., list[str]]


@pytest.fixture
def words(tmp_path: Path) -> Words:
    """The command for a drive of ``scans`` scans into a daemon's map."""

    def make(one: DaemonProcess, *more: str, scans: int = 6) -> list[str]:
        directory = tmp_path / f"drive{scans}"
        directory.mkdir(exist_ok=True)
        files = ["--scans", f"{directory}/scans", "--poses", f"{directory}/poses.txt"]
        if not (directory / "scans").exists():
            write_drive(directory, scans)
        return ["run", "--live", "lidar", *files, *LIMITS, "--endpoint", one.endpoint, *more]

    return make


@pytest.mark.parametrize("ended", ["killed", "stopped"])
def test_a_run_goes_on_where_it_was(
    live_daemon: LiveDaemon, words: Words, tmp_path: Path, ended: str
) -> None:
    """The program ends in the middle, and the worker or the daemon after it; scans keep their numbers."""
    one = live_daemon()
    whole = words(one, "--json", scans=12)
    half = tmp_path / "half"
    (half / "scans").mkdir(parents=True)
    for path in sorted((tmp_path / "drive12" / "scans").iterdir()):
        if int(path.stem.removeprefix("scan_")) < 5:
            (half / "scans" / path.name).symlink_to(path)
    first = [word.replace("drive12/scans", "half/scans") for word in whole]
    run(*first, "--wait", "0")
    if ended == "killed":
        os.kill(worker_of(one), signal.SIGKILL)
        with shmmap.connect(one.endpoint, timeout=60.0) as client:  # on a busy machine it takes its time
            client.live("lidar")
    else:
        assert one.stop() == 0
        one.start()
    done = run(*whole, "--resume")
    assert "5 scans are in the map, 7 are left" in done.stderr
    said = json.loads(done.stdout)
    assert [said[name] for name in ("scans", "first_scan", "last_scan", "applied")] == [7, 6, 12, 12]
    assert on_disk(one) == expected(read_drive(tmp_path / "drive12"))
    again = run(*whole, "--resume")
    assert "12 scans are in the map, 0 are left" in again.stderr
    assert on_disk(one) == expected(read_drive(tmp_path / "drive12"))


def test_a_run_over_other_scans_is_not_resumed(live_daemon: LiveDaemon, words: Words) -> None:
    one = live_daemon()
    run(*words(one, scans=6))
    done = run(*words(one, "--resume", scans=3), code=2)
    assert "has 3 scans, but 6 of mapper shmmap-rolling are in the map" in done.stderr


def test_a_drive_from_files(live_daemon: LiveDaemon, words: Words, tmp_path: Path) -> None:
    one = live_daemon()
    done = run(*words(one, "--json"))
    scans = read_drive(tmp_path / "drive6")
    right = expected(scans)
    assert on_disk(one) == right
    document: dict[str, Any] = json.loads(done.stdout)
    assert document.pop("add_ms").keys() == {"p50", "p99", "max"}
    usage, chunks = document.pop("usage"), document.pop("chunks")
    counts = document.pop("counts")
    assert document == {
        "map": "lidar", "scans": 6, "points": 900,
        "first_scan": 1, "last_scan": 6, "applied": 6, "durable": 6,
    }  # fmt: skip
    ranges = np.linalg.norm(np.concatenate([scan.xyz for scan in scans]), axis=1)
    heights = np.concatenate([scan.xyz[:, 2] for scan in scans])
    assert counts["outside_z"] == int((np.abs(heights) > 5.0).sum()) > 0
    assert counts["far"] == int(((ranges >= 9.0) & (np.abs(heights) <= 5.0)).sum()) > 0
    assert sum(counts.values()) == 900
    assert usage.keys() == {"active", "bytes", "chunks", "waiting_bytes"}
    assert 0 < usage["active"] <= len(right)
    assert not chunks.keys() & {"dirty", "saving"}, "all of it is on the disk"
    assert sum(chunks.values()) >= len({(x >> 6, y >> 6, z >> 6) for x, y, z in right})
    pairs, *lines = done.stderr.splitlines()
    assert pairs.startswith("shmmap-rolling: 6 scans have poses")
    assert len(lines) == 6
    assert lines[0].startswith("scan_0: 150 points, ")
    assert " too low or high; " in lines[0]
    assert lines[0].partition(" voxels known, ")[2].endswith(" chunks") or "waiting" in lines[0]


def test_the_summary_in_words_and_numbers_that_rise(live_daemon: LiveDaemon, words: Words) -> None:
    one = live_daemon()
    run(*words(one, "--quiet", scans=3))
    done = run(*words(one, "--quiet", scans=3))
    assert (done.returncode, done.stderr) == (0, "")
    first, second = done.stdout.splitlines()
    assert first.startswith("3 scans, 450 points, ")
    assert " of them used; left out: " in first
    assert second.startswith("live map lidar: ")
    assert second.endswith(" clean") or " saved" in second
    assert json.loads(run(*words(one, "--json", "--quiet", scans=3)).stdout)["first_scan"] == 7
    assert scans_of(one) == 9


def test_options_count_before_the_parameter_file(
    live_daemon: LiveDaemon, words: Words, tmp_path: Path
) -> None:
    one = live_daemon()
    params = tmp_path / "p.yaml"
    params.write_text(
        "s_max_range: 30.0\ns_min_z: -1.0\nm_resolution: 0.2\nmap_frame: map\n"
        "sensor_frame: lidar\nc_chunk_dim: 32\n"
    )
    start = words(one, scans=3)
    for limit in LIMITS:
        start.remove(limit)
    done = run(*start, "--params", str(params), "--max-range", "6", "--max-z", "-0.5")
    scan_filter = shmmap.live.ScanFilter(max_range=6.0, min_z=-1.0, max_z=-0.5)
    assert on_disk(one) == expected(read_drive(tmp_path / "drive3"), scan_filter)
    lines = done.stderr.splitlines()
    assert [line for line in lines if "warning" in line] == lines[:1]
    assert "sensor_frame" in lines[0]
    assert "c_chunk_dim: 32" in lines[0]
    assert not any("active" in line for line in lines), "viz_usage is false where a file does not say"


def test_a_map_that_is_not_as_the_file_or_the_option_has_it_is_refused(
    live_daemon: LiveDaemon, words: Words, tmp_path: Path
) -> None:
    one = live_daemon()
    params = tmp_path / "p.yaml"
    for text, said in (
        ("\nm_resolution: 0.1", "p.yaml:2: m_resolution is 0.1, but the live map lidar has 0.2"),
        ("s_probability_hit: 0.8", "s_probability_hit is 0.8, but the live map lidar has 0.7"),
        ("m_occupancy_min_thresh: 0.2", "m_occupancy_min_thresh is 0.2, but the live map lidar has 0.12"),
    ):
        params.write_text(text)
        done = run(*words(one, "--params", str(params)), code=78)
        assert said in done.stderr
        assert "hint: `shmmap-rolling config`" in done.stderr
    params.write_text("map_frame: odom")
    for more in (["--params", str(params)], ["--frame", "odom"]):
        done = run(*words(one, *more), code=2)
        assert "live map lidar is in frame 'map', not 'odom'" in done.stderr
    done = run(*words(one)[:2], "radar", *words(one)[3:], code=2)
    assert "no live map 'radar'" in done.stderr
    start = words(one)
    poses = start.index("--poses")
    done = run(*start[:poses], *start[poses + 2 :], code=2)
    assert "scan scan_0 has no pose" in done.stderr
    assert "hint: give poses with --poses FILE" in done.stderr
    assert scans_of(one) == 0
    # the file has to be right even so
    run(*words(one, "--params", str(params), "--frame", "map"), code=78)
    params.write_text("s_max_range: 9.0")
    run(*words(one, "--params", str(params), "--frame", "map"))
    assert scans_of(one) == 6


def texts(picture: Path) -> str:
    root = ElementTree.parse(picture).getroot()
    return " ".join(element.text or "" for element in root.iter(f"{SVG}text"))


def test_the_picture_shows_what_is_chosen(live_daemon: LiveDaemon, words: Words, tmp_path: Path) -> None:
    one = live_daemon(checkpoint=3600.0)
    picture = tmp_path / "map.svg"
    for show, seen, unseen in (
        ([], ["height", "clean", "voxels known"], ["free"]),
        (["--show", "free"], ["free"], ["height", "clean", "voxels known"]),
        (["--show", "occupied,free,chunks,usage"], ["height", "free", "clean", "voxels known"], []),
        (["--show", "usage"], ["voxels known"], ["height", "free", "clean"]),
    ):
        run(*words(one, "--picture", str(picture), "--quiet", *show, scans=3))
        text = texts(picture)
        assert "live map lidar" in text
        assert "3 scans, voxels of 0.2 m, frame map" in text
        assert "sensor's path" in text
        assert all(word in text for word in seen)
        assert not any(word in text for word in unseen)
    # what is not waited for is not saved within an hour; the picture may come before it is applied
    waiting = Deadline()
    while waiting("dirty: newer than on disk" not in texts(picture)):
        run(*words(one, "--picture", str(picture), "--quiet", "--wait", "0", scans=3))


def test_more_voxels_than_a_list_may_have(live_daemon: LiveDaemon, words: Words, tmp_path: Path) -> None:
    """Of 4 MB of chunks a list may take one: 75 000 voxels.  The picture has them all."""
    one = live_daemon("--live-budget", "4M")
    picture = tmp_path / "map.svg"
    run(*words(one, "--quiet", "--picture", str(picture), "--show", "free,occupied", scans=60))
    assert "free" in texts(picture)
    right = expected(read_drive(tmp_path / "drive60"))
    with shmmap.connect(one.endpoint) as client:
        live = client.live("lidar")
        with pytest.raises(shmmap.errors.OverBudget):
            live.voxels("free", scope="all")
        for kind, sign in (("free", -1), ("occupied", 1)):
            found = np.floor(all_voxels(live, kind, "all") / RESOLUTION).astype(int).tolist()
            wanted = sorted([*voxel] for voxel, value in right.items() if value * sign > 0)
            assert sorted(found) == wanted


def test_scans_of_a_publisher_while_the_daemon_is_killed(
    live_daemon: LiveDaemon, words: Words, tmp_path: Path
) -> None:
    """The program goes on with the next daemon, and nothing is lost."""
    one = live_daemon(checkpoint=3600.0)
    words(one, scans=12)
    scans = read_drive(tmp_path / "drive12")
    source = f"ipc://{tmp_path}/scans.sock"
    command = [*PROGRAM, "run", "--live", "lidar", "--scans", source, *LIMITS, "--json", "--timeout", "3"]
    with (
        ScanPublisher(source) as publisher,
        subprocess.Popen(
            [*command, "--endpoint", one.endpoint], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        ) as process,
    ):
        try:
            assert process.stderr is not None
            assert publisher.wait_for_subscriber(LONG_S)
            assert process.stderr.readline() == f"waiting for scans from {source}\n"
            for number, scan in enumerate(scans):
                if number == 5:
                    waiting = Deadline()
                    while waiting(scans_of(one) < number):  # with more in flight it would wait for them
                        pass
                    one.kill()
                publisher.send(scan)
                line = process.stderr.readline()
                assert line.startswith(f"{scan.name}: 150 points, "), line
                assert ("the daemon does not answer" in line) == (number == 5)
                if number == 5:
                    one.start()
            publisher.send(None)
            out, err = process.communicate(timeout=LONG_S)
            assert process.returncode == 0, err
        finally:
            process.kill()
    document = json.loads(out)
    assert (document["scans"], document["applied"], document["durable"]) == (12, 12, 12)
    assert on_disk(one) == expected(scans)


@pytest.mark.root
def test_scans_that_did_not_get_to_the_disk_are_reported(
    live_daemon: LiveDaemon, words: Words, private_tmpfs: Callable[[str], str], tmp_path: Path
) -> None:
    disk = Path(private_tmpfs("4m"), "lidar")
    one = live_daemon("--live", f"lidar={disk}")
    start = words(one, "--json", "--quiet", scans=3)
    run(*start)
    filler = disk.parent / "filler"
    with filler.open("wb", buffering=0) as file, contextlib.suppress(OSError):
        while file.write(bytes(1 << 16)):
            pass
    done = run(*start, "--wait", "1.5", code=1)
    assert "scan 6 is not on the disk after 1.5 s, but scan 3" in done.stderr
    document = json.loads(done.stdout)
    assert (document["applied"], document["durable"]) == (6, 3)
    run(*start, "--wait", "0")
    filler.unlink()
    run(*start)
    assert on_disk(one) == expected(read_drive(tmp_path / "drive3") * 4)


def test_nothing_found_exits_1(live_daemon: LiveDaemon, words: Words, tmp_path: Path) -> None:
    one = live_daemon()
    near = ["--min-range", "80", "--max-range", "90", "--quiet"]
    done = run(*words(one, *near, scans=3), code=1)
    assert "no point of any scan counted: of 450 points " in done.stderr
    assert " too near" in done.stderr
    run(*words(one, *near, "--allow-empty", scans=3))
    assert on_disk(one) == {}
    source = f"ipc://{tmp_path}/none.sock"
    with (
        ScanPublisher(source) as publisher,
        subprocess.Popen(
            [*PROGRAM, "run", "--live", "lidar", "--scans", source, "--endpoint", one.endpoint, "--quiet"],
            stderr=subprocess.PIPE, text=True,
        ) as process,
    ):  # fmt: skip
        try:
            assert publisher.wait_for_subscriber(LONG_S)
            publisher.send(None)
            _, err = process.communicate(timeout=LONG_S)
        finally:
            process.kill()
    assert process.returncode == 1
    assert f"no scan came from {source}" in err


def test_the_page_s_commands(tmp_path: Path) -> None:
    """A live map alone, a drive into it, and settings from a parameter file of Rolling-Bonxai."""
    page = read_page("clients/README.md")
    (serve,), (map_it,), (config,) = map(page.commands, ("live", "rolling", "rolling-config"))
    write_drive(tmp_path, 6)
    (tmp_path / "rolling_map_params.yaml").write_text("m_resolution: 0.3\n", encoding="utf-8")
    with reader_with_programs(tmp_path) as reader, reader.terminal().serving(serve):
        user = reader.terminal()
        assert re.search(r"[1-9][\d,]* voxels known", user.run(map_it.replace("SCANS", "scans")))
        assert ElementTree.parse(tmp_path / "map.svg").getroot().tag == f"{SVG}svg"
        assert user.run(config).startswith("[live.lidar]\n")
