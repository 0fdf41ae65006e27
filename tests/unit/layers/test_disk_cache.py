# SPDX-License-Identifier: Apache-2.0
"""The disk cache: the same bytes back, nothing damaged or foreign served, never more than its limit."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from shmmap.errors import CannotWrite
from shmmap.formats.source_file import refusal
from shmmap.layers import sources
from shmmap.layers.build import Made, cache_key, make_layer
from shmmap.layers.contract import Box
from shmmap.layers.disk_cache import CacheKey, LayerCache, _version_path
from shmmap.layers.sources import CellJob, CellSource, Neighbour
from shmmap.layers.spec import parse_layer
from shmmap.segment.layout import SourceStamp
from shmmap.segment.version import Source
from tests.support.divided_map import random_points, write_pcd
from tests.support.skips import open3d_or_skip

BOX = (0.0, 0.0, 20.0, 20.0)
LAYERS = ["points", "ndt(leaf=2.0,min_points=3)", "voxel(leaf=0.5)", "elevation(resolution=1.0)"]


def version_file(one: Bench, key: CacheKey) -> Path:
    return Path(one.cache.directory, _version_path(key))


class Bench:
    """One cell, one cache, and segments in memory."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self.cache = LayerCache(str(directory / "cache"), limit_bytes=1 << 30)
        self.path = directory / "cell.pcd"
        self.write(300)

    def write(self, points: int) -> None:
        write_pcd(self.path, random_points(np.random.default_rng(points), (0, 0), points))

    @property
    def job(self) -> CellJob:
        return CellJob(str(self.path), Source(str(self.path)), BOX)

    def make(self, layer: str, job: CellJob | None = None) -> tuple[Made, bytes]:
        """One layer as a loader makes it, and its bytes."""
        fd = os.memfd_create("segment")
        try:
            made = make_layer(parse_layer(layer), job or self.job, fd, cache=self.cache, keep=True)
            return made, os.pread(fd, os.fstat(fd).st_size, 0)
        finally:
            os.close(fd)

    def key(self, layer: str) -> CacheKey:
        key = cache_key(parse_layer(layer), self.job)
        assert key is not None
        return key

    def files(self) -> list[Path]:
        return sorted((self.directory / "cache").rglob("*.layer"))


@pytest.fixture
def one(tmp_path: Path) -> Bench:
    return Bench(tmp_path)


@pytest.mark.parametrize("layer", LAYERS)
def test_the_same_bytes_come_back(one: Bench, layer: str) -> None:
    built, first = one.make(layer)
    assert not built.cached
    found, again = one.make(layer)
    assert found.cached
    assert again == first
    assert repr(found.header) == repr(built.header)
    state = version_file(one, one.key(layer))
    assert state.read_bytes() == first  # a prepared file has the segment's bytes, its publish block empty
    assert len(one.files()) == 2


def test_layers_and_states_are_apart(one: Bench) -> None:
    for layer in LAYERS:
        one.make(layer)
    assert len(one.files()) == 2 * len(LAYERS)
    one.write(301)
    for layer in LAYERS:
        assert not one.make(layer)[0].cached
        assert one.make(layer)[0].cached
    key = one.key(LAYERS[1])
    assert not one.cache.has(replace(key, job=replace(key.job, box=(0.0, 0.0, 20.0, 21.0))))
    newer = replace(key.spec, kind=replace(key.spec.kind, builder_version=2))
    assert not one.cache.has(replace(key, spec=newer))


def test_any_damage_is_noticed_and_built_again(one: Bench) -> None:
    layer = "ndt(leaf=4.0,min_points=3)"
    _, true = one.make(layer)
    size = len(true)
    rng = np.random.default_rng(2)
    columns = one.make(layer)[0].header.columns
    inside = [at for c in columns for at in range(c.offset, c.offset + c.nbytes)]
    places = [*range(0, 288, 37), 4095 - 70, *rng.choice(inside, 20).tolist()]
    for at in places:
        state = version_file(one, one.key(layer))
        with state.open("r+b") as file:
            file.seek(at)
            byte = file.read(1)
            file.seek(at)
            file.write(bytes([byte[0] ^ 0x20]))
        made, data = one.make(layer)
        assert not made.cached, at
        assert data == true, at
        assert one.make(layer)[0].cached
    for length in (0, 100, 4096, size - 1):
        state = version_file(one, one.key(layer))
        os.truncate(state, length)
        made, data = one.make(layer)
        # what lies after the last column is padding
        assert made.cached is False or length >= columns[-1].offset + columns[-1].nbytes
        assert data[: len(true)] == true


def test_what_others_could_have_written_is_not_used(one: Bench) -> None:
    layer = LAYERS[1]
    _, true = one.make(layer)
    state = version_file(one, one.key(layer))
    os.chmod(state, 0o666)
    made, data = one.make(layer)
    assert not made.cached
    assert data == true
    outside = one.directory / "elsewhere.layer"
    shutil.move(state, outside)
    os.symlink(outside, state)
    assert not one.cache.has(one.key(layer))


def test_another_cell_s_entry_in_its_place_is_not_used(one: Bench) -> None:
    """All its checksums are right."""
    layer = LAYERS[1]
    _, true = one.make(layer)
    there = replace(one.job, box=(20.0, 0.0, 40.0, 20.0))
    one.make(layer, there)
    key, other = one.key(layer), cache_key(parse_layer(layer), there)
    assert other is not None
    shutil.copyfile(version_file(one, other), version_file(one, key))
    assert not one.cache.has(key)
    made, data = one.make(layer)
    assert not made.cached
    assert data == true


@pytest.mark.parametrize("kind", ["link", "writable"])
def test_a_directory_that_may_be_another_account_s_is_not_used(one: Bench, kind: str) -> None:
    """Nothing is read, written or removed there; an entry whose file is a pipe does not block."""
    key, aside = one.key(LAYERS[1]), one.directory / "aside"
    one.make(LAYERS[1])
    one.cache.make()
    place = Path(one.cache.directory)
    if kind == "link":
        place.rename(aside)
        place.symlink_to(aside)
    else:
        place.chmod(0o777)
    before = sorted(place.rglob("*"))
    assert not one.cache.has(key)
    with pytest.raises(CannotWrite, match="layers cannot be kept"):
        one.cache.make()
    assert one.cache.is_empty
    assert LayerCache(str(place.parent), limit_bytes=1).budget.trim() == 0
    assert not one.make(LAYERS[1])[0].cached
    assert sorted(place.rglob("*")) == before
    if kind == "link":
        place.unlink()
        aside.rename(place)
    place.chmod(0o755)
    assert one.cache.has(key)
    version_file(one, key).unlink()
    os.mkfifo(version_file(one, key))
    assert not one.cache.has(key)


@pytest.mark.root
def test_another_account_s_file_is_not_used(one: Bench) -> None:
    one.make(LAYERS[1])
    os.chown(version_file(one, one.key(LAYERS[1])), 12345, -1)
    assert not one.cache.has(one.key(LAYERS[1]))


def test_a_copied_map_is_recognised_by_content(one: Bench) -> None:
    _, first = one.make(LAYERS[1])
    digest = one.make(LAYERS[1])[0].header.source_digest
    moved = one.directory / "moved.pcd"
    shutil.copy(one.path, moved)
    job = CellJob(str(moved), Source(str(moved)), BOX)
    key = cache_key(parse_layer(LAYERS[1]), job)
    assert key is not None
    assert not one.cache.has(key)
    assert not one.cache.recognise(replace(key, job=replace(key.job, box=(0.0, 0.0, 1.0, 1.0))), digest)
    assert not one.cache.recognise(key, bytes(16))
    assert one.cache.recognise(key, digest)
    made, data = one.make(LAYERS[1], job)
    assert made.cached
    # the header names the new cell and its state, everything else is the same
    assert (made.header.cell_id, made.header.source) == (str(moved), SourceStamp.of(os.stat(moved)))
    assert data[made.header.header_bytes :] == first[made.header.header_bytes :]
    fresh = LayerCache(str(one.directory / "other"), limit_bytes=1 << 30)
    one.cache = fresh
    rebuilt, built = one.make(LAYERS[1], job)
    assert not rebuilt.cached
    assert built == data


def test_an_id_that_needs_a_longer_header_is_built(one: Bench) -> None:
    one.make(LAYERS[1])
    digest = one.make(LAYERS[1])[0].header.source_digest
    job = replace(one.job, cell_id="/" + "long" * 1000)
    key = cache_key(parse_layer(LAYERS[1]), job)
    assert key is not None
    assert one.cache.recognise(key, digest)
    made, _ = one.make(LAYERS[1], job)
    assert not made.cached
    assert made.header.header_bytes == 8192


def test_a_neighbour_that_changes_while_it_is_read_is_built_with_later(
    one: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    open3d_or_skip()
    layer = "normals(radius=5.0)"
    near = one.directory / "near.pcd"
    write_pcd(near, random_points(np.random.default_rng(1), (20, 0), 200))
    before = SourceStamp.of(os.stat(near))
    job = replace(one.job, neighbours=(Neighbour(Source(str(near)), (20.0, 0.0, 40.0, 20.0)),))
    read_source = sources.read_source

    def rewritten_meanwhile(path: str, box: Box, needs: Sequence[str] | None) -> CellSource:
        if path != str(near):
            return read_source(path, box, needs)
        write_pcd(near, random_points(np.random.default_rng(2), (20, 0), 201))
        raise refusal("changed", "the file changed while it was being read", path=path)

    monkeypatch.setattr(sources, "read_source", rewritten_meanwhile)
    made, without = one.make(layer, job)
    assert made.neighbours == (before,)  # what it knows nothing of is not the neighbour's new state
    monkeypatch.setattr(sources, "read_source", read_source)
    made, data = one.make(layer, job)
    assert not made.cached
    assert made.neighbours == (SourceStamp.of(os.stat(near)),)
    assert data != without
    assert one.make(layer, job)[0].cached


def test_the_least_recently_used_go_first(one: Bench) -> None:
    sizes = {}
    for number, layer in enumerate(LAYERS):
        one.make(layer)
        file = version_file(one, one.key(layer))
        sizes[layer] = os.stat(file).st_blocks * 512
        os.utime(file, (number, number))
    interim = Path(one.cache.directory) / ".new-killed"
    interim.write_bytes(b"half")
    os.utime(interim, (1, 1))
    fresh = Path(one.cache.directory) / ".new-running"
    fresh.write_bytes(b"half")
    one.cache.budget.limit_bytes = sum(sizes.values()) - 1
    assert one.cache.budget.trim() == sum(sizes.values()) - sizes[LAYERS[0]]
    assert [one.cache.has(one.key(layer)) for layer in LAYERS] == [False, True, True, True]
    assert not interim.exists()
    assert fresh.exists()
    assert len(one.files()) == 6  # both names of what went are gone
    one.cache.budget.limit_bytes = 0
    assert one.cache.budget.trim() == 0
    assert one.files() == []


def test_what_is_larger_than_the_limit_is_not_stored(one: Bench) -> None:
    one.cache.budget.limit_bytes = 5000
    made, _ = one.make(LAYERS[1])
    assert not made.cached
    assert one.files() == []


def test_trims_as_it_grows(one: Bench) -> None:
    one.cache.budget.limit_bytes = 60_000
    for points in range(300, 330):
        one.write(points)
        one.make("voxel(leaf=0.5)")
    stored = sum(path.stat().st_size for path in one.files()) // 2
    assert 0 < stored <= 60_000 + 60_000 // 16 + 20_000


def test_a_cache_that_cannot_be_written_costs_nothing(one: Bench) -> None:
    (one.directory / "cache").write_text("a file where the directory should be")
    made, _ = one.make(LAYERS[1])
    assert made.header.rows > 0
    assert not one.cache.has(one.key(LAYERS[1]))
    assert one.cache.is_empty
