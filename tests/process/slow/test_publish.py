# SPDX-License-Identifier: Apache-2.0
"""Publishing: what is sent, one version at a time, killed wherever; its versions; and back into files."""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import signal
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from shmmap.layers.build import build_layer
from shmmap.origin.map_directory import open_map
from shmmap.origin.remote.opened_store import open_store
from shmmap.progress import NoProgress
from tests.support.accounts import OTHER_USER
from tests.support.command_line import Verbs, files_of, locked, make_older
from tests.support.compiled_programs import made_once
from tests.support.divided_map import DividedMap, make_map
from tests.support.map_stores import BucketServer
from tests.support.published_daemon import without
from tests.support.published_maps import PublishedMapReader, columns_of

zstandard = pytest.importorskip("zstandard", reason="zstandard is not installed")

NDT = "ndt(leaf=2.0,min_points=3)"
DAY_S = 86_400


@pytest.fixture
def town(tmp_path: Path) -> DividedMap:
    return make_map(tmp_path / "town", columns=2, rows=2, points=300)


@pytest.fixture(scope="session")
def _stores(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Where the town is published, and where two more versions of it are."""
    folder = made_once(tmp_path_factory, "published_versions", _publish_versions)
    return folder / "one", folder / "three"


def _publish_versions(folder: Path) -> None:
    made = make_map(folder / "town", columns=2, rows=2, points=300)
    run = Verbs(folder)
    run("publish", made.root, folder / "one", "--id-prefix", "/store/")
    shutil.copytree(folder / "one", folder / "three")
    for seed in (1, 2):
        made.change("0_0.pcd", seed)
        run("publish", made.root, folder / "three")


@pytest.fixture
def store(tmp_path: Path, _stores: tuple[Path, Path]) -> Path:
    """A directory in which the town is published."""
    return Path(shutil.copytree(_stores[0], tmp_path / "store"))


@pytest.fixture
def three(tmp_path: Path, town: DividedMap, _stores: tuple[Path, Path]) -> Path:
    """A directory with three versions of the town, which is as in the third."""
    town.change("0_0.pcd", 2)
    return Path(shutil.copytree(_stores[1], tmp_path / "three"))


def check(store: Path, town: DividedMap, prefix: str = "/store/") -> PublishedMapReader:
    """The current version is whole and has the map's points, bit by bit, read by other programs."""
    read = PublishedMapReader(store)
    assert set(read.cells) == {prefix + name for name in town.corners}
    for name in town.corners:
        source, cell = town.points(name), read.cells[prefix + name]
        xyz = np.column_stack([source["x"], source["y"], source["z"]])
        assert cell.columns["points"]["xyz"].tobytes() == xyz.tobytes()
        assert cell.columns["points"]["intensity"].tobytes() == source["intensity"].tobytes()
        assert cell.box == town.box(name)
        assert cell.points == len(xyz)
        assert cell.z == (xyz[:, 2].min(), xyz[:, 2].max())
    return read


# --- what is published --------------------------------------------------------------------------------


@pytest.mark.usefixtures("layer_kernels")
def test_another_reader_finds_every_layer_bit_by_bit(shmmap: Verbs, town: DividedMap, tmp_path: Path) -> None:
    done = shmmap.json("publish", town.root, tmp_path / "store", "--layer", NDT, "voxel(leaf=1.0)")
    assert (done["changed"], done["version"], done["cells"], done["failed"]) == (True, 1, 4, [])
    assert done["layers"] == ["points", NDT, "voxel(leaf=1.0)"]
    read = check(tmp_path / "store", town)
    assert f"{read.map_version:016x}" == done["map_version"]
    assert len({version for cell in read.cells.values() for version in cell.versions.values()}) == 12
    assert sorted(cell.index for cell in read.cells.values()) == [0, 1, 2, 3]
    for name in town.corners:
        source, cell = town.points(name), read.cells["/store/" + name]
        xyz = np.column_stack([source["x"], source["y"], source["z"]])
        table = build_layer(NDT, {"xyz": xyz, "intensity": source["intensity"]})
        assert set(cell.columns[NDT]) == set(table.columns)
        for column, values in table.columns.items():
            assert cell.columns[NDT][column].tobytes() == values.tobytes(), column


def test_the_same_map_is_nothing_changed_wherever_it_lies(
    shmmap: Verbs, town: DividedMap, tmp_path: Path, buckets: BucketServer
) -> None:
    """Objects that the server receives: none, none, none; of one changed cell five."""
    url = buckets.url("received")
    first = shmmap.json("publish", town.root, url, env=buckets.environment)
    assert first["sent_objects"] == 9
    assert len(buckets.received()) == 11  # 4 cells, 4 shards, root, entry, CURRENT
    again = shmmap.json("publish", town.root, url, env=buckets.environment)
    assert (again["changed"], again["version"], again["map_version"]) == (False, 1, first["map_version"])
    for file in town.pcd_dir.iterdir():
        os.utime(file)
    assert not shmmap.json("publish", town.root, url, env=buckets.environment)["changed"]
    copied = tmp_path / "elsewhere"
    shutil.copytree(town.root, copied)
    assert not shmmap.json("publish", copied, url, env=buckets.environment)["changed"]
    assert buckets.received() == []
    town.change("0_0.pcd", seed=7)
    changed = shmmap.json("publish", town.root, url, env=buckets.environment)
    assert (changed["changed"], changed["version"], changed["sent_objects"]) == (True, 2, 3)
    received = [path.removeprefix("/maps/received/") for path in buckets.received()]
    assert received[3:] == ["versions/2.json", "CURRENT"]
    assert [path[:13] for path in received[:3]] == ["blobs/sha256/"] * 3


def recompressed(store: Path) -> None:
    """Make every object as another release of zstd would."""
    from tests.support.message_pack import pack, unpack

    def again(digest: bytes, change: Callable[[bytes], bytes] = bytes) -> tuple[bytes, bytes]:
        path = store / "blobs/sha256" / digest.hex()
        unpacked = zstandard.ZstdDecompressor().decompress(path.read_bytes())
        frame = zstandard.ZstdCompressor(level=1, write_checksum=True).compress(change(unpacked))
        path.unlink(missing_ok=True)
        path.with_name(hashlib.sha256(frame).hexdigest()).write_bytes(frame)
        return hashlib.sha256(frame).digest(), frame

    def shard(unpacked: bytes) -> bytes:
        found = unpack(unpacked)
        for layer in found["layers"].values():
            made = [again(layer["sha256"][at : at + 32]) for at in range(0, len(layer["sha256"]), 32)]
            layer["sha256"] = b"".join(digest for digest, _ in made)
            layer["size"] = np.array([len(frame) for _, frame in made], "<u4").tobytes()
        return pack(found)

    def root(unpacked: bytes) -> bytes:
        found = unpack(unpacked)
        digests = found["shard_sha256"]
        made = [again(digests[at : at + 32], shard) for at in range(0, len(digests), 32)]
        found["shard_sha256"] = b"".join(digest for digest, _ in made)
        found["shard_bytes"] = np.array([len(frame) for _, frame in made], "<u4").tobytes()
        return pack(found)

    current = json.loads((store / "CURRENT").read_bytes())
    digest, frame = again(bytes.fromhex(current["root"]), root)
    current |= {"root": digest.hex(), "bytes": len(frame)}
    entry = json.loads((store / f"versions/{current['version']}.json").read_bytes())
    (store / "CURRENT").write_text(json.dumps(current))
    (store / f"versions/{current['version']}.json").write_text(json.dumps({**entry, **current}))


def test_after_another_release_of_zstd_no_cell_is_sent(shmmap: Verbs, town: DividedMap, store: Path) -> None:
    before = PublishedMapReader(store)
    recompressed(store)
    versions = {cell_id: cell.versions for cell_id, cell in check(store, town).cells.items()}
    assert versions == {cell_id: cell.versions for cell_id, cell in before.cells.items()}
    assert not shmmap.json("publish", town.root, store)["changed"]
    town.change("0_0.pcd", seed=8)
    assert shmmap.json("publish", town.root, store)["sent_objects"] == 3
    check(store, town)


def test_cells_that_come_move_and_go(shmmap: Verbs, town: DividedMap, tmp_path: Path) -> None:
    store = tmp_path / "store"
    shmmap("publish", town.root, store, "--id-prefix", "/city/")
    points = town.points("0_0.pcd")
    town.write_cell("renamed.pcd", (0, 0), {key: points[key] for key in ("x", "y", "z", "intensity")})
    town.remove_cell("0_0.pcd")
    town.write_metadata()
    done = shmmap.json("publish", town.root, store)
    assert (done["id_prefix"], done["sent_objects"]) == ("/city/", 2)  # a shard and the root
    check(store, town, "/city/")
    errors = shmmap("publish", town.root, store, "--id-prefix", "/other/", code=2)
    assert "begin with /city/" in errors


def test_one_cloud_is_a_map(shmmap: Verbs, town: DividedMap, tmp_path: Path) -> None:
    shmmap("publish", town.pcd_dir / "0_0.pcd", f"file://{tmp_path}/store/", "--id-prefix", "/one/")
    (cell,) = PublishedMapReader(tmp_path / "store").cells.values()
    assert cell.points == 300
    shmmap("fetch", tmp_path / "store", tmp_path / "back")
    assert shmmap.json("publish", tmp_path / "back", tmp_path / "store")["changed"] is False


def test_names_of_any_language_in_folders_of_their_own(shmmap: Verbs, tmp_path: Path) -> None:
    town = make_map(tmp_path / "town", columns=1, rows=1, points=50)
    points = town.points("0_0.pcd")
    for folder, name, corner in (("süd", "straße 1.pcd", (-20, 0)), ("nord/a", "'x': y.pcd", (20, 0))):
        (town.pcd_dir / folder).mkdir(parents=True)
        town.write_cell(name, corner, points)
        (town.pcd_dir / name).rename(town.pcd_dir / folder / name)
    lines = ["x_resolution: 20", "y_resolution: 20"]
    lines += [f"{json.dumps(name)}: [{x}, {y}]" for name, (x, y) in town.corners.items()]
    (town.root / "pointcloud_map_metadata.yaml").write_text("\n".join(lines) + "\n")
    done = shmmap.json("publish", town.root, tmp_path / "store")
    assert done["cells"] == 3
    assert ["in 2 cells of 3" in note for note in done["notes"]] == [True]  # two have the third one's points
    read = PublishedMapReader(tmp_path / "store")
    assert set(read.cells) == {"/store/0_0.pcd", "/store/süd/straße 1.pcd", "/store/nord/a/'x': y.pcd"}
    shmmap("fetch", tmp_path / "store", tmp_path / "back")
    for name in ("süd/straße 1.pcd", "nord/a/'x': y.pcd"):
        assert (tmp_path / "back/pointcloud_map.pcd" / name).is_file()
    assert not shmmap.json("publish", tmp_path / "back", tmp_path / "store")["changed"]


def test_a_map_that_was_copied_without_its_history_goes_on(
    shmmap: Verbs, town: DividedMap, three: Path
) -> None:
    shutil.rmtree(three / "versions")
    rows = shmmap.json("versions", three)["versions"]
    assert [(row["version"], row["state"], row["created"]) for row in rows] == [(3, "current", "")]
    assert "current" in shmmap("versions", three)
    shmmap.json("versions", three, "--prune")
    town.change("0_0.pcd", seed=9)
    assert shmmap.json("publish", town.root, three)["version"] == 4
    assert [row["version"] for row in shmmap.json("versions", three)["versions"]] == [4]
    check(three, town)


def test_a_cell_that_cannot_be_read_publishes_nothing(shmmap: Verbs, town: DividedMap, store: Path) -> None:
    before = (store / "CURRENT").read_bytes()
    (town.pcd_dir / "0_0.pcd").write_bytes(b"# .PCD v0.7\nnot a cloud\n")
    done = shmmap.json("publish", town.root, store, code=1)
    assert [one["id"] for one in done["failed"]] == [town.id("0_0.pcd")]
    assert (done["changed"], done["version"]) == (False, 1)
    assert (store / "CURRENT").read_bytes() == before
    assert "the current version stays" in shmmap("publish", town.root, store, code=1)


def test_what_is_damaged_in_the_store_is_sent_again(shmmap: Verbs, town: DividedMap, store: Path) -> None:
    for damaged in (store / "blobs/sha256").iterdir():
        damaged.write_bytes(b"")
    assert "has 0 bytes" in shmmap("publish", town.root, store, code=65)
    assert "--id-prefix" in shmmap("publish", town.root, store, "--resend", code=2)
    assert shmmap.json("publish", town.root, store, "--resend", "--id-prefix", "/store/")["sent_objects"] == 9
    check(store, town)
    again = shmmap.json("publish", town.root, store)
    assert (again["changed"], again["version"]) == (False, 2)


# --- killed, and two at a time ------------------------------------------------------------------------


PUBLISH_STEPS = (
    "publish.shard", "publish.root", "version.entry", "version.switch", "version.switched",
)  # fmt: skip


@pytest.mark.parametrize("label", PUBLISH_STEPS)
def test_killed_anywhere_the_current_version_is_whole(
    label: str, shmmap: Verbs, town: DividedMap, store: Path, tmp_path: Path
) -> None:
    before = make_map(tmp_path / "before", columns=2, rows=2, points=300)
    for seed, name in enumerate(list(town.corners)[:2]):
        town.change(name, seed)
    shmmap("publish", town.root, store, code=-signal.SIGKILL, env={"SHMMAP_TEST_CRASH": label})
    check(store, town if label == "version.switched" else before)
    again = shmmap.json("publish", town.root, store)
    assert again["changed"] == (label != "version.switched")
    assert again["sent_objects"] <= {"publish.shard": 3, "publish.root": 1}.get(label, 0)
    check(store, town)
    rows = shmmap.json("versions", store)["versions"]
    unserved = [row["version"] for row in rows if row["state"] == "never served"]
    assert unserved == ([2] if label == "version.switch" else [])


def test_killed_while_cells_are_sent_it_goes_on(
    shmmap: Verbs, town: DividedMap, store: Path, tmp_path: Path
) -> None:
    before = make_map(tmp_path / "before", columns=2, rows=2, points=300)
    for seed, name in enumerate(town.corners):
        town.change(name, seed)
    count = len(os.listdir(store / "blobs/sha256"))
    process = shmmap.start("publish", town.root, store)
    while process.poll() is None and len(os.listdir(store / "blobs/sha256")) == count:
        time.sleep(0.001)
    process.kill()
    process.communicate()
    read = PublishedMapReader(store)
    check(store, before if read.current["version"] == 1 else town)
    shmmap("publish", town.root, store)
    check(store, town)


@pytest.mark.parametrize("changed", [1, 4])
def test_a_worker_that_is_killed_costs_nothing(
    changed: int, shmmap: Verbs, town: DividedMap, store: Path, tmp_path: Path
) -> None:
    """Not even the cell that it had alone: only a second worker that dies of the same one blames it."""
    for seed, name in enumerate(list(town.corners)[:changed]):
        town.change(name, seed)
    crash = f"publish.send:1:{tmp_path}/died"
    done = shmmap.json("publish", town.root, store, env={"SHMMAP_TEST_CRASH": crash})
    assert done["changed"]
    assert (tmp_path / "died").exists()
    check(store, town)


@pytest.mark.parametrize("is_signed", [False, True])
def test_of_two_publishers_one_wins_and_the_other_learns_it(
    is_signed: bool, shmmap: Verbs, town: DividedMap, tmp_path: Path, buckets: BucketServer
) -> None:
    if is_signed:
        pytest.importorskip("tuf", reason="tuf is not installed")
    url, env = buckets.url(f"raced{is_signed}"), buckets.environment
    sign = ("--sign", tmp_path / "keys") if is_signed else ()
    shmmap("publish", town.root, url, *sign, env=env)
    maps = [make_map(tmp_path / f"{seed}", columns=2, rows=2, points=300, seed=seed) for seed in (8, 9)]
    running = [shmmap.start("publish", one.root, url, *sign, env=env) for one in maps]
    answers = [process.communicate() for process in running]
    codes = [process.returncode for process in running]
    assert 0 in codes, answers  # they may also have come one after the other
    for (_, errors), code in zip(answers, codes, strict=True):
        assert code in (0, 75), errors
        assert code == 0 or "another publisher has changed" in errors
    current = shmmap.json("versions", url, env=env)["current"]
    assert current >= 1 + codes.count(0)
    if is_signed:
        assert shmmap.json("versions", url, "--refresh", *sign, env=env)["version"] == current
    shmmap("fetch", url, tmp_path / "back", env=env)
    back = files_of(tmp_path / "back/pointcloud_map.pcd")
    assert back in [files_of(one.pcd_dir) for one in maps]


def test_an_interrupted_run_says_how_to_go_on(shmmap: Verbs, town: DividedMap, store: Path) -> None:
    town.change("0_0.pcd", seed=1)
    with locked(store):
        process = shmmap.start("publish", town.root, store)
        while not (store / "versions/2.json").exists():
            assert process.poll() is None
            time.sleep(0.01)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate()
    assert process.returncode == 130
    assert "the same command continues" in errors
    assert json.loads((store / "CURRENT").read_bytes())["version"] == 1


@pytest.mark.root
def test_a_full_disk_leaves_the_current_version(
    shmmap: Verbs, town: DividedMap, store: Path, private_tmpfs: Callable[[str], str]
) -> None:
    small = Path(private_tmpfs("200k")) / "store"
    shutil.copytree(store, small)
    before = (small / "CURRENT").read_bytes()
    for seed, name in enumerate(town.corners):
        town.change(name, seed, count=8000)
    errors = shmmap("publish", town.root, small, code=73)
    assert "No space left on device" in errors
    assert (small / "CURRENT").read_bytes() == before
    PublishedMapReader(small)


# --- versions -----------------------------------------------------------------------------------------


def test_going_back_is_a_new_number(shmmap: Verbs, town: DividedMap, three: Path, tmp_path: Path) -> None:
    before = make_map(tmp_path / "before", columns=2, rows=2, points=300)
    for label in ("restore.entry", "restore.looked", "version.switch"):
        shmmap("versions", three, "--rollback", "1", code=-signal.SIGKILL, env={"SHMMAP_TEST_CRASH": label})
        check(three, town)
    done = shmmap.json("versions", three, "--rollback", "1")
    assert (done["changed"], done["version"], done["restored"], done["objects"]) == (True, 6, 1, 4)
    read = check(three, before)
    assert (read.entry["before"], read.entry["restored"]) == (3, 1)
    assert not shmmap.json("versions", three, "--rollback", "1")["changed"]
    assert not shmmap.json("publish", before.root, three)["changed"]
    assert "was never served" in shmmap("versions", three, "--rollback", "4", code=2)
    assert "there is no version 9" in shmmap("versions", three, "--rollback", "9", code=66)
    rows = shmmap.json("versions", three)["versions"]
    assert [(row["version"], row["state"], row["restored"]) for row in rows] == [
        (6, "current", 1), (5, "never served", 1), (4, "never served", 1),
        (3, "earlier", 0), (2, "earlier", 0), (1, "earlier", 0),
    ]  # fmt: skip
    assert re.search(r"6 +current .* version 1\n", shmmap("versions", three))


def test_a_version_that_is_not_whole_does_not_come_back(
    shmmap: Verbs, town: DividedMap, three: Path, store: Path
) -> None:
    """An object that version 1 has and version 3 has not is gone."""
    first = {cell.columns["points"]["xyz"].tobytes() for cell in PublishedMapReader(store).cells.values()}
    third = {cell.columns["points"]["xyz"].tobytes() for cell in check(three, town).cells.values()}
    assert len(first - third) == 1
    for path in (store / "blobs/sha256").iterdir():
        frame = path.read_bytes()
        unpacked = zstandard.ZstdDecompressor().decompress(frame)
        if unpacked.startswith(b"SHMMAP") and columns_of(unpacked, "points", 1)["xyz"].tobytes() not in third:
            (three / "blobs/sha256" / path.name).unlink()
    errors = shmmap("versions", three, "--rollback", "1", code=65)
    assert "1 objects of version 1 are not there" in errors
    check(three, town)


@pytest.mark.parametrize("label", ["", "prune.entry", "prune.listed", "prune.object"])
def test_pruning_takes_what_only_old_versions_have(
    label: str, shmmap: Verbs, town: DividedMap, three: Path, tmp_path: Path
) -> None:
    names = set(os.listdir(three / "blobs/sha256"))
    if not label:
        kept = shmmap.json("versions", three, "--prune")
        assert (kept["versions"], kept["objects"], kept["kept_versions"]) == ([], 0, [1, 2, 3])
    make_older(three, 40, 1, 2)
    make_older(three, 20, 3)  # since then 2 is not current
    make_older(three, 40)
    if label:
        shmmap("versions", three, "--prune", code=-signal.SIGKILL, env={"SHMMAP_TEST_CRASH": label})
        check(three, town)
    done = shmmap.json("versions", three, "--prune")
    assert done["kept_versions"] == [2, 3]
    assert (done["versions"], done["objects"]) == ([1] if label in ("", "prune.entry") else [], 3)
    assert len(names - set(os.listdir(three / "blobs/sha256"))) == 3  # a cell, a shard, a root
    check(three, town)
    if label:
        return
    shmmap("fetch", three, tmp_path / "two", "--at", "2")
    assert "there is no version 1" in shmmap("fetch", three, tmp_path / "one", "--at", "1", code=66)
    done = shmmap.json("versions", three, "--prune", "--keep", "7")
    assert (done["versions"], done["objects"]) == ([2], 3)
    check(three, town)


def test_pruning_spares_what_is_young_and_what_is_being_published(
    shmmap: Verbs, town: DividedMap, store: Path
) -> None:
    make_older(store, 99, 1)
    town.change("0_0.pcd", seed=1)
    shmmap("publish", town.root, store, code=-signal.SIGKILL, env={"SHMMAP_TEST_CRASH": "version.switch"})
    done = shmmap.json("versions", store, "--prune", "--keep", "7")
    assert (done["versions"], done["objects"], done["kept_versions"]) == ([], 0, [1, 2])
    make_older(store, 8, 2)
    make_older(store, 99, 1)
    done = shmmap.json("versions", store, "--prune", "--keep", "7")
    assert (done["versions"], done["objects"]) == ([2], 3)
    assert "7 or more" in shmmap("versions", store, "--prune", "--keep", "6", code=2)
    assert "goes with --prune" in shmmap("versions", store, "--keep", "9", code=2)


class _Looks(NoProgress):
    """Lists a directory while cells are published."""

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self.found: list[str] | None = None

    def stage(self, name: str, total: int) -> None:
        del total
        if name == "publish":
            self.found = os.listdir(self._directory)


def test_points_outside_of_their_cells_are_noted_and_no_file_can_be_left(
    shmmap: Verbs, town: DividedMap, store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from shmmap.publishing.messages import PublishSettings
    from shmmap.publishing.publish import publish_map

    (tmp_path / "tmp").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "tmp"))
    looks = _Looks(tmp_path / "tmp")
    again = publish_map(
        open_map(str(town.root)).load(), open_store(str(store)), [], settings=PublishSettings(str(store)),
        workers=1, progress=looks,
    )  # fmt: skip
    assert (again.version, again.sent_objects, again.notes, looks.found) == (None, 0, [], [])
    metadata = town.root / "pointcloud_map_metadata.yaml"
    metadata.write_text(metadata.read_text().replace("0_0.pcd: [0, 0]", "0_0.pcd: [10, 0]"))
    outside = int((town.points("0_0.pcd")["x"] < 10).sum())
    assert outside
    said = shmmap("publish", town.root, store)
    assert "note: points outside of their cell's box in 1 cell of 4" in said
    assert f"{outside} in {town.pcd_dir}/0_0.pcd" in said


def test_a_cell_in_many_folders_is_no_file(shmmap: Verbs, town: DividedMap, tmp_path: Path) -> None:
    deep = town.pcd_dir.joinpath(*["d"] * 40)
    deep.mkdir(parents=True)
    (town.pcd_dir / "0_0.pcd").rename(deep / "0_0.pcd")
    shmmap("publish", town.root, tmp_path / "deep")
    said = shmmap("fetch", tmp_path / "deep", tmp_path / "back", code=2)
    assert "cannot be a file: its name is too long, or in too many folders" in said
    assert not (tmp_path / "back").exists()


# --- back into files ----------------------------------------------------------------------------------


def test_what_a_daemon_keeps_on_the_disk_is_not_fetched(
    shmmap: Verbs, town: DividedMap, store: Path, tmp_path: Path
) -> None:
    """And nothing that is fetched is put there."""
    from shmmap.origin.remote.object_tier import ObjectTier  # needs zstandard

    tier = ObjectTier(str(tmp_path / "cache/shmmap"), limit_bytes=1 << 30)
    shmmap("fetch", store, tmp_path / "one")
    assert not (tmp_path / "cache/shmmap/objects").exists()
    blobs = {path: path.read_bytes() for path in (store / "blobs/sha256").iterdir()}
    for path, data in blobs.items():
        for is_index in (False, True):
            tier.put(bytes.fromhex(path.name), data, is_index=is_index)
        path.unlink()
    done = shmmap.json("fetch", store, tmp_path / "two")
    assert (done["fetched_cells"], done["fetched_bytes"]) == (4, 0)
    for name in ("one", "two"):
        assert files_of(tmp_path / name / "pointcloud_map.pcd") == files_of(town.pcd_dir)
    for kept in (tmp_path / "cache/shmmap/objects/cells").glob("*/*"):
        kept.write_bytes(b"damaged")
    assert "is not there" in shmmap("fetch", store, tmp_path / "three", code=66)
    shmmap("fetch", store, tmp_path / "three", "--cache-dir", tmp_path / "none", code=66)


def test_fetched_files_have_every_field_bit_by_bit(
    shmmap: Verbs, town: DividedMap, tmp_path: Path, web: tuple[str, Path]
) -> None:
    url, folder = web
    shmmap("publish", town.root, folder / "town")
    done = shmmap.json("fetch", f"{url}/town", tmp_path / "back")
    assert (done["version"], done["cells"], done["fetched_cells"], done["points"]) == (1, 4, 4, 1200)
    assert files_of(tmp_path / "back/pointcloud_map.pcd") == files_of(town.pcd_dir)
    assert not shmmap.json("publish", tmp_path / "back", folder / "town")["changed"]
    assert "is a map already" in shmmap("fetch", f"{url}/town", tmp_path / "back", code=2)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/thesis").write_text("mine")
    (tmp_path / "link").symlink_to(tmp_path / "back")
    for odd, why in (("mine", "is not a divided map"), ("mine/thesis", "is no"), ("link", "is no")):
        for force in ((), ("--force",)):
            assert why in shmmap("fetch", f"{url}/town", tmp_path / odd, *force, code=2)
    assert (tmp_path / "mine/thesis").read_text() == "mine"
    town.change("0_0.pcd", seed=3)
    shmmap("publish", town.root, folder / "town")
    shmmap("fetch", f"{url}/town", tmp_path / "back", "--force")
    assert files_of(tmp_path / "back/pointcloud_map.pcd") == files_of(town.pcd_dir)
    assert [row["version"] for row in shmmap.json("versions", f"{url}/town")["versions"]] == [2, 1]
    assert "a web server cannot be written to" in shmmap("publish", town.root, f"{url}/town", code=2)
    assert "a web server cannot be written to" in shmmap("versions", f"{url}/town", "--prune", code=2)
    assert not list(tmp_path.glob(".*fetching*"))


def test_a_divided_cloud_keeps_its_frame(shmmap: Verbs, tmp_path: Path) -> None:
    from tests.support.clouds import cloud_file, xyzircaedt

    columns = xyzircaedt(500)
    for axis, shift in (("x", 390_000), ("y", 5_820_000)):
        columns[axis] = columns[axis].astype(np.float64) + shift
    cloud_file(tmp_path / "cloud.pcd", columns)
    shmmap("divide", tmp_path / "cloud.pcd", tmp_path / "divided", "--translate", "auto")
    shmmap("publish", tmp_path / "divided", tmp_path / "store")
    report = json.loads((tmp_path / "divided/shmmap_divide.json").read_bytes())
    read = PublishedMapReader(tmp_path / "store")
    assert any(report["origin"])
    assert read.root["origin"] == report["origin"]
    shmmap("fetch", tmp_path / "store", tmp_path / "back")
    back = json.loads((tmp_path / "back/shmmap_divide.json").read_bytes())
    assert (back["origin"], back["unit_m"]) == (report["origin"], report["unit_m"])
    assert not shmmap.json("publish", tmp_path / "back", tmp_path / "store")["changed"]


@pytest.mark.parametrize("label", ["fetch.cell:3", "fetch.whole", "fetch.renamed"])
def test_a_fetch_that_is_killed_goes_on(
    label: str, shmmap: Verbs, town: DividedMap, store: Path, tmp_path: Path
) -> None:
    out = tmp_path / "back"
    shmmap("fetch", store, out, code=-signal.SIGKILL, env={"SHMMAP_TEST_CRASH": label})
    assert out.exists() == (label == "fetch.renamed")
    if label != "fetch.renamed":
        done = shmmap.json("fetch", store, out)
        assert done["fetched_cells"] <= (0 if label == "fetch.whole" else 3)
    assert files_of(out / "pointcloud_map.pcd") == files_of(town.pcd_dir)


class _Interrupts(NoProgress):
    """Interrupts a fetch when this many cells are there."""

    def __init__(self, cells: int) -> None:
        self._left = cells

    def advance(self, cells: int) -> None:
        self._left -= cells
        if not self._left:
            raise KeyboardInterrupt


@pytest.mark.parametrize("damage", ["cut", "bit", "empty", "another's", "link", "two names", "a folder"])
def test_what_an_interrupted_fetch_left_is_verified(
    damage: str, town: DividedMap, store: Path, tmp_path: Path
) -> None:
    from shmmap.publishing.fetch import fetch_map

    out, aside = tmp_path / "back", tmp_path / "aside"
    with pytest.raises(KeyboardInterrupt):
        fetch_map(open_store(str(store)), str(out), progress=_Interrupts(4))
    cells = tmp_path / ".back.fetching/map/pointcloud_map.pcd"
    cell = cells / "0_0.pcd"
    other = next(path for path in cells.iterdir() if path != cell)
    whole = cell.read_bytes()
    if damage == "cut":
        os.truncate(cell, len(whole) - 16)
    elif damage == "bit":
        cell.write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
    elif damage == "empty":
        os.truncate(cell, 0)
    elif damage == "another's":
        cell.write_bytes(other.read_bytes())
    elif damage == "two names":
        os.link(cell, aside)
    else:
        cell.rename(aside)
        cell.symlink_to(aside) if damage == "link" else cell.mkdir()
    (cells / "0_0.pcd.fetching").write_text("x")
    (cells / "more").symlink_to(tmp_path)
    (cells.parent / "pointcloud_map_metadata.yaml").symlink_to(aside)
    done = fetch_map(open_store(str(store)), str(out), progress=NoProgress())
    assert (done.fetched_cells, done.cells) == (1, 4)
    assert files_of(out / "pointcloud_map.pcd") == files_of(town.pcd_dir)
    assert sorted(os.listdir(out)) == sorted([*os.listdir(town.root), "shmmap_divide.json"])
    assert not aside.exists() or aside.read_bytes() == whole


def test_objects_are_unpacked_within_a_limit(
    store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With room for less than one, they are unpacked one after another."""
    from shmmap.origin.remote.published_object import rows_of
    from shmmap.publishing import fetch

    at_work, most = [0], [0]
    lock = threading.Lock()

    def counted(*arguments: Any) -> Any:
        with lock:
            at_work[0] += 1
            most[0] = max(most[0], at_work[0])
        try:
            return rows_of(*arguments)
        finally:
            with lock:
                at_work[0] -= 1

    monkeypatch.setattr(fetch, "rows_of", counted)
    monkeypatch.setattr(fetch, "memory_left", lambda limit: limit >> 30)
    done = fetch.fetch_map(open_store(str(store)), str(tmp_path / "back"), progress=NoProgress())
    assert (done.fetched_cells, most) == (4, [1])


@pytest.mark.parametrize(("owner", "problem"), [(0, "is a symbolic link"), (OTHER_USER, "belongs to user")])
@pytest.mark.root
def test_a_planted_fetch_is_refused(
    owner: int, problem: str, shmmap: Verbs, town: DividedMap, store: Path, tmp_path: Path
) -> None:
    """In a directory that all may write: cells and a state of this boot, or a link to another directory."""
    shared = tmp_path / "shared"
    shared.mkdir()
    shared.chmod(0o1777)
    place, out = shared / ".back.fetching", shared / "back"
    planted = tmp_path / "victim" if owner == 0 else place
    shutil.copytree(town.root, planted / "map")
    boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    root = json.loads((store / "CURRENT").read_bytes())["root"]
    (planted / "state.json").write_text(json.dumps({"root": root, "boot": boot}))
    (planted / "lock").write_text("")
    if owner:
        os.chown(place, owner, owner)
    else:
        place.symlink_to(planted)
    cells = planted / "map" / "pointcloud_map.pcd"
    before = files_of(cells)
    said = shmmap("fetch", store, out, code=73)
    assert f"{place}: it {problem}" in said
    assert files_of(cells) == before
    assert not out.exists()


def test_what_is_damaged_or_gone_is_not_fetched(shmmap: Verbs, store: Path, tmp_path: Path) -> None:
    blobs = store / "blobs/sha256"
    largest = max(blobs.iterdir(), key=lambda path: path.stat().st_size)
    whole = largest.read_bytes()
    largest.write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
    assert "its SHA-256 is not its name" in shmmap("fetch", store, tmp_path / "back", code=65)
    largest.unlink()
    assert "is not there" in shmmap("fetch", store, tmp_path / "back", code=66)
    assert not (tmp_path / "back").exists()
    largest.write_bytes(whole)
    done = shmmap.json("fetch", store, tmp_path / "back")
    assert done["fetched_cells"] >= 1
    (store / "CURRENT").write_bytes(b"{")
    assert "CURRENT" in shmmap("fetch", store, tmp_path / "other", code=65)
    assert "no map is published" in shmmap("fetch", tmp_path / "nothing", tmp_path / "other", code=66)


# --- wrong usage and what is missing ------------------------------------------------------------------


def test_what_is_wrong_is_said_before_anything_is_sent(
    shmmap: Verbs, town: DividedMap, tmp_path: Path
) -> None:
    store = tmp_path / "store"
    assert "unknown layer 'ntd'" in shmmap("publish", town.root, store, "--layer", "ntd(leaf=2.0)", code=2)
    assert "ids cannot begin with" in shmmap("publish", town.root, store, "--id-prefix", "town", code=2)
    shmmap("publish", tmp_path / "nowhere", store, code=66)
    assert not store.exists()


REMOTE, SIGN = "obstore zstandard", "tuf 'securesystemslib[crypto]'"


@pytest.mark.parametrize(
    ("package", "words", "packages"),
    [
        ("obstore", "publish town s3://maps/town", REMOTE),
        ("zstandard", "publish town s3://maps/town", REMOTE),
        ("tuf", "publish town store --sign keys", SIGN),
        ("cryptography", "publish town store --sign keys", SIGN),
        ("tuf", "versions store --trust ROOT.json", SIGN),
    ],
)
def test_without_a_package_it_says_what_to_install(
    package: str, words: str, packages: str, shmmap: Verbs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(make_map(tmp_path / "town", columns=1, rows=1, points=10).root.parent)
    (tmp_path / "ROOT.json").write_text('{"signed": {"_type": "root"}}')
    errors = shmmap(*words.split(), code=69, env=without(package, tmp_path))
    assert "needs the package" in errors
    assert f"pip install {packages}" in errors
