# SPDX-License-Identifier: Apache-2.0
"""Whatever is wrong with a live map's files is that map's problem, by name, until it is mended.

Points are served, and so are other live maps; the daemon ends when it is asked to.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import stat
import subprocess
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

import shmmap
from shmmap.chunks.marking import Marker
from shmmap.chunks.voxels import ChunkKey
from shmmap.errors import BadRequest, Busy, CannotWrite, LiveInterrupted, NoAnswer
from shmmap.protocol.live import LiveMapRow
from tests.process.conftest import DaemonFactory
from tests.support.chunk_memory import ChunkMemory
from tests.support.command_line import Shmmap, doctor, health
from tests.support.daemon_process import Deadline
from tests.support.disks import HangingDirectory
from tests.support.divided_map import DividedMap
from tests.support.live_drive import FILTER, RESOLUTION, Voxel, drive
from tests.support.live_reference import (
    LIVE_TOML,
    LiveDaemon,
    held,
    map_scans,
    old_directory,
    reference,
    stored_drive,
)
from tests.support.stored_chunks import PAGE, change_chunk, chunk_sizes, database, largest, saved_bytes


@dataclass(frozen=True)
class Damage:
    """What is done to the directory of a map, and how that is mended."""

    name: str
    says: str
    do: Callable[[Path], object]
    mend: Callable[[Path], object]
    needs_root: bool = False


def instead(name: str, says: str, make: Callable[[Path], None], *, root: bool = False) -> Damage:
    """Something else has the name of the database."""

    def do(directory: Path) -> None:
        (directory / "map.db").rename(directory.parent / f"{directory.name}.map.db")
        make(directory / "map.db")

    def mend(directory: Path) -> None:
        path = directory / "map.db"
        path.rmdir() if path.is_dir() and not path.is_symlink() else path.unlink()
        (directory.parent / f"{directory.name}.map.db").rename(path)

    return Damage(name, says, do, mend, root)


def both_records(directory: Path) -> None:
    """Neither the database nor the copy has the map's record."""
    shutil.copytree(directory, directory.parent / f"{directory.name}.kept")
    (directory / "map.json").write_bytes(b"{")
    (directory / "map.db").write_bytes(bytes(8 * PAGE))


def as_they_were(directory: Path) -> None:
    shutil.rmtree(directory)
    (directory.parent / f"{directory.name}.kept").rename(directory)


def other_settings(directory: Path) -> None:
    shutil.copytree(directory, directory.parent / f"{directory.name}.kept")
    with database(directory) as opened:
        opened.execute("update map set record = replace(record, '0.2', '0.3')")


def a_file_instead(directory: Path) -> None:
    directory.rename(f"{directory}.away")
    directory.touch()


def the_directory_again(directory: Path) -> None:
    directory.unlink()
    Path(f"{directory}.away").rename(directory)


DEVICE = stat.S_IFCHR | 0o600
DAMAGES = [
    instead("directory", "it is a directory", lambda path: path.mkdir()),
    instead("pipe", "it is a pipe", os.mkfifo),
    instead("loop", "it is a symbolic link", lambda path: path.symlink_to(path.name)),
    instead("zeros", "a device", lambda path: os.mknod(path, DEVICE, os.makedev(1, 5)), root=True),
    Damage(
        "gone", "the database with the chunks is missing",
        lambda path: (path / "map.db").rename(path.parent / "gone.map.db"),
        lambda path: (path.parent / "gone.map.db").rename(path / "map.db"),
    ),
    Damage("record", "so is the copy of its record", both_records, as_they_were),
    Damage("other", "was made with", other_settings, as_they_were),
    Damage("file", "Not a directory", a_file_instead, the_directory_again),
    Damage(
        "closed", "cannot be", lambda path: os.chmod(path / "map.db", 0),
        lambda path: os.chmod(path / "map.db", 0o600),
    ),
]  # fmt: skip


def settings(tmp_path: Path, *names: str) -> Path:
    """A settings file with these live maps, each in the directory of its name."""
    file = tmp_path / "shmmap.toml"
    file.write_text(
        "".join(
            LIVE_TOML.format(resolution=RESOLUTION, checkpoint=0.2, path=tmp_path / name).replace(
                "lidar]", f"{name}]"
            )
            for name in names
        )
    )
    return file


def rows(client: shmmap.Client) -> dict[str, LiveMapRow]:
    return {row.name: row for row in client.live_maps()}


def until_problems(client: shmmap.Client, names: set[str]) -> dict[str, LiveMapRow]:
    """Ask until these maps have problems, and no others."""
    waiting, found = Deadline(), rows(client)
    while waiting({name for name, row in found.items() if row.problem} != names):
        found = rows(client)
    return found


def points_are_served(client: shmmap.Client) -> bool:
    return bool(client.area(shmmap.Circle(0.0, 0.0, 10.0), wait=30.0).complete)


def test_each_damage_is_one_map_s_problem_until_it_is_mended(
    daemon: DaemonFactory, divided_map: DividedMap, tmp_path: Path
) -> None:
    damages = [one for one in DAMAGES if os.geteuid() == 0 or not one.needs_root]
    if os.geteuid() == 0:
        damages = [one for one in damages if one.name != "closed"]  # root may read it all the same
    names = [one.name for one in damages]
    voxels: dict[Voxel, int] = stored_drive(tmp_path / "good", 2)
    for one in damages:
        shutil.copytree(tmp_path / "good", tmp_path / one.name)
        one.do(tmp_path / one.name)
    served = daemon(
        divided_map.root, "--config", str(settings(tmp_path, "good", *names)), "--live-budget", "64M"
    )
    with shmmap.connect(served.endpoint, timeout=60.0) as client:
        assert points_are_served(client)
        found = until_problems(client, set(names))
        for one in damages:
            assert one.says in found[one.name].problem
        assert held(client.live("good")) == voxels
        said = pytest.raises(LiveInterrupted, match=r"live map pipe: .* it is a pipe")
        with shmmap.connect(served.endpoint, timeout=0.2) as hasty, said:
            hasty.live("pipe")
        finding = doctor(served)[1]["live maps"]
        assert (finding["state"], "pipe: it cannot be opened" in finding["fact"]) == ("fail", True), finding
        assert all(served.log.count(f"live map not open map={name} ") == 1 for name in names), "once each"
        for one in damages:
            one.mend(tmp_path / one.name)
        until_problems(client, set())
        for name in names:
            assert held(client.live(name)) == voxels, name
    assert served.stop() == 0


def damaged_body(directory: Path) -> None:
    change_chunk(directory, largest(directory), lambda data: data[:-1] + bytes([data[-1] ^ 1]))


def damaged_header(directory: Path) -> None:
    change_chunk(directory, largest(directory), lambda data: data[:50])


def of_another(directory: Path) -> None:
    other = saved_bytes(directory, next(iter(chunk_sizes(directory))))
    change_chunk(directory, largest(directory), lambda _data: other)


LOSSES: dict[str, Callable[[Path], object]] = {
    "body": damaged_body, "header": damaged_header, "other": of_another, "late": damaged_body,
}  # fmt: skip
WHILE_RUNNING = {"late"}


def test_what_is_lost_is_named_by_every_verb_and_every_reader(
    daemon: DaemonFactory, divided_map: DividedMap, tmp_path: Path
) -> None:
    """No voxel is missing in silence, until the loss is forgotten on purpose."""
    voxels = stored_drive(tmp_path / "good", 2)
    lost = largest(tmp_path / "good")
    left = {voxel: value for voxel, value in voxels.items() if ChunkKey(*(i >> 6 for i in voxel)) != lost}
    for name, damage in LOSSES.items():
        shutil.copytree(tmp_path / "good", tmp_path / name)
        if name not in WHILE_RUNNING:
            damage(tmp_path / name)
    options = ("--config", str(settings(tmp_path, "good", *LOSSES)), "--live-budget", "64M")
    served = daemon(divided_map.root, *options)
    shmmap_verb = Shmmap(served, tmp_path)

    def all_say_so() -> None:
        with shmmap.connect(served.endpoint, timeout=60.0) as client:
            until_problems(client, set())
            assert not client.live("good").lost()
            for name in LOSSES:
                live = client.live(name)
                with pytest.warns(
                    shmmap.ShmmapWarning, match=f"live map {name}: .* lost of 1 chunk:\n{lost.text}"
                ):
                    assert held(live, "disk") == left, name
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    for scope in ("memory", "disk", "all"):
                        assert list(live.voxels(scope=scope).lacking) == [lost], (name, scope)
                    assert held(live) == left, name
                with pytest.warns(shmmap.ShmmapWarning, match=lost.text):
                    client.live(name).log_odds([[0.0, 0.0, 0.0]])
                assert list(live.lost()) == [lost]
        waiting = Deadline()
        while waiting(health(served)[1].count(lost.text) < len(LOSSES)):
            pass
        assert health(served)[0] == 1
        assert "live map good" not in health(served)[1]
        said = shmmap_verb("live", "ls")
        assert all(f"{name}: {lost.text}" in said for name in LOSSES), said
        finding = doctor(served)[1]["live maps"]
        assert (finding["state"], f"{len(LOSSES)} (" in finding["fact"]) == ("warn", True), finding
        for name in LOSSES:
            found = shmmap_verb.json("live", "fsck", "--read-only", str(tmp_path / name), code=65)
            assert [one["chunk"] for one in found["lost"]] == [lost.text], name
            done = shmmap_verb.run(
                "live", "export", str(tmp_path / name), "-o", "out.ply", "--voxels", "both", "--force"
            )
            assert (done.returncode, lost.text in done.stderr) == (0, True), done
            assert f"{len(left):,} of" in done.stdout

    with shmmap.connect(served.endpoint, timeout=60.0) as client:
        until_problems(client, set())
    for name in WHILE_RUNNING:
        LOSSES[name](tmp_path / name)
    with shmmap.connect(served.endpoint, timeout=60.0) as client, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name in LOSSES:
            client.live(name).voxels(scope="all")
    all_say_so()
    served.kill()
    served.start()
    all_say_so()
    assert served.stop() == 0
    for name in LOSSES:
        shmmap_verb.json("live", "fsck", "--repair", str(tmp_path / name), code=65)
    served.start()
    with shmmap.connect(served.endpoint, timeout=60.0) as client, warnings.catch_warnings():
        warnings.simplefilter("error")
        until_problems(client, set())
        for name in LOSSES:
            assert held(client.live(name)) == left
    assert health(served)[0] == 0
    assert served.stop() == 0


def test_a_map_of_an_earlier_version_is_imported_at_the_start(daemon: DaemonFactory, tmp_path: Path) -> None:
    """Without a question; what was there is kept."""
    voxels = old_directory(tmp_path / "lidar", 2)
    served = daemon("", "--config", str(settings(tmp_path, "lidar")), "--live-budget", "16M")
    with shmmap.connect(served.endpoint, timeout=60.0) as client:
        assert held(client.live("lidar")) == held(client.live("lidar"), "disk") == voxels
    assert (tmp_path / "lidar" / "imported.1" / "map.json").exists()
    assert "imported and kept" in served.log
    assert served.stop() == 0


@pytest.fixture
def hang() -> Iterator[Callable[[Path], HangingDirectory]]:
    """Have directories hang."""
    hanging: list[HangingDirectory] = []

    def make(path: Path) -> HangingDirectory:
        try:
            hanging.append(HangingDirectory(path))
        except OSError as error:
            pytest.skip(f"cannot mount a file system that hangs: {error.strerror}")
        return hanging[-1]

    yield make
    for one in hanging:
        one.end()


@pytest.mark.root
def test_a_directory_that_hangs_keeps_no_client_waiting(
    daemon: DaemonFactory, divided_map: DividedMap, tmp_path: Path, hang: Callable[[Path], HangingDirectory]
) -> None:
    """From the start on: points and other maps are served, the daemon ends, and it comes back by itself."""
    voxels = stored_drive(tmp_path / "good", 2)
    shutil.copytree(tmp_path / "good", tmp_path / "away")
    hanging = hang(tmp_path / "away")
    served = daemon(
        divided_map.root, "--config", str(settings(tmp_path, "away", "good")), "--live-budget", "16M"
    )
    with shmmap.connect(served.endpoint, timeout=60.0) as client:
        assert points_are_served(client)
        assert "is" in until_problems(client, {"away"})["away"].problem
        assert held(client.live("good")) == voxels
    assert served.stop() == 0
    served.start()
    with shmmap.connect(served.endpoint, timeout=60.0) as client:
        until_problems(client, {"away"})
        hanging.end()
        until_problems(client, set())
        assert held(client.live("away")) == voxels
    assert served.stop() == 0


@pytest.mark.root
def test_a_directory_that_begins_to_hang(
    daemon: DaemonFactory, divided_map: DividedMap, tmp_path: Path, hang: Callable[[Path], HangingDirectory]
) -> None:
    """While it maps: that map says so, others go on, and what is not saved is named at the end."""
    served = daemon(
        divided_map.root, "--config", str(settings(tmp_path, "lidar", "good")), "--live-budget", "16M"
    )
    scans = drive(3)
    with shmmap.connect(served.endpoint, timeout=60.0) as client:
        until_problems(client, set())
        with client.live("lidar").mapper("front", FILTER) as mapper:
            mapper.add(*scans[0])
            mapper.wait_durable()
        hang(tmp_path / "lidar")
        waiting = Deadline()
        while waiting("its directory" not in rows(client)["lidar"].problem):
            pass
        with client.live("good").mapper("front", FILTER) as mapper:
            for points, pose in scans:
                mapper.add(points, pose)
            mapper.wait_durable()
        assert points_are_served(client)
    assert served.stop() == 0


@pytest.mark.root
def test_a_full_disk_at_the_start_and_at_the_end(
    daemon: DaemonFactory, divided_map: DividedMap, tmp_path: Path, private_tmpfs: Callable[[str], str]
) -> None:
    """The map is opened when there is room; what is not saved at the end is named, and there afterwards."""
    disk, scans = Path(private_tmpfs("192k")), drive()
    filler = disk / "filler"
    filler.write_bytes(bytes((192 << 10) - os.sysconf("SC_PAGESIZE")))
    with contextlib.suppress(OSError), filler.open("ab") as file:
        file.write(bytes(1 << 20))
    (tmp_path / "full").symlink_to(disk)
    served = daemon(divided_map.root, "--config", str(settings(tmp_path, "full")), "--live-budget", "16M")
    with shmmap.connect(served.endpoint, timeout=60.0) as client:
        assert points_are_served(client)
        waiting = Deadline()
        while waiting("No space left" not in rows(client)["full"].problem):
            pass
        filler.unlink()
        until_problems(client, set())
        map_scans(client.live("full"), scans)
        waiting = Deadline()
        while waiting("cannot be saved: No space left" not in rows(client)["full"].problem):
            pass
        assert held(client.live("full")) == reference(scans), "what has no file is in memory"
    assert served.stop() == CannotWrite.exit_code
    assert "live map not saved: its chunks stay in memory for the next start map=full" in served.log
    assert served.log.count("live map has a problem") < 20, "it is retried each second, and logged once"
    subprocess.run(["mount", "-o", "remount,size=16m", str(disk)], check=True)
    served.start()
    with shmmap.connect(served.endpoint, timeout=60.0) as client:
        assert held(client.live("full")) == reference(scans)
    assert served.stop() == 0


@pytest.mark.root
def test_a_mapper_says_that_the_disk_is_full_and_goes_on_when_there_is_room(
    live_daemon: LiveDaemon, tmp_path: Path, private_tmpfs: Callable[[str], str]
) -> None:
    """What the daemon knows is in the mapper's and the reader's error; nothing that was taken is lost."""
    disk, scans = Path(private_tmpfs("256k")), drive(40)
    (tmp_path / "lidar").symlink_to(disk)
    one = live_daemon("--live-budget", "4M", resolution=0.05)
    taken: list[int] = []
    with shmmap.connect(one.endpoint, timeout=60.0) as client:
        live = client.live("lidar")
        with live.mapper("front", FILTER, timeout_s=3.0) as mapper:

            def add_all() -> None:
                for points, pose in scans[len(taken) :]:
                    mapper.add(points, pose)
                    taken.append(mapper.applied)
                mapper.wait_applied()

            # on a busy machine the daemon may be slower than the mapper's timeout: then that error says why
            with pytest.raises((Busy, NoAnswer), match=r"live map lidar.* waits: .*No space left on device"):
                add_all()
            assert len(taken) > 3
            with pytest.raises(Busy, match="No space left on device"):
                mapper.wait_durable()
            with (
                shmmap.connect(one.endpoint, timeout=0.5) as hasty,
                pytest.raises(NoAnswer, match=r"live map lidar waits: .*No space left on device"),
            ):
                hasty.live("lidar").save(timeout_s=0.5)
            subprocess.run(["mount", "-o", "remount,size=64m", str(disk)], check=True)
            waiting = Deadline()
            while waiting(mapper.applied < len(taken)):
                pass
            mapper.wait_durable()
        sent = len(taken)
        found = {kind: len(live.voxels(kind, scope="all")) for kind in ("occupied", "free")}
    assert one.stop() == 0
    memory = ChunkMemory(0.05)
    for number, (points, pose) in enumerate(scans[:sent], 1):
        memory.apply(Marker(0.05, FILTER).mark(points, pose)[0], scan=number)
    values = list(memory.voxels().values())
    assert found == {
        "occupied": sum(value > 0 for value in values),
        "free": sum(value < 0 for value in values),
    }


@pytest.mark.root
def test_live_maps_alone_get_what_is_there(
    daemon: DaemonFactory, tmp_path: Path, private_tmpfs: Callable[[str], str]
) -> None:
    """Nothing is set aside for a map of points that is not served."""
    for size in (64, 2048):
        one = daemon("", "--config", str(settings(tmp_path, "lidar")), shm_dir=private_tmpfs(f"{size}m"))
        with shmmap.connect(one.endpoint, timeout=60.0) as client:
            (row,) = client.live_maps()
        assert min(size * 0.85, 900) <= row.budget_bytes / 2**20 <= size * 0.95
        assert one.stop() == 0


def test_a_directory_that_is_moved_or_replaced(live_daemon: LiveDaemon, tmp_path: Path) -> None:
    one = live_daemon()
    scans, away = drive(3), tmp_path / "away"
    with shmmap.connect(one.endpoint, timeout=60.0) as client:
        live = client.live("lidar")
        with live.mapper("front", FILTER) as mapper:
            mapper.add(*scans[0])
            mapper.wait_durable()
            (tmp_path / "lidar").rename(away)
            assert "moved or removed" in until_problems(client, {"lidar"})["lidar"].problem
            (tmp_path / "lidar").mkdir()
            waiting = Deadline()
            while waiting("another one is in its place" not in rows(client)["lidar"].problem):
                pass
            mapper.add(*scans[1])
            mapper.wait_durable()
            assert not list((tmp_path / "lidar").iterdir()), "never a mixture of two maps"
            (tmp_path / "lidar").rmdir()
            away.rename(tmp_path / "lidar")
            until_problems(client, set())
        assert held(live, "disk") == reference(scans[:2])


def test_arguments_that_make_no_sense_end_no_mapper(live_daemon: LiveDaemon) -> None:
    """Each is refused before anything is sent, with an error of ours; the mapper and the reader go on."""
    one, scans = live_daemon(), drive(2)
    nan, nothing = float("nan"), cast("Any", None)
    with shmmap.connect(one.endpoint, timeout=60.0) as client:
        live = client.live("lidar")
        with live.mapper("front", FILTER) as mapper:
            mapper.add(*scans[0])
            reach = 2**29 * RESOLUTION
            for axis, metres in ((0, reach), (1, -reach), (2, 1.9 * reach), (0, 1e300)):
                pose = scans[1][1].copy()
                pose[axis, 3] = metres
                with pytest.raises(BadRequest, match="pose"):
                    mapper.add(scans[1][0], pose)
            refused: list[Callable[[], object]] = [
                lambda: mapper.add(scans[1][0], nothing), lambda: mapper.add(nothing, scans[1][1]),
                lambda: mapper.wait_applied(nan), lambda: mapper.wait_durable(nan),
                lambda: mapper.wait_applied(-1),
                lambda: mapper.wait_durable(cast("Any", "soon")),
                lambda: live.mapper("rear", timeout_s=nan), lambda: live.save(timeout_s=nan),
                lambda: live.move_to(nan, 0.0, 0.0), lambda: live.move_to(nothing, 0.0, 0.0),
                lambda: live.move_to(reach, 0.0, 0.0), lambda: live.log_odds(nothing),
                lambda: live.log_odds([[nan] * 3]), lambda: live.log_odds([1.0, 2.0]),
                lambda: live.first_hits([0.0, 0.0, 0.0], [1e5, 0.0, 0.0]),
                lambda: live.first_hits([0.0, 0.0, 0.0], [nan, 0.0, 0.0]),
                lambda: live.first_hits(np.zeros((2, 3)), np.ones((3, 3))),
                lambda: live.first_hits(np.ma.MaskedArray(np.zeros((1, 3)), True), [1.0, 0.0, 0.0]),
            ]  # fmt: skip
            for call in refused:
                with pytest.raises(BadRequest):
                    call()
            assert mapper.add(*(array.tolist() for array in scans[1])) == 2
            mapper.wait_applied()
        assert held(live) == reference(scans)
        assert live.first_hits([0.0, 0.0, 0.0], [10_000.0, 0.0, 0.0]).shape == (1,)


@pytest.mark.root
def test_a_mapper_that_met_a_full_tmpfs_goes_on_when_there_is_room(
    live_daemon: LiveDaemon, private_tmpfs: Callable[[str], str]
) -> None:
    """Scans that were taken are sent until they are in the map; one that was not may be added again."""
    scans, shm = drive(5), Path(private_tmpfs("48m"))
    one = live_daemon("--live-shm-dir", str(shm))
    with shmmap.connect(one.endpoint, timeout=60.0) as client:
        live = client.live("lidar")
        with live.mapper("front", FILTER, timeout_s=0.3) as mapper:
            mapper.add(*scans[0])
            waiting = Deadline()
            while waiting(mapper.applied < 1):
                pass
            filler = shm / "filler"
            with contextlib.suppress(OSError), filler.open("wb", buffering=0) as file:
                while file.write(bytes(1 << 16)):
                    pass
            taken: list[int] = []

            def add_all() -> None:
                for points, pose in scans[1:]:
                    taken.append(mapper.add(points, pose))

            with pytest.raises(LiveInterrupted, match="No space left"):
                add_all()
            with pytest.raises(LiveInterrupted, match="No space left"):
                mapper.wait_applied()
            filler.unlink()
            while waiting(mapper.applied < len(taken) + 1):
                pass
            assert mapper.add(*scans[4]) == len(taken) + 2
            while waiting(mapper.applied < len(taken) + 2):
                pass
        assert held(live) == reference([*scans[: len(taken) + 1], scans[4]])
