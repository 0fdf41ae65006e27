# SPDX-License-Identifier: Apache-2.0
"""A published map's list of cells by shards: what it answers, beside tables of all its cells."""

from __future__ import annotations

import gc
import select
import time
import weakref
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any, cast

import numpy as np
import pytest

from shmmap.errors import BadRequest, MapDataError
from shmmap.geometry import Area, AutowareSquare, Box, Circle
from shmmap.origin.catalogue import Catalogue
from shmmap.processes.request_threads import have_ended
from shmmap.segment.version import cell_version, layer_version
from tests.support.daemon_process import Deadline
from tests.support.map_stores import MemoryStore

pytest.importorskip("zstandard", reason="zstandard is not installed")

from shmmap.daemon.map.arrivals import Arrivals
from shmmap.daemon.map.published_view import PublishedView
from shmmap.daemon.map.shard_pages import BACKGROUND_FETCHES, FEW_SHARDS, THREADS, ShardFetcher, ShardPages
from shmmap.layers.spec import layer_spec
from shmmap.origin.remote.map_versions import read_shard_object
from shmmap.origin.remote.published_index import (
    Root,
    map_version_of,
    pack_root,
    pack_shard,
    published_layer_version,
    unpack_root,
    unpack_shard,
)
from shmmap.origin.remote.published_object import blob_path, stamp_of, unpack_source
from shmmap.origin.remote.store import Store
from shmmap.origin.remote.zstd_frame import pack_frame
from shmmap.publishing.messages import CellSent, LayerSent
from shmmap.publishing.shards import CellObjects, divide_into_shards

VOXELS = "voxel(leaf=1.0)"
OURS = layer_spec(VOXELS).builder_version
TIMEOUT_S = 60.0
SIDE = 100.0
Cells = dict[str, tuple[tuple[float, float, float, float], bytes]]
"""By name: box, and content of the points, 32 bytes."""


def publish(
    store: MemoryStore, cells: Cells, builder_version: int = OURS, called: dict[bytes, bytes] | None = None
) -> Root:
    """Publish cells; ``called`` renames some in the shards, as no publisher does."""
    names = sorted(cells, key=str.encode)
    boxes = np.array([cells[name][0] for name in names])
    catalogue = Catalogue(
        id_prefix="/map/", names=np.array([name.encode() for name in names]), boxes=boxes,
        stamps=np.zeros((len(names), 3), np.int64),
    )  # fmt: skip
    objects = CellObjects(len(names), ("points", VOXELS))
    for row, name in enumerate(names):
        content = cells[name][1]
        layers = tuple(LayerSent(content, 10, 8192, content[::-1] if n else content, 10) for n in range(2))
        objects.set(row, CellSent(row, 1, 0.0, 1.0, layers))
    keys, counts, sizes, digests = [], [], [], []
    for key, shard in divide_into_shards(catalogue, objects, SIDE):
        names_here = tuple((called or {}).get(name, name) for name in shard.names)
        frame = pack_frame(pack_shard(replace(shard, names=names_here)))
        digest, size = store.add(frame), len(frame)
        keys.append(key)
        counts.append(len(shard))
        sizes.append(size)
        digests.append(digest)
    low, high = boxes[:, :2], boxes[:, 2:]
    bounds = (*low.min(axis=0).tolist(), *high.max(axis=0).tolist())
    unpacked = pack_root(
        Root(
            id_prefix="/map/",
            frame_id="map",
            crs="",
            origin=(0.0, 0.0, 0.0),
            unit_m=(1.0, 1.0),
            encoding="exact",
            cells=len(names),
            bounds=bounds,
            shard_m=SIDE,
            largest_m=tuple((high - low).max(axis=0).tolist()),
            mean_m=tuple((high - low).mean(axis=0).tolist()),
            layers={"points": 1, VOXELS: builder_version},
            keys=np.array(keys, np.int32),
            counts=np.array(counts, np.uint32),
            sizes=np.array(sizes, np.uint32),
            hashes=np.frombuffer(b"".join(digests), np.uint8).reshape(-1, 32),
        )
    )
    root = unpack_root(pack_frame(unpacked))
    assert root.map_version == map_version_of(unpacked)
    return root


def some_cells(rng: np.random.Generator, count: int = 300, width: float = 1000.0) -> Cells:
    cells: Cells = {}
    for number in range(count):
        x, y = rng.uniform(-width / 2, width / 2, 2)
        size = rng.uniform(1.0, 40.0, 2)
        folder = "b/" if number % 7 == 0 else ""
        cells[f"{folder}{number}.pcd"] = ((x, y, x + size[0], y + size[1]), rng.bytes(32))
    return cells


@dataclass
class Served:
    store: MemoryStore = field(default_factory=MemoryStore)
    failed: list[None] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.fetcher = ShardFetcher(cast("Store", self.store), lambda: self.failed.append(None), Arrivals())

    def view(
        self, root: Root, before: PublishedView | None = None, max_bytes: int = 1 << 40
    ) -> PublishedView:
        known = before.pages.shards() if before is not None else {}
        return PublishedView(root, 1, self.fetcher, known, max_bytes=max_bytes)

    def whole(self, root: Root) -> PublishedView:
        view = self.view(root)
        fetch(view.pages, range(len(view.pages)))
        return view


@pytest.fixture
def served() -> Iterator[Served]:
    one = Served()
    yield one
    one.store.open.set()
    assert have_ended(one.fetcher.close())


def collect(pages: ShardPages) -> tuple[list[int], list[int]]:
    """Wait for news."""
    assert select.select([pages.fd], [], [], TIMEOUT_S)[0], "nothing has come"
    news = pages.collect()
    return list(news.come), list(news.out_of_reach)


def fetch(pages: ShardPages, wanted: Any) -> None:
    pages.want(wanted, 0.0)
    while not all(map(pages.is_here, wanted)):
        collect(pages)


def areas(rng: np.random.Generator) -> Iterator[Area]:
    for _ in range(20):
        x, y = rng.uniform(-600, 600, 2).tolist()
        radius = float(rng.choice([0.0, 5.0, 60.0, 400.0]))
        yield Circle(x, y, radius)
        yield AutowareSquare(x, y, radius)
        yield Box(x - radius, y - radius, x + radius, y + radius)


def touching(cells: Cells, area: Area) -> list[str]:
    names = sorted(cells, key=str.encode)
    hit = area.overlaps(np.array([cells[name][0] for name in names]))
    return [name for name, touches in zip(names, hit.tolist(), strict=True) if touches]


# --- cells --------------------------------------------------------------------------------------------


def test_areas_find_the_cells_that_touch_them_in_id_order(served: Served) -> None:
    rng = np.random.default_rng(1)
    cells = some_cells(rng)
    view = served.whole(publish(served.store, cells))
    assert view.complete
    assert (len(view), view.pages.known_cells) == (300, 300)
    for area in areas(rng):
        found, known = view.query(area)
        assert known
        assert [name.removeprefix("/map/") for name in view.ids(found)] == touching(cells, area)
        assert view.boxes_of(found).tolist() == [list(cells[n][0]) for n in touching(cells, area)]
        assert view.pages.cells_surely_in(area) <= len(found)
        few, _ = view.query(area, 3)
        assert len(few) == len(found) if len(found) <= 3 else len(few) > 3
    assert view.pages.cells_surely_in(Box(-1e4, -1e4, 1e4, 1e4)) == 300


def test_each_cell_is_what_was_published(served: Served) -> None:
    cells = some_cells(np.random.default_rng(2))
    view = served.whole(publish(served.store, cells))
    seen = set()
    for name, (box, content) in cells.items():
        index = view.find(f"/map/{name}")
        assert index is not None
        assert index == view.find(name)
        seen.add(index)
        assert view.pages.of_cell(index) in range(len(view.pages))
        assert index in view.pages.cells(view.pages.of_cell(index))
        assert (view.id(index), view.box(index)) == (f"/map/{name}", box)
        version = cell_version(f"/map/{name}", content[:24], box)
        assert (view.stamp(index), view.version(index)) == (content[:24], version)
        assert view.ready(index, "points") == (8192, version)
        of_layer = published_layer_version(version, VOXELS, OURS, content[::-1])
        assert view.ready(index, VOXELS) == (8192, of_layer)
        assert view.ready(index, "voxel(leaf=2.0)") is None
        source = view.source(index)
        assert (source.name, stamp_of(source)) == (f"/map/{name}", content[:24])
        assert unpack_source(source)["points"].name == (content, 10, 8192, content)
        assert view.source_bytes(index) == 8192
    assert seen == set(range(300))
    for wanted in ("nowhere.pcd", "/map/nowhere.pcd", "/other/1.pcd", "\udcff", "/map/", ""):
        assert view.find(wanted) is None


def test_a_cell_in_two_shards_is_refused_with_the_second(
    served: Served, caplog: pytest.LogCaptureFixture
) -> None:
    """No request waits for it, and what the first shard says of it stays."""
    box, far, content = (0.0, 0.0, 1.0, 1.0), (500.0, 0.0, 501.0, 1.0), bytes(32)
    cells = {"1.pcd": (box, content), "2.pcd": (far, content)}
    root = publish(served.store, cells, called={b"2.pcd": b"1.pcd"})
    view = served.view(root)
    fetch(view.pages, [0])
    view.pages.want([1], 0.0)
    while not view.pages.is_out_of_reach(1):
        collect(view.pages)
    assert "its cell /map/1.pcd is in another shard, too" in caplog.text
    index = view.find("/map/1.pcd")
    assert index is not None
    assert view.box(index) == box
    assert view.query(Box(499.0, 0.0, 502.0, 2.0))[1] is False
    store = cast("Store", served.store)
    shards = {n: unpack_shard(read_shard_object(store, root, n), root, n) for n in range(2)}
    with pytest.raises(MapDataError, match="two cells are called"):
        PublishedView(root, 1, served.fetcher, shards, max_bytes=1 << 40)


def test_base_names_are_found_where_they_are_unique(served: Served) -> None:
    box, content = (0.0, 0.0, 1.0, 1.0), bytes(32)
    far = (500.0, 0.0, 501.0, 1.0)
    cells = {"a/1.pcd": (box, content), "b/1.pcd": (far, content), "b/2.pcd": (far, content)}
    view = served.view(publish(served.store, cells))
    fetch(view.pages, [0, 1])
    with pytest.raises(BadRequest, match="2 cells are called"):
        view.find("1.pcd")
    assert view.find("2.pcd") == view.find("/map/b/2.pcd")
    view.pages.drop(1)
    assert view.find("1.pcd") == view.find("a/1.pcd") == 0
    assert view.find("2.pcd") is None


def test_a_layer_built_otherwise_is_computed(served: Served) -> None:
    view = served.whole(publish(served.store, some_cells(np.random.default_rng(3), 5), OURS + 1))
    assert view.ready(0, VOXELS) is None
    assert view.ready(0, "points") is not None
    assert set(unpack_source(view.source(0))) == {"points"}
    assert layer_version(view.version(0), VOXELS, OURS) != 0


# --- pages --------------------------------------------------------------------------------------------


def test_what_is_not_here_is_not_known(served: Served) -> None:
    rng = np.random.default_rng(4)
    cells = some_cells(rng)
    served.store.open.clear()  # nothing comes in the background
    view = served.view(publish(served.store, cells))
    pages = view.pages
    assert len(pages) > FEW_SHARDS
    assert view.query(Circle(0, 0, 400))[1] is False
    assert view.query(Circle(5000, 0, 1))[1] is True
    with pytest.raises(KeyError):
        view.box(0)
    here = range(0, len(pages), 2)
    served.store.open.set()
    fetch(pages, here)
    known = {name for number in here for name in view.ids(np.array(pages.cells(number)))}
    assert pages.known_cells == len(known)
    for area in areas(rng):
        found, covered = view.query(area)
        wanted = [f"/map/{name}" for name in touching(cells, area)]
        assert view.ids(found) == [name for name in wanted if name in known]
        assert covered == all(number % 2 == 0 for number in pages.of_area(area))
        if covered:
            assert len(found) == len(wanted)


def test_the_rest_comes_in_the_background_while_it_fits(served: Served) -> None:
    root = publish(served.store, some_cells(np.random.default_rng(5), 3000, width=3000.0))
    whole = served.whole(root)
    assert len(whole.pages) > 500
    pages = map(whole.pages.page, range(len(whole.pages)))
    view = served.view(root, max_bytes=sum(page.nbytes for page in pages if page is not None) // 3)
    fetch(view.pages, view.pages.of_area(Circle(700, 700, 50)))
    while view.pages.want_nearest((700.0, 700.0)):
        collect(view.pages)
    assert 0.2 < view.pages.known_cells / 3000 < 0.34
    assert view.pages.spare() is None
    assert view.query(Circle(700, 700, 200))[1], "the nearest ones come first"
    far = view.pages.of_area(Circle(-1200, -1200, 500))
    assert not any(map(view.pages.is_here, far))
    fetch(view.pages, far)
    assert all(map(view.pages.is_here, far))
    spared = 0
    while (spare := view.pages.spare()) is not None:
        assert spare not in far
        view.pages.drop(spare)
        spared += 1
    assert spared
    assert view.query(Circle(-1200, -1200, 500))[1]


def test_what_an_area_needs_comes_before_the_background(served: Served) -> None:
    root = publish(served.store, some_cells(np.random.default_rng(5), 3000, width=3000.0))
    served.store.open.clear()
    view = served.view(root)
    assert [view.pages.want_nearest(None) for _ in range(3)] == [True, True, False]
    begun = Deadline()
    while begun(len(served.store.asked) < BACKGROUND_FETCHES):
        time.sleep(0.001)
    needed = view.pages.of_area(Circle(-1200, -1200, 300))
    assert len(needed) > THREADS
    view.pages.want(needed, 0.0)
    served.store.open.set()
    while not all(map(view.pages.is_here, needed)):
        collect(view.pages)
    paths = {blob_path(root.shard_sha256(number)) for number in needed}
    asked = list(served.store.asked)
    last = max(map(asked.index, paths))
    assert len(asked[: last + 1]) - len(paths) == BACKGROUND_FETCHES
    assert BACKGROUND_FETCHES < THREADS / 2


def test_few_shards_are_kept_whatever_they_take(served: Served) -> None:
    root = publish(served.store, some_cells(np.random.default_rng(6), 50, width=100.0))
    view = served.whole(root)
    assert len(view.pages) <= 16
    small = served.view(root, before=view, max_bytes=1)
    assert small.complete
    assert small.pages.spare() is None


@pytest.mark.parametrize("wrong", ["away", "damaged"])
def test_what_cannot_be_had_is_tried_when_that_is_asked_for(served: Served, wrong: str) -> None:
    root = publish(served.store, some_cells(np.random.default_rng(7), 30, width=100.0))
    right = dict(served.store.objects)
    served.store.is_out = wrong == "away"
    if wrong == "damaged":
        served.store.objects = {path: data[:-1] + bytes([data[-1] ^ 1]) for path, data in right.items()}
    view = served.view(root)
    pages = range(len(view.pages))
    view.pages.want(pages, 0.0)
    lost: list[int] = []
    while len(lost) < len(view.pages):
        lost += collect(view.pages)[1]
    assert all(map(view.pages.is_out_of_reach, pages))
    assert not any(map(view.pages.is_here, pages))
    assert served.failed or wrong == "damaged"
    served.store.is_out, served.store.objects = False, right
    asked = len(served.store.asked)
    view.pages.want([0], 0.0)
    assert view.pages.is_out_of_reach(0)
    assert len(served.store.asked) == asked, "not before"
    view.pages.try_again()
    while not view.complete:
        collect(view.pages)
    assert not view.pages.is_out_of_reach(0)


def test_a_version_that_is_served_no_more_goes(served: Served) -> None:
    view = served.whole(publish(served.store, some_cells(np.random.default_rng(9), 30)))
    pages = weakref.ref(view.pages)
    gc.disable()
    try:
        del view
        waiting = Deadline()
        while waiting(pages() is not None):  # a thread may still have delivered to it
            time.sleep(0.001)
    finally:
        gc.enable()


# --- versions -----------------------------------------------------------------------------------------


def changed_map(rng: np.random.Generator, before: Cells) -> Cells:
    after = dict(before)
    names = list(before)
    for name in names[:10]:
        after[name] = before[name][0], rng.bytes(32)
    for name in names[10:20]:
        del after[name]
    for name in names[20:30]:  # some stay in their shard, others do not
        (x, y, x1, y1), content = before[name]
        dx = float(rng.choice([0.5, 150.0]))
        after[name] = (x + dx, y, x1 + dx, y1), content
    for number in range(10):
        x, y = rng.uniform(-500, 500, 2).tolist()
        after[f"new{number}.pcd"] = (x, y, x + 10, y + 10), rng.bytes(32)
    return after


@pytest.mark.parametrize("seed", range(5))
def test_changes_are_the_difference_of_both(served: Served, seed: int) -> None:
    rng = np.random.default_rng(seed)
    before = some_cells(rng)
    after = changed_map(rng, before)
    old, new = served.whole(publish(served.store, before)), served.whole(publish(served.store, after))
    for _ in range(2):  # once more, from what is remembered
        change = new.changes_from(old)
        assert change.known
        both = before.keys() & after.keys()

        def ids(names: Any) -> set[str]:
            return {f"/map/{name}" for name in names}

        assert set(change.ids("added")) == ids(after.keys() - both)
        assert set(change.ids("removed")) == ids(before.keys() - both)
        assert set(change.ids("changed")) == ids(n for n in both if before[n][1] != after[n][1])
        assert set(change.ids("moved")) == ids(n for n in both if before[n][0] != after[n][0])
    nothing = old.changes_from(old)
    assert nothing.known
    assert not nothing
    assert nothing.same_numbers


@pytest.mark.parametrize("dx", [0.5, SIDE])
def test_a_cell_that_goes_to_another_shard_shifts_the_numbers_of_others(served: Served, dx: float) -> None:
    content = [bytes([number]) * 32 for number in range(6)]
    before = {f"{n}.pcd": ((40.0 * n, 0.0, 40.0 * n + 10, 10.0), content[n]) for n in range(6)}
    moved = {"0.pcd": ((dx, 0.0, dx + 10, 10.0), content[0])}
    old = served.whole(publish(served.store, before))
    new = served.whole(publish(served.store, {**before, **moved}))
    change = new.changes_from(old)
    assert (change.ids("moved"), change.count) == (("/map/0.pcd",), 1)
    assert change.same_numbers == (dx == 0.5) == all(old.find(name) == new.find(name) for name in before)


def test_changes_are_known_only_where_both_are(served: Served) -> None:
    rng = np.random.default_rng(11)
    before = some_cells(rng)
    name = next(iter(before))
    after = {**before, name: (before[name][0], rng.bytes(32))}
    old, new = served.whole(publish(served.store, before)), served.whole(publish(served.store, after))
    index = new.find(name)
    assert index is not None
    page = new.pages.of_cell(index)
    other = (page + 1) % len(new.pages)
    new.pages.drop(other)
    old.pages.drop(other)
    change = new.changes_from(old)
    assert (change.known, change.same_numbers, change.ids("changed")) == (True, True, (f"/map/{name}",))
    new.pages.drop(page)
    assert not new.changes_from(old).known
    assert new.pages.lacking(old.pages) == [page]
    fetch(new.pages, [page])
    assert new.pages.lacking(old.pages) == []
    change = new.changes_from(old)
    assert (change.known, change.ids("changed")) == (True, (f"/map/{name}",))
