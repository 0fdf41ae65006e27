# SPDX-License-Identifier: Apache-2.0
"""Layers made by slices and joined: the same bytes as in one go, in any order, killed anywhere."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import signal
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from shmmap.errors import InstanceBusy, MapDataError, ShmmapError
from tests.process.conftest import Meanwhile
from tests.support.command_line import Verbs
from tests.support.daemon_process import ROOT
from tests.support.divided_map import DividedMap, make_map
from tests.support.layer_oracles import install
from tests.support.map_stores import BucketServer
from tests.support.published_maps import PublishedMapReader
from tests.support.skips import open3d_or_skip

pytest.importorskip("zstandard", reason="zstandard is not installed")

import zstandard

from shmmap.origin.remote import map_versions
from shmmap.origin.remote.opened_store import open_store
from shmmap.origin.remote.slice_part import Part, read_run, unpack_part
from shmmap.progress import NoProgress
from shmmap.publishing import joining, prune
from tests.support.message_pack import pack, unpack

LAYERS = ("sample(every=2)", "around(radius=3.0)")
"""Neither is compiled; the second looks into neighbours, as tests.support.offered_kinds makes it."""
DAY_S = 86_400


class Town:
    """A published town of four shards, and the commands that make slices of it."""

    root = map_version = ""
    """Hash of the root, and the map version, of the town that is published with its layers in one go."""

    def __init__(self, folder: Path, made: DividedMap, shmmap: Verbs, kept: Path) -> None:
        self.folder = folder
        self.kept = kept
        self.made = made
        self.url: str | Path = folder / "store"
        self.shmmap = shmmap
        self.environment: dict[str, str] = {}

    @property
    def store(self) -> Path:
        assert isinstance(self.url, Path)
        return self.url

    def publish(self, *layers: str) -> dict[str, Any]:
        return self.shmmap.json(
            "publish", self.made.root, self.url, "--id-prefix", "/t/", *named(layers), env=self.environment
        )

    def slice(self, which: str, *words: str, code: int = 0, **environment: str) -> dict[str, Any]:
        return self.shmmap.json(
            "prepare", self.url, "--shards", which, *(words or named(LAYERS)),
            code=code, env={**self.environment, **environment},
        )  # fmt: skip

    def slices(self, count: int) -> str:
        """Make all slices, the last first, or copy those made before; returns the run."""
        kept = self.kept / f"in {count}"
        if not kept.exists():
            for number in range(count, 0, -1):
                self.slice(f"{number}/{count}")
            shutil.copytree(self.store, self.kept / f"making {count}")
            (self.kept / f"making {count}").rename(kept)
        shutil.copytree(kept, self.store, dirs_exist_ok=True)
        (run,) = (path.name for path in self.store.glob("parts/*"))
        return run

    def join(self, run: str, *words: str | Path) -> dict[str, Any]:
        return self.shmmap.json("publish", self.url, "--join", run, *words, env=self.environment)

    def join_here(self, run: str) -> joining.Joined:
        return joining.join_slices(open_store(str(self.url)), run, progress=NoProgress())

    def refused(self, run: str, code: int) -> str:
        """Error of a join, which has to change nothing."""
        before = self.files()
        with pytest.raises(ShmmapError) as refused:
            self.join_here(run)
        errors = str(refused.value)
        assert refused.value.exit_code == code, errors
        new = self.files().keys() - before.keys()
        assert all(path.startswith(("blobs/", "versions/")) for path in new)  # never served
        assert before.items() <= self.files().items()
        return errors

    def files(self) -> dict[str, bytes]:
        return {
            str(path.relative_to(self.store)): path.read_bytes()
            for path in self.store.rglob("*")
            if path.is_file()
        }

    def parts(self) -> list[str]:
        return sorted(path.name for path in self.store.glob("parts/*/*"))

    def current(self) -> dict[str, Any]:
        found = json.loads((self.store / "CURRENT").read_bytes())
        assert isinstance(found, dict)
        return found


def named(layers: Iterable[str]) -> list[str]:
    return [word for layer in layers for word in ("--layer", layer)]


@pytest.fixture(scope="session")
def _made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str, str]:
    """A folder with the town and kinds of layers, where it is published; root and map version with layers."""
    folder = tmp_path_factory.mktemp("sliced")
    made = make_map(folder / "town", columns=2, rows=2, points=300)
    shmmap = Verbs(folder)
    shmmap.environment["PYTHONPATH"] = f"{install(folder / 'kinds')}:{ROOT}"
    one_go = Town(folder, made, shmmap, folder)
    one_go.url = folder / "one"
    done = one_go.publish(*LAYERS)
    one_go.url = folder / "store"
    one_go.publish()
    return folder, done["root"], done["map_version"]


@pytest.fixture
def town(tmp_path: Path, _made: tuple[Path, str, str], shmmap: Verbs) -> Town:
    """The town, published without layers."""
    folder, _, _ = _made
    shmmap.environment["PYTHONPATH"] = f"{folder / 'kinds'}:{ROOT}"
    made = make_map(tmp_path / "town", columns=2, rows=2, points=300)
    shutil.copytree(folder / "store", tmp_path / "store")
    one = Town(tmp_path, made, shmmap, folder)
    one.root, one.map_version = _made[1:]
    return one


# --- the same bytes -----------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [2, 7])
def test_slices_and_a_join_make_what_one_go_makes(count: int, town: Town) -> None:
    run = town.slices(count)
    assert run.endswith(f"-{count}")
    assert town.parts() == sorted(map(str, range(1, count + 1)))
    assert town.current()["version"] == 1
    done = town.join(run)
    assert (done["changed"], done["version"], done["root"], done["slices"]) == (True, 2, town.root, count)
    assert done["map_version"] == town.map_version
    assert done["layers"] == sorted(["points", "around(radius=3.0)", "sample(every=2)"])
    assert done["objects"] == 12 + 4  # layers of cells, shards
    assert town.parts() == []
    read = PublishedMapReader(town.store)
    assert all(cell.columns["around(radius=3.0)"]["counts"][1] > 0 for cell in read.cells.values())
    again = town.shmmap("publish", town.url, "--join", run, code=66)
    assert "of a joined run none is left" in again


def test_in_a_bucket_nothing_is_sent_twice(town: Town, buckets: BucketServer) -> None:
    town.url, town.environment = buckets.url("sliced"), buckets.environment
    town.publish()
    buckets.requests()
    first = town.slice("2/2")
    assert (first["there"], first["cells"], first["made"], first["sent_objects"]) == (False, 2, 4, 6)
    received = [path.removeprefix("/maps/sliced/") for path in buckets.received()]
    assert received[-1] == f"parts/{first['run']}/2"
    assert [path[:13] for path in received[:-1]] == ["blobs/sha256/"] * 6
    again = town.slice("2/2")
    assert (again["there"], again["made"], again["sent_objects"]) == (True, 0, 0)
    assert buckets.received() == []
    run = town.slice("1/2")["run"]
    buckets.requests()
    assert town.join_here(run).root == town.root
    received = [path.removeprefix("/maps/sliced/") for path in buckets.received()]
    assert [received[0][:13], *received[1:]] == ["blobs/sha256/", "versions/2.json", "CURRENT"]
    asked = {path for method, path, _, _ in buckets.requests() if method == "GET"}
    assert not [path for path in asked if "/parts/" in path]


def test_layers_of_all_kinds_of_points_in_millimetres_too(town: Town) -> None:
    """Halos whose order matters, cells without points, points outside their box, some that stay exact."""
    open3d_or_skip()
    empty = {name: values[:0] for name, values in town.made.points("0_0.pcd").items()}
    town.made.write_cell("20_0.pcd", (20, 0), empty)
    wide = town.made.points("0_0.pcd")
    wide["z"][0], wide["x"][1] = 80.0, 31.0
    town.made.write_cell("0_0.pcd", town.made.corners["0_0.pcd"], wide)
    town.made.write_metadata()
    layers = ("normals(radius=2.0)", "denoise(neighbors=5,halo=2.0)", "sample(count=50)")
    for encoding in ("exact", "mm"):
        urls = [town.folder / f"{how}-{encoding}" for how in ("one", "two")]
        options = ("--encoding", encoding, "--id-prefix", "/t/")
        one = town.shmmap.json("publish", town.made.root, urls[0], *options, *named(layers))
        town.shmmap("publish", town.made.root, urls[1], *options)
        town.url = urls[1]
        for number in (1, 2, 3):
            run = town.slice(f"{number}/3", *named(layers))["run"]
        assert town.join(run)["root"] == one["root"]


def test_layers_that_are_there_are_kept(town: Town) -> None:
    first = town.slice("1/1", *named(LAYERS[:1]))
    town.join_here(first["run"])
    second = town.slice("1/1")
    assert (second["kept"], second["made"]) == (4, 4)
    assert town.join_here(second["run"]).root == town.root
    third = town.slice("1/1")
    assert (third["version"], third["kept"], third["made"], third["sent_objects"]) == (3, 8, 0, 0)
    done = town.join(third["run"])
    assert (done["changed"], done["version"], done["root"]) == (False, 3, town.root)
    assert town.parts() == []
    assert town.current()["version"] == 3


def test_a_layer_of_another_builder_is_made_again(town: Town) -> None:
    town.join_here(town.slices(1))
    done = town.slice("1/1", PYTHONPATH=other_builder(town))
    assert (done["kept"], done["made"]) == (4, 4)
    town.join_here(done["run"])
    assert PublishedMapReader(town.store).root["layers"]["around(radius=3.0)"] == 2


def other_builder(town: Town) -> str:
    """A module path on which the kind of layer has a later builder."""
    folder = town.folder / "newer"
    path = install(folder)
    module = folder / "offered_kinds.py"
    module.write_text(module.read_text().replace("builder_version=1", "builder_version=2"))
    return f"{path}:{ROOT}"


# --- what cannot be joined ----------------------------------------------------------------------------


def test_missing_slices_are_named(town: Town) -> None:
    run = town.slices(7)
    for number in (1, 3, 4, 5):
        (town.store / f"parts/{run}/{number}").unlink()
    errors = town.refused(run, 66)
    assert "slices 1, 3-5 of 7 are not made yet" in errors
    assert "--shards 1/7" in errors
    assert "no slice of run 0123456789abcdef-4" in town.refused("0123456789abcdef-4", 66)


def test_a_run_of_another_version_is_refused(town: Town) -> None:
    run = town.slices(2)
    town.made.change("0_0.pcd", 5)
    town.publish()
    errors = town.refused(run, 2)
    assert f"run {run} was made from version 1, version 2 is current" in errors
    # once that content is current again, it is the same run
    town.shmmap("versions", town.url, "--rollback", "1")
    assert town.join_here(run).version == 4
    PublishedMapReader(town.store)


def test_slices_of_different_builders_are_refused(town: Town) -> None:
    run = town.slices(2)
    newer = other_builder(town)
    assert town.slice("2/2", PYTHONPATH=newer)["run"] == run
    errors = town.refused(run, 65)
    assert "around(radius=3.0) of slices 2 of 2 is of builder version 2, of slice 1 of 1" in errors
    town.slice("1/2", PYTHONPATH=newer)
    town.join_here(run)
    assert PublishedMapReader(town.store).root["layers"]["around(radius=3.0)"] == 2


def test_what_is_gone_or_old_is_named_and_made_again(town: Town) -> None:
    before = set((town.store / "blobs/sha256").iterdir())
    run = town.slice("1/2")["run"]
    new = sorted(set((town.store / "blobs/sha256").iterdir()) - before)
    town.slice("2/2")
    kept = {path: path.read_bytes() for path in (town.store / "blobs/sha256").iterdir()}
    shards = {row.tobytes().hex() for part in parts_of(town, run) for row in part.hashes}
    layer = next(path for path in new if path.name not in shards)
    os.utime(layer, (1, 1))
    assert "1 objects of slices 1 of 2 are not there, or older than six days" in town.refused(run, 65)
    layer.unlink()
    assert "1 objects of slices 1 of 2" in town.refused(run, 65)
    layer.write_bytes(kept[layer])
    next(path for path in new if path.name in shards).unlink()
    town.refused(run, 66)
    assert town.slice("1/2")["there"] is False
    assert town.slice("1/2")["there"] is True
    for days in (3, 5):
        for path in set((town.store / "blobs/sha256").iterdir()) - before:
            age = time.time() - days * DAY_S
            os.utime(path, (age, age))
        assert town.slice("1/2")["there"] == (days < 4)
    assert town.join_here(run).root == town.root


def test_objects_of_the_version_itself_are_looked_for(town: Town) -> None:
    run = town.slice("1/1", *named(LAYERS[:1]))["run"]
    largest = max((town.store / "blobs/sha256").iterdir(), key=lambda path: path.stat().st_size)
    largest.unlink()
    assert "1 objects of version 1 are not there" in town.refused(run, 65)


def test_a_cell_that_cannot_be_made_makes_no_slice(town: Town) -> None:
    failed = town.slice("1/1", *named(["broken(how=1)", *LAYERS]), code=1)
    assert {one["layer"].split("(")[0] for one in failed["failed"]} >= {"broken"}
    assert len(failed["failed"]) == 4
    assert town.parts() == []


# --- killed -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("label", ["slice.shard", "slice.shard:3", "slice.part", "slice.made"])
def test_a_slice_that_is_killed_is_made_by_the_same_command(label: str, town: Town) -> None:
    words = ("prepare", town.url, "--shards", "1/1", *named(LAYERS))
    town.shmmap(*words, code=-signal.SIGKILL, env={"SHMMAP_TEST_CRASH": label})
    PublishedMapReader(town.store)
    assert town.parts() == (["1"] if label == "slice.made" else [])
    again = town.slice("1/1")
    assert again["there"] == (label == "slice.made")
    assert town.join_here(again["run"]).root == town.root


def test_workers_that_are_killed_cost_nothing(town: Town, tmp_path: Path) -> None:
    died = tmp_path / "died"
    done = town.slice("1/1", SHMMAP_TEST_CRASH=f"publish.send:3:{died}")
    assert died.exists()
    assert done["made"] == 8
    assert town.join_here(done["run"]).root == town.root


def test_what_was_computed_is_not_computed_or_fetched_again(town: Town, buckets: BucketServer) -> None:
    town.url, town.environment = buckets.url("resumed"), buckets.environment
    town.publish()
    points = {
        path for method, path, _, _ in buckets.requests() if method == "PUT" and "/resumed/blobs/" in path
    }
    words = ("prepare", town.url, "--shards", "1/1", *named(LAYERS))
    town.shmmap(*words, code=-signal.SIGKILL, env={**town.environment, "SHMMAP_TEST_CRASH": "slice.part"})
    shutil.rmtree(town.folder / "cache/shmmap/objects")
    buckets.requests()
    done = town.slice("1/1")
    asked = buckets.requests()
    fetched = {path for method, path, _, _ in asked if method == "GET" and path in points}
    assert len(fetched) == 5  # root and shards: no cell
    put = [path for method, path, _, _ in asked if method == "PUT"]
    assert put == [*4 * ["/maps/resumed/conditions.json"], f"/maps/resumed/parts/{done['run']}/1"]
    assert (done["made"], done["sent_objects"]) == (8, 0)
    assert town.join_here(done["run"]).root == town.root


JOIN_STEPS = (
    "join.root", "join.entry", "join.looked", "version.switch", "version.switched", "join.part",
)  # fmt: skip


@pytest.mark.parametrize("label", [*JOIN_STEPS, "join.part:3"])
def test_a_join_that_is_killed_is_finished_by_the_same_command(label: str, town: Town) -> None:
    run = town.slices(7)  # some of which have no shard
    before = town.current()["root"]
    words = ("publish", town.url, "--join", run)
    town.shmmap(*words, code=-signal.SIGKILL, env={"SHMMAP_TEST_CRASH": label})
    switched = label == "version.switched" or label.startswith("join.part")
    assert PublishedMapReader(town.store).current["root"] == (town.root if switched else before)
    done = town.join(run)
    assert (done["changed"], done["root"]) == (not switched, town.root)
    assert PublishedMapReader(town.store).current["root"] == town.root
    assert town.parts() == []


# --- two at a time ------------------------------------------------------------------------------------


@pytest.mark.parametrize("label", [*JOIN_STEPS, "publish.send", "in a bucket"])
def test_of_two_joins_one_wins_and_the_other_learns_it(
    label: str, town: Town, buckets: BucketServer, meanwhile: Meanwhile
) -> None:
    if label == "in a bucket":
        town.url, town.environment = buckets.url("joined"), buckets.environment
        town.publish()
        run = town.slice("1/1")["run"]
        outcome = meanwhile("join.looked", lambda: town.join_here(run))
    else:
        run = town.slices(2)
        outcome = meanwhile(label, lambda: town.join_here(run))
    is_late = label in ("version.switched", "join.part")
    if is_late:
        assert town.join_here(run).version == 2
    else:
        with pytest.raises(InstanceBusy, match="another publisher has changed"):
            town.join_here(run)
    (other,) = outcome
    assert isinstance(other, joining.Joined)
    assert (other.version is None) == is_late
    store = open_store(str(town.url))
    assert map_versions.require_current(store).root == town.root
    assert list(store.list("parts/")) == []


@pytest.mark.parametrize("label", JOIN_STEPS[:5])
def test_of_a_join_and_a_publisher_one_wins(label: str, town: Town, meanwhile: Meanwhile) -> None:
    run = town.slices(2)
    town.made.change("0_0.pcd", 5)
    meanwhile(label, town.publish)
    if label == "version.switched":
        assert town.join_here(run).root == town.root
        assert town.current()["version"] == 3
    else:
        with pytest.raises(InstanceBusy):
            town.join_here(run)
        assert town.current()["root"] != town.root
        assert town.parts() == ["1", "2"]
    PublishedMapReader(town.store)


@pytest.mark.parametrize("label", JOIN_STEPS[:5])
def test_pruning_meanwhile_takes_nothing_that_is_served(label: str, town: Town, meanwhile: Meanwhile) -> None:
    """All objects that slices have sent are old enough to be pruned."""
    before = set((town.store / "blobs/sha256").iterdir())
    run = town.slices(2)
    for path in {*(town.store / "blobs/sha256").iterdir()} - before:
        os.utime(path, (1, 1))

    def act() -> object:
        return prune.prune_versions(open_store(str(town.url)), keep_days=7, progress=NoProgress())

    outcome = meanwhile(label, act)
    with pytest.raises(ShmmapError) as refused:
        town.join_here(run)
    assert refused.value.code in (MapDataError.code, "map_missing")
    assert all(isinstance(one, prune.Pruned) for one in outcome)
    assert PublishedMapReader(town.store).current["version"] == 1
    for number in (1, 2):
        town.slice(f"{number}/2")
    assert town.join_here(run).root == town.root


# --- parts of others ----------------------------------------------------------------------------------


def parts_of(town: Town, run: str) -> list[Part]:
    name = read_run(run)
    return [
        unpack_part((town.store / f"parts/{run}/{number}").read_bytes(), name, number)
        for number in range(1, name.slices + 1)
    ]


def altered_part(town: Town, run: str, number: int, **changes: Any) -> None:
    """Write a part again, with other fields."""
    path = town.store / f"parts/{run}/{number}"
    found = unpack(zstandard.ZstdDecompressor().decompress(path.read_bytes()))
    path.write_bytes(zstandard.ZstdCompressor().compress(pack({**found, **changes})))


def altered_shard(town: Town, run: str, number: int, change: Callable[[dict[str, Any]], None]) -> None:
    """Have a part name another object for its first shard."""
    part = parts_of(town, run)[number - 1]
    old = town.store / "blobs/sha256" / part.hashes[0].tobytes().hex()
    found = unpack(zstandard.ZstdDecompressor().decompress(old.read_bytes()))
    change(found)
    frame = zstandard.ZstdCompressor().compress(pack(found))
    digest = hashlib.sha256(frame).digest()
    (town.store / "blobs/sha256" / digest.hex()).write_bytes(frame)
    hashes = digest + part.hashes[1:].tobytes()
    sizes = np.array([len(frame), *part.sizes[1:]], "<u4").tobytes()
    altered_part(town, run, number, shard_sha256=hashes, shard_bytes=sizes)


def test_a_part_that_is_not_what_its_slice_makes_is_refused(town: Town) -> None:
    run = town.slices(2)
    folder = town.store / f"parts/{run}"
    whole = {path.name: path.read_bytes() for path in folder.iterdir()}
    _, second = parts_of(town, run)

    def refused(why: str, code: int = 65) -> None:
        assert why in town.refused(run, code)
        for name, data in whole.items():
            (folder / name).write_bytes(data)

    (folder / "2").write_bytes(whole["1"])
    refused("it is slice 1 of 2, not 2 of 2")
    (folder / "1").write_bytes(b"half")
    refused("make slice 1 again")
    altered_part(town, run, 1, shard_keys=second.keys.tobytes())
    refused("its shards are not those of slice 1 of 2")
    altered_part(town, run, 1, shard_sha256=second.hashes.tobytes(), shard_bytes=second.sizes.tobytes())
    refused("in another shard")
    (folder / "1").write_bytes(bytes(17 << 20))
    refused("at most 16,777,216 are read")
    (folder / "3").write_bytes(whole["1"])  # none of this run
    (folder / ".1.writing").write_bytes(b"")
    assert town.join_here(run).root == town.root


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda shard: shard.update(names=b"../../etc/x"), "its names are not those"),
        (lambda shard: shard.update(names=b"another.pcd"), "a shard has other cells than the version has"),
        (lambda shard: shard.update(z=bytes(16)), "a shard has other cells than the version has"),
        (lambda shard: shard["layers"]["points"].update(sha256=bytes(32)), "has another layer points"),
        (lambda shard: shard["layers"].pop("sample(every=2)"), "its layers are not the root's"),
        (lambda shard: shard["layers"]["sample(every=2)"].update(sha256=bytes(32)), "of slices 1 of 2"),
        (lambda shard: shard["layers"]["sample(every=2)"].update(size=b"\1\0\0\0"), "of slices 1 of 2"),
        (lambda shard: shard["layers"]["sample(every=2)"].update(raw_size=b"\xff" * 4), "out of range"),
    ],
)  # fmt: skip
def test_a_shard_that_says_something_else_is_refused(
    change: Callable[[dict[str, Any]], None], why: str, town: Town
) -> None:
    run = town.slices(2)
    altered_shard(town, run, 1, change)
    assert why in town.refused(run, 65)
    assert town.slice("1/2")["there"] is False
    assert town.join_here(run).root == town.root


def test_a_part_that_is_no_part_is_replaced(town: Town) -> None:
    run = town.slices(1)
    part = town.store / f"parts/{run}/1"
    whole = part.read_bytes()
    for data in (b"", b"no part", bytes(17 << 20)):
        part.write_bytes(data)
        assert town.slice("1/1")["there"] is False
        assert part.read_bytes() == whole
    altered_part(town, run, 1, version=9)  # of the same content: it need not be made again
    assert town.slice("1/1")["there"] is True
    assert town.join_here(run).root == town.root


# --- signed, pruned, wrong usage ----------------------------------------------------------------------


def test_a_signed_map_is_joined_with_its_keys(town: Town) -> None:
    pytest.importorskip("tuf", reason="tuf is not installed")
    from tests.support.published_maps import read_signed

    keys = town.folder / "keys"
    town.shmmap("publish", town.made.root, town.url, "--sign", keys)
    state = {"XDG_STATE_HOME": str(town.folder / "state")}
    trusted = ("--trust", str(keys / "ROOT.json"), *named(LAYERS))
    run = town.slice("1/2", *trusted, XDG_STATE_HOME=state["XDG_STATE_HOME"])["run"]
    assert town.slice("2/2")["run"] == run
    assert "is signed" in town.refused(run, 2)
    done = town.join(run, "--sign", keys)
    assert (done["changed"], done["root"]) == (True, town.root)
    assert read_signed(town.store, keys).version == done["version"] == 2
    again = town.slice("1/1")["run"]
    assert not town.join(again, "--sign", keys)["changed"]
    (town.store / "timestamp.json").write_bytes(b"{}")
    errors = town.shmmap("prepare", town.url, "--shards", "1/2", *trusted, code=65, env=state)
    assert str(town.url) in errors


@pytest.mark.parametrize("label", ["sign.metadata", "sign.timestamp", "sign.signed", "sign.switch"])
def test_a_join_that_is_killed_while_it_signs_is_finished(label: str, town: Town) -> None:
    pytest.importorskip("tuf", reason="tuf is not installed")
    from tests.support.published_maps import read_signed

    run, keys = town.slices(2), town.folder / "keys"
    town.shmmap("publish", town.made.root, town.url, "--sign", keys)
    words = ("publish", town.url, "--join", run, "--sign", keys)
    town.shmmap(*words, code=-signal.SIGKILL, env={"SHMMAP_TEST_CRASH": label})
    assert PublishedMapReader(town.store).current["version"] == 1
    done = town.join(run, "--sign", keys)
    assert done["changed"] == (label in ("sign.metadata", "sign.timestamp"))
    assert (done["root"], PublishedMapReader(town.store).current["root"]) == (town.root, town.root)
    assert read_signed(town.store, keys).version == done["version"]
    assert town.parts() == []


def test_pruning_removes_parts_that_are_old(town: Town) -> None:
    run = town.slices(3)
    parts = [town.store / f"parts/{run}/{number}" for number in (1, 2, 3)]
    for path, days in zip(parts, (40, 8, 6), strict=True):
        age = path.stat().st_mtime - days * DAY_S
        os.utime(path, (age, age))
    assert town.shmmap.json("versions", town.url, "--prune")["parts"] == 1
    assert town.parts() == ["2", "3"]
    assert "1 part of slices that were never joined" in town.shmmap(
        "versions", town.url, "--prune", "--keep", "7"
    )
    assert town.parts() == ["3"]
    words = ("versions", town.url, "--prune", "--keep", "7")
    os.utime(parts[2], (1, 1))
    town.shmmap(*words, code=-signal.SIGKILL, env={"SHMMAP_TEST_CRASH": "prune.part"})
    assert town.shmmap.json(*words)["parts"] == 1
    PublishedMapReader(town.store)


def test_wrong_usage_says_what_is_right(town: Town, tmp_path: Path) -> None:
    def says(*words: str | Path, code: int = 2) -> str:
        return town.shmmap(*words, code=code)

    layer = named(LAYERS[:1])
    for which in ("0/3", "4/3", "1", "1/0", "a/b", "-1/3", "1/1000000"):
        assert "expected I/N" in says("prepare", town.url, f"--shards={which}", *layer)
    assert "there is no slice" in says("prepare", town.url, "--shards", "1/999999", *layer)
    assert "--shards 1/1 is all of it" in says("prepare", f"file://{town.url}", *layer)
    assert "--shards 1/1 is all of it" in says("prepare", str(town.store), *layer)
    assert "name at least one layer" in says("prepare", town.url, "--shards", "1/2")
    assert "name at least one layer" in says("prepare", town.url, "--shards", "1/2", "--layer", "points")
    assert "unknown layer" in says("prepare", town.url, "--shards", "1/2", "--layer", "ntd")
    assert "--trust goes with --shards" in says("prepare", town.made.root, "--trust", "r.json", *layer)
    assert "no map is published" in says("prepare", tmp_path / "no", "--shards", "1/2", *layer, code=66)
    assert "no map is published" in says("publish", tmp_path / "no", "--join", f"{'0' * 16}-2", code=66)
    assert "is no name of a run" in says("publish", town.url, "--join", "../../etc")
    assert "--join takes no MAP" in says("publish", town.made.root, town.url, "--join", f"{'0' * 16}-2")
    assert "--layer does not go" in says("publish", town.url, "--join", f"{'0' * 16}-2", *layer)
    assert "--unit does not go" in says("prepare", town.url, "--shards", "1/2", "--unit", "ft", *layer)
    assert "URL" in says("publish", town.made.root)


def test_a_web_server_takes_no_slices(town: Town, web: tuple[str, Path]) -> None:
    url, folder = web
    shutil.copytree(town.store, folder / "town")
    for words in (
        ("prepare", f"{url}/town", "--shards", "1/1", *named(LAYERS)),
        ("publish", f"{url}/town", "--join", f"{'0' * 16}-2"),
    ):
        assert "a web server cannot be written to" in town.shmmap(*words, code=2)


def test_without_a_cache_nothing_is_kept_on_the_disk(town: Town) -> None:
    shutil.rmtree(town.folder / "cache", ignore_errors=True)
    run = town.slice("1/1", "--cache-size", "0", *named(LAYERS))["run"]
    assert not list((town.folder / "cache").rglob("*.layer"))
    assert not (town.folder / "cache/shmmap/objects").exists()
    assert town.join_here(run).root == town.root
