# SPDX-License-Identifier: Apache-2.0
"""Seams of slices: points out of a published map within bounded memory, and numbers as text."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from pathlib import Path

import pytest

from shmmap.errors import LoadFailed, MapMissing
from tests.support.divided_map import DividedMap, make_map

pytest.importorskip("zstandard", reason="zstandard is not installed")

from shmmap.layers.sources import FILES
from shmmap.origin.map_directory import open_map
from shmmap.origin.remote.map_versions import read_shards, require_current
from shmmap.origin.remote.object_tier import KeptObjects
from shmmap.origin.remote.opened_store import open_store
from shmmap.origin.remote.published_object import LayerSource, pack_source
from shmmap.origin.remote.store import Store
from shmmap.progress import NoProgress
from shmmap.publishing.joining import numbers_text
from shmmap.publishing.messages import PublishSettings
from shmmap.publishing.publish import publish_map
from shmmap.publishing.slice_worker import PublishedPoints
from shmmap.publishing.slicing import read_base
from shmmap.segment.version import Source


@pytest.fixture
def town(tmp_path: Path) -> DividedMap:
    return make_map(tmp_path / "town", columns=2, rows=2, points=300)


@pytest.fixture
def store(tmp_path: Path, town: DividedMap) -> Store:
    made = open_store(str(tmp_path / "store"))
    publish_map(
        open_map(town.root).load(), made, (), settings=PublishSettings(made.url), workers=1,
        progress=NoProgress(),
    )  # fmt: skip
    return made


class CountedObjects(KeptObjects):
    """Counts reads, which wait until they may go on."""

    def __init__(self, store: Store) -> None:
        super().__init__(store, None)
        self.read_objects: list[bytes] = []
        self.may_read = threading.Event()
        self.may_read.set()

    def read(self, digest: bytes, nbytes: int) -> memoryview:
        self.may_read.wait()
        self.read_objects.append(digest)
        return super().read(digest, nbytes)


def cells_of(store: Store) -> dict[str, tuple[Source, tuple[float, float, float, float], int]]:
    """Source, box and size of the object of each cell by name."""
    root = read_base(store, require_current(store)).root
    found = {}
    for shard in read_shards(store, root):
        for row, name in enumerate(shard.names):
            layer = LayerSource(*shard.layers["points"].name(row), 1)
            source = pack_source(shard.id(row, root.id_prefix), {"points": layer})
            found[name.decode()] = source, shard.box(row), layer.size
    return found


@pytest.mark.parametrize("too_few", [0, 1])
def test_cells_of_too_many_points_are_refused(
    store: Store, monkeypatch: pytest.MonkeyPatch, too_few: int
) -> None:
    """By the size of their points in memory, as cells of files are."""
    source, box, _ = next(iter(cells_of(store).values()))
    with ThreadPoolExecutor(2) as threads:
        points = PublishedPoints(KeptObjects(store, None), threads)
        nbytes = sum(column.nbytes for column in points.read(source, box, None).points.columns.values())
        monkeypatch.setattr("shmmap.layers.sources.MAX_SOURCE_BYTES", nbytes - too_few)
        with pytest.raises(LoadFailed, match="a layer is computed of at most") if too_few else nullcontext():
            points.read(source, box, None)


def test_points_are_those_of_the_file(store: Store, town: DividedMap) -> None:
    with ThreadPoolExecutor(2) as threads:
        points = PublishedPoints(KeptObjects(store, None), threads)
        for name, (source, box, _) in cells_of(store).items():
            for needs in (None, ("xyz",)):
                ours = points.read(source, box, needs)
                theirs = FILES.read(Source(town.id(name)), box, needs)
                assert list(ours.points.columns) == list(theirs.points.columns)
                for column, values in theirs.points.columns.items():
                    assert ours.points.columns[column].tobytes() == values.tobytes()
                    assert ours.points.columns[column].dtype == values.dtype
                assert ours.points.units == theirs.points.units
                for field in ("source_points", "dropped_points", "outside_points", "z_min", "z_max"):
                    assert getattr(ours, field) == getattr(theirs, field), field


def test_what_is_held_is_bounded_and_what_was_used_last_stays(store: Store) -> None:
    cells = list(cells_of(store).values())
    size = max(size for _, _, size in cells)
    objects = CountedObjects(store)
    with ThreadPoolExecutor(2) as threads:
        points = PublishedPoints(objects, threads, max_bytes=2 * size)
        objects.may_read.clear()
        points.begin([source for source, _, _ in cells])  # of which two have room
        objects.may_read.set()
        for source, box, _ in cells[:2]:
            points.read(source, box, None)
        assert len(objects.read_objects) == 2
        points.read(cells[0][0], cells[0][1], None)
        points.read(cells[2][0], cells[2][1], None)  # the second goes
        assert len(objects.read_objects) == 3
        points.read(cells[0][0], cells[0][1], None)
        assert len(objects.read_objects) == 3
        points.read(cells[1][0], cells[1][1], None)
        assert len(objects.read_objects) == 4
        alone = PublishedPoints(objects, threads, max_bytes=1)
        alone.begin([cells[0][0]])
        assert len(alone.read(cells[0][0], cells[0][1], None).points.xyz) == 300
        assert len(objects.read_objects) == 5


def test_points_that_are_damaged_or_gone_are_no_points(store: Store, tmp_path: Path) -> None:
    (source, box, _), (other, other_box, _), *_ = cells_of(store).values()
    from shmmap.origin.remote.published_object import unpack_source

    path = tmp_path / "store" / unpack_source(source)["points"].name.path
    whole = path.read_bytes()
    with ThreadPoolExecutor(2) as threads:
        points = PublishedPoints(KeptObjects(store, None), threads)
        path.write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
        with pytest.raises(LoadFailed, match="its SHA-256 is not its name"):
            points.read(source, box, None)
        path.unlink()
        with pytest.raises(MapMissing):
            points.read(source, box, None)
        path.write_bytes(whole)  # nothing of that is remembered
        assert len(points.read(source, box, None).points.xyz) == 300
        assert len(points.read(other, other_box, None).points.xyz) == 300


@pytest.mark.parametrize(
    ("numbers", "text"),
    [([], ""), ([3], "3"), ([3, 7, 8, 9], "3, 7-9"), ([1, 2, 4, 5], "1-2, 4-5"), ([1, 3, 5], "1, 3, 5")],
)
def test_numbers_are_said_compactly(numbers: list[int], text: str) -> None:
    assert numbers_text(numbers) == text
