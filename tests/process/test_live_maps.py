# SPDX-License-Identifier: Apache-2.0
"""Live maps from end to end: mappers write, readers read, processes die, and nothing is lost."""

from __future__ import annotations

import json
import os
import re
import signal
import threading
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

import shmmap
from shmmap.chunks.marks import encode_marks
from shmmap.chunks.voxels import ChunkKey
from shmmap.client.live.live_map import Sphere
from shmmap.client.live.mapper import MAX_UNANSWERED
from shmmap.errors import BadRequest, Busy, ConfigError, LiveInterrupted, NoAnswer
from shmmap.failpoints import LIVE_STEPS
from shmmap.protocol import live as messages
from shmmap.statistics.reader import StatisticsReader
from tests.process.conftest import DaemonFactory
from tests.support.command_line import Shmmap
from tests.support.daemon_process import Deadline
from tests.support.forked_programs import run_verb
from tests.support.live_drive import FILTER, RESOLUTION, drive, marked, walk
from tests.support.live_reference import LiveDaemon, held, map_scans, mapped_around, reference, worker_of


def test_a_drive_is_mapped_as_the_slow_reference_says(live_daemon: LiveDaemon) -> None:
    """Voxel for voxel, in memory and on disk, by list, by point, and by ray."""
    expected = reference(drive())
    one = live_daemon()
    with shmmap.connect(one.endpoint) as client:
        live = client.live("lidar")
        assert (live.resolution, live.frame_id) == (RESOLUTION, "map")
        with live.mapper("front", FILTER) as mapper:
            numbers = [mapper.add(points, pose) for points, pose in drive()]
            assert numbers == list(range(1, len(numbers) + 1))
            assert mapper.wait_applied() == numbers[-1] == mapper.applied
            assert held(live) == expected
            assert mapper.wait_durable() == numbers[-1] == mapper.durable
        assert held(live, "disk") == expected
        status = live.status()
        assert (status.scans, status.durable, status.dirty) == (len(numbers), len(numbers), 0)
        assert status.mappers == (f"{os.getuid()}/front",)

        origin = np.array(drive()[-1][1][:3, 3])
        live.move_to(*origin)
        here = ChunkKey(*np.floor(origin / (64 * RESOLUTION)).astype(int).tolist())
        waiting = Deadline()
        while waiting(len(mapped_around(live, here)) < 27):
            pass
        near = np.array(
            [voxel for voxel in expected if np.abs(np.array(voxel) - origin / RESOLUTION).max() < 60]
        )
        assert live.log_odds((near + 0.5) * RESOLUTION).tolist() == [
            expected[x, y, z] for x, y, z in near.tolist()
        ]
        assert live.log_odds([[5000.0, 0.0, 0.0]]).tolist() == [0]

        ends = origin + np.random.default_rng(3).uniform(-8.0, 8.0, (200, 3))
        for end, distance in zip(ends, live.first_hits(origin, ends), strict=True):
            first, last = (tuple(np.floor(p * (1 / RESOLUTION)).astype(int).tolist()) for p in (origin, end))
            path = [*walk(first, last), last]
            hit = next((voxel for voxel in path if expected.get(voxel, 0) > 0), None)
            if hit is None:
                assert distance == np.inf
            else:
                assert distance == pytest.approx(np.linalg.norm((np.array(hit) + 0.5) * RESOLUTION - origin))
    one.stop()
    assert not [name for name in os.listdir(one.shm_dir) if "live" in name]
    one.start()
    with shmmap.connect(one.endpoint) as client:
        live = client.live("lidar")
        assert held(live, "disk") == expected
        with live.mapper("front") as mapper:
            assert mapper.add(np.zeros((0, 3)), np.eye(4)) > len(numbers)  # never a number again


@pytest.mark.slow
@pytest.mark.parametrize("killed", [1, 2], ids=["starting", "none"])
def test_a_worker_killed_just_before_the_end_leaves_nothing_behind(
    live_daemon: LiveDaemon, killed: int
) -> None:
    """The next one saves what it left in memory; after the second kill that one would start later."""
    one = live_daemon(checkpoint=600.0)
    with shmmap.connect(one.endpoint, timeout=60.0) as client:
        live = client.live("lidar")
        map_scans(live, drive(3))
        expected = held(live)
    for _ in range(killed - 1):
        os.kill(worker_of(one), signal.SIGKILL)
        with shmmap.connect(one.endpoint, timeout=60.0) as client:
            client.live("lidar")
    os.kill(worker_of(one), signal.SIGKILL)
    assert one.stop() == 0
    assert not [name for name in os.listdir(one.shm_dir) if "live" in name]
    one.start()
    with shmmap.connect(one.endpoint, timeout=60.0) as client:
        assert held(client.live("lidar"), "disk") == expected


def test_voxels_of_an_area_and_since_a_change(live_daemon: LiveDaemon) -> None:
    expected = reference(drive(1))
    one = live_daemon()
    with shmmap.connect(one.endpoint) as client:
        live = client.live("lidar")
        with live.mapper("front", FILTER) as mapper:
            mapper.add(*drive()[0])
            mapper.wait_applied()
            sphere = Sphere(1.0, 1.0, 0.0, 3.0)
            found = live.voxels("free", sphere)
            free = np.array([voxel for voxel, value in expected.items() if value < 0])
            inside = np.linalg.norm((free + 0.5) * RESOLUTION - [1.0, 1.0, 0.0], axis=1) <= 3.0
            assert sorted(found.indices.tolist()) == sorted(free[inside].tolist())
            assert (found.probability < 0.5).all()
            box = shmmap.Box(-2.0, -2.0, 2.0, 2.0, (-1.0, 1.0))
            occupied = live.occupied(box)
            assert (np.abs(occupied) <= [2.0, 2.0, 1.0]).all()
            assert len(occupied)
            everything = live.voxels("occupied")
            assert not len(live.voxels("occupied", since=everything.change))
            mapper.add(*drive()[0])
            mapper.wait_applied()
            assert len(live.voxels("occupied", since=everything.change)) == len(everything)
        names = [name for name in os.listdir(one.shm_dir) if ".voxels." in name]
        assert not names  # each was opened


TIMES = {"live.map": 3, "live.renamed": 1, "live.flushed": 1}
"""How often a step is taken until the worker is killed in it; the others often."""


@pytest.mark.slow
@pytest.mark.parametrize("label", LIVE_STEPS)
def test_a_worker_killed_at_any_step_loses_nothing(
    live_daemon: LiveDaemon, tmp_path: Path, label: str
) -> None:
    """The mapper notices nothing but a pause: what was not answered it sends again, and it counts once.

    The map takes twice the memory that there is: chunks come and go all the time.
    """
    scans = drive()
    one = live_daemon("--live-budget", "4M", start=False)
    one.environment["SHMMAP_TEST_CRASH"] = f"{label}:{TIMES.get(label, 5)}:{tmp_path}/reached"
    one.start()
    with shmmap.connect(one.endpoint) as client:
        live = client.live("lidar")
        with live.mapper("front", FILTER) as mapper:
            for points, pose in scans:
                mapper.add(points, pose)
            mapper.wait_applied()
            mapper.wait_durable()
        assert held(live) == held(live, "disk") == reference(scans)
        assert "saved" in {chunk.state for chunk in live.chunks(saved=True)}, "some were given up"
        assert live.status().bytes <= 4 << 20
    assert (tmp_path / "reached").exists(), "the step was never reached"


def test_a_daemon_killed_repeatedly_loses_nothing(live_daemon: LiveDaemon) -> None:
    """Its worker dies with it; chunks in memory are found by the next, and the mapper goes on."""
    scans = drive(12)
    one = live_daemon(checkpoint=60.0)  # memory alone has what was applied
    with shmmap.connect(one.endpoint) as client:
        live = client.live("lidar")
        with live.mapper("front", FILTER) as mapper:
            for number, (points, pose) in enumerate(scans):
                mapper.add(points, pose)
                if number % 4 == 2:
                    one.kill()
                    one.start()
            mapper.wait_applied()
            live = client.live("lidar")
            assert held(live) == reference(scans)


def test_a_killed_mapper_goes_on_with_unused_numbers(live_daemon: LiveDaemon) -> None:
    one = live_daemon()
    scans = drive(4)
    with shmmap.connect(one.endpoint) as client:
        live = client.live("lidar")
        first = live.mapper("front", FILTER)
        first.add(*scans[0])
        first.wait_applied()
        second = live.mapper("front", FILTER)  # as after a restart of the program; the first is a ghost
        number = second.add(*scans[1])
        assert number == 2
        second.wait_applied()
        first.add(*scans[2])
        with pytest.raises(BadRequest, match="another program maps as 'front'"):
            first.wait_applied()
        first.close()
        second.close()
        assert held(live) == reference(scans[:2])


def test_mappers_side_by_side(live_daemon: LiveDaemon) -> None:
    """Each its own scans, into the same chunks or not; one sends no two into one voxel beyond the clamps."""
    scans = drive(6)
    far = [(points, pose + np.array([[0, 0, 0, 1e4]] + [[0.0] * 4] * 3)) for points, pose in scans]
    one = live_daemon()

    def work(name: str, mine: list[tuple[np.ndarray, np.ndarray]]) -> None:
        with shmmap.connect(one.endpoint) as client:
            map_scans(client.live("lidar"), mine, name)

    threads = [
        threading.Thread(target=work, args=("near", scans)), threading.Thread(target=work, args=("far", far))
    ]  # fmt: skip
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    with shmmap.connect(one.endpoint) as client:
        live = client.live("lidar")
        assert held(live) == reference([*scans, *far])
        assert live.status().scans == 12


def test_what_is_no_marks_is_refused_and_costs_only_its_sender(
    live_daemon: LiveDaemon, tmp_path: Path
) -> None:
    one = live_daemon()
    with shmmap.connect(one.endpoint) as client, shmmap.connect(one.endpoint) as other:
        live = client.live("lidar")
        session = client.session
        opened = session.ask(lambda n: messages.LiveOpen(n, "lidar", "bad"), messages.LiveOpened)
        directory, mine = Path(opened.marks_dir), f"{client.welcome.session:x}"
        good = encode_marks(marked(1)[0], opened.map_id, opened.mapper, 1)

        def send(name: str, nbytes: int, scan: int = 1) -> messages.LiveApplied:
            return session.ask(
                lambda n: messages.LiveScan(n, "lidar", opened.mapper, scan, name, nbytes, (0.0, 0.0, 0.0)),
                messages.LiveApplied,
            )

        (directory / f"{mine}.3").write_bytes(good[:-1])
        (directory / f"{mine}.4").write_bytes(bytes(len(good)))
        (directory / f"{other.welcome.session:x}.6").write_bytes(good)
        for name, nbytes, said in (
            (f"{mine}.3", len(good), "has .* bytes, not"),
            (f"{mine}.4", len(good), "something else"),
            (f"{other.welcome.session:x}.6", len(good), "not a name that this session may use"),
            ("../shmmap.toml", 10, "not a name"),
            (f"{mine}.4", 1 << 40, "are the most"),
        ):
            with pytest.raises(BadRequest, match=said):
                send(name, nbytes)
        (directory / f"{mine}.8").write_bytes(good)
        with pytest.raises(BadRequest, match="not scan 2"):
            send(f"{mine}.8", len(good), scan=2)
        (directory / f"{mine}.8").write_bytes(good)  # what was taken is removed
        assert send(f"{mine}.8", len(good)).scan == 1
        assert held(live) == reference(drive(1))
    with shmmap.connect(one.endpoint) as client:  # their files are gone with their sessions
        waiting = Deadline()
        while waiting(any(name.startswith(mine) for name in os.listdir(directory))):
            client.live("lidar")


def test_a_map_made_with_other_settings_is_refused_at_the_start(live_daemon: LiveDaemon) -> None:
    live_daemon().stop()
    other = live_daemon(resolution=0.5, start=False)
    assert other.run_to_end() == ConfigError.exit_code
    assert "resolution = 0.5: the map was made with 0.2" in other.log


def test_a_daemon_without_live_maps_says_so(daemon: DaemonFactory, divided_map: object) -> None:
    one = daemon(divided_map.root)  # type: ignore[attr-defined]
    with shmmap.connect(one.endpoint) as client, pytest.raises(BadRequest, match="keeps no live maps"):
        client.live("lidar")


def test_requests_that_wait_when_the_worker_dies_are_refused(live_daemon: LiveDaemon) -> None:
    one = live_daemon()
    with shmmap.connect(one.endpoint) as client:
        client.live("lidar")
        worker = worker_of(one)
        os.kill(worker, signal.SIGSTOP)
        asked = threading.Event()
        refused: list[Exception] = []

        def ask() -> None:
            asked.set()
            try:
                client.session.ask(lambda n: messages.LiveOpen(n, "lidar"), messages.LiveOpened, quiet_s=60.0)
            except LiveInterrupted as error:
                refused.append(error)

        thread = threading.Thread(target=ask)
        thread.start()
        asked.wait()
        with shmmap.connect(one.endpoint) as second:
            waiting = Deadline()
            while waiting(len([row for row in second.stats().sessions if row.requests > 1]) < 1):
                pass
            assert second.metadata() is not None  # no other client waits for the worker
        os.kill(worker, signal.SIGKILL)
        thread.join()
        assert len(refused) == 1
    with shmmap.connect(one.endpoint, timeout=60.0) as client:
        assert client.live("lidar").name == "lidar"


def test_a_mapper_whose_scans_are_not_applied_refuses_more(live_daemon: LiveDaemon) -> None:
    """It keeps a few, which are applied once the worker goes on; what it refused may be added again."""
    one = live_daemon()
    points, pose = drive()[0]
    with (
        shmmap.connect(one.endpoint) as client,
        client.live("lidar").mapper("front", FILTER, timeout_s=0.5) as mapper,
    ):
        worker = worker_of(one)
        os.kill(worker, signal.SIGSTOP)
        try:
            for _ in range(MAX_UNANSWERED):
                mapper.add(points, pose)
            with pytest.raises((Busy, NoAnswer)):
                mapper.add(points, pose)
        finally:
            os.kill(worker, signal.SIGCONT)
        waiting = Deadline()
        while waiting(mapper.applied < MAX_UNANSWERED):
            pass


def test_an_operator_looks_and_saves(live_daemon: LiveDaemon) -> None:
    """`shmmap live ls`, `show` and `save`, as words and as JSON."""
    one = live_daemon(checkpoint=600.0)
    address = ("--endpoint", one.endpoint)
    assert "lidar" in shmmap_command("live", "ls", *address)
    with shmmap.connect(one.endpoint) as client:
        map_scans(client.live("lidar"), drive(3))
        (row,) = json.loads(shmmap_command("live", "ls", "--json", *address))["maps"]
        assert (row["name"], row["scans"], row["mappers"]) == ("lidar", 3, [f"{os.getuid()}/front"])
        shown = shmmap_command("live", "show", "lidar", *address)
        assert "3 applied since the start" in shown
        saved = re.search(
            r"saved, (\d+) chunks on the disk", shmmap_command("live", "save", "lidar", *address)
        )
        assert saved is not None
        found = json.loads(shmmap_command("live", "show", "lidar", "--saved", "--json", *address))
        assert (found["map"]["dirty"], found["map"]["files"]) == (0, int(saved[1]))
        assert not {chunk["state"] for chunk in found["chunks"]} & {"dirty", "saving"}
        known = sum(chunk["active"] for chunk in found["chunks"])
        assert known == len(reference(drive(3)))
        box = found["chunks"][0]["box"]
        assert box[3] - box[0] == pytest.approx(64 * RESOLUTION)
    refused = run_verb(["live", "show", "radar", *address])
    assert refused.returncode == BadRequest.exit_code
    assert "there is no live map 'radar'" in refused.stderr


def test_files_are_found_by_the_name_that_a_daemon_has_for_the_map(
    live_daemon: LiveDaemon, tmp_path: Path
) -> None:
    """Wherever they are: here a settings file that is not the installed one says where."""
    one = live_daemon()
    by_name = Shmmap(one, tmp_path / "elsewhere")
    by_name.cwd.mkdir()
    found = by_name.json("live", "fsck", "--read-only", "lidar")
    assert found["path"] == str(tmp_path / "lidar")
    done = by_name.run("live", "export", "lidar", "-o", "wall.ply")
    assert (done.returncode, f"is saved in {tmp_path / 'lidar'}" in done.stderr) == (1, True)
    assert by_name.run("live", "export", "radar", "-o", "wall.ply").returncode == 66


def shmmap_command(*words: str) -> str:
    """What a command prints, which is to succeed."""
    done = run_verb(words)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
def test_a_daemon_whose_kernels_are_compiled_is_starting(live_daemon: LiveDaemon, tmp_path: Path) -> None:
    """It beats, and says that it does not listen yet."""
    one = live_daemon(start=False)
    one.environment["NUMBA_CACHE_DIR"] = str(tmp_path / "no_kernels")
    one.launch()
    beats: set[int] = set()
    waiting = Deadline()
    while waiting(len(beats) < 3):
        with closing(StatisticsReader(one.instance, one.shm_dir)) as statistics:
            seen = statistics.snapshot()
        assert seen.state in ("absent", "starting")
        beats |= {seen.beat_monotonic_ns} - {0}
    health = run_verb(["health", "--instance", one.instance, "--shm-dir", one.shm_dir])
    assert (health.returncode, health.stdout.split(":")[0]) == (1, "starting")
    one.kill()
