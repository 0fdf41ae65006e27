# SPDX-License-Identifier: Apache-2.0
"""The catalogue: order, lookup by id and base name, versions, and what changed between two of them."""

from __future__ import annotations

import random
import struct

import numpy as np
import pytest
import xxhash
from hypothesis import given, settings
from hypothesis import strategies as st

from shmmap.daemon.requests.limits import MAX_HELD
from shmmap.errors import BadRequest, MapDataError
from shmmap.geometry import Circle
from shmmap.origin.catalogue import Catalogue, compare
from shmmap.origin.cell_names import CellNames
from shmmap.segment.layout import SourceStamp

Box = tuple[float, float, float, float]
STAMP = SourceStamp(100, 2_000_000_001, 3_000_000_001)


def catalogue(cells: dict[str, SourceStamp], box: Box = (0.0, 0.0, 20.0, 20.0)) -> Catalogue:
    return Catalogue.from_cells([(cell_id, box, stamp) for cell_id, stamp in cells.items()])


def test_order_is_that_of_a_cpp_string_map() -> None:
    ids = [
        "/m/a_10.pcd",
        "/m/a_-10.pcd",
        "/m/a_9.pcd",
        "/m/B.pcd",
        "/m/a.pcd",
        "/m/ä.pcd",
        "/m/z.pcd",
        "/m/a/x.pcd",
    ]
    random.Random(1).shuffle(ids)
    cells = catalogue(dict.fromkeys(ids, STAMP))
    expected = sorted(ids, key=lambda text: text.encode())
    assert [cells.id(i) for i in range(len(cells))] == expected
    assert cells.ids(np.arange(len(cells))) == expected
    assert cells.id_prefix == "/m/"
    assert [cells.source(i).name for i in range(len(cells))] == expected
    assert cells.frame_id == "map"


def test_find_by_id_and_base_name() -> None:
    cells = catalogue(
        dict.fromkeys(["/m/1/a.pcd", "/m/2/a.pcd", "/m/2/b.pcd", "/m/c.pcd", "/m/ü.pcd"], STAMP)
    )
    for index in range(len(cells)):
        assert cells.find(cells.id(index)) == index
    assert cells.find("b.pcd") == 2
    assert cells.find("c.pcd") == 3
    assert cells.find("ü.pcd") == 4
    for _ in range(2):  # the second time from memory
        assert cells.find("/m/2/b.pcd") == 2
    assert cells.find("1/a.pcd") == 0
    assert cells.find("2/a.pcd") == 1
    assert cells.find("3/a.pcd") is None
    with pytest.raises(BadRequest, match=r"2 cells are called a\.pcd: /m/1/a\.pcd, /m/2/a\.pcd"):
        cells.find("a.pcd")


def test_all_cells_that_a_request_may_hold_are_looked_up_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Looking an id up takes thirty times as long as remembering its index."""
    names = np.array([b"%05d.pcd" % number for number in range(MAX_HELD)])
    cells = CellNames("/m/", names)
    held = cells.ids(np.arange(MAX_HELD))
    assert [cells.find(cell) for cell in held] == list(range(MAX_HELD))
    monkeypatch.setattr(cells, "_find_id", None)
    assert [cells.find(cell) for cell in held] == list(range(MAX_HELD))


def test_an_id_without_its_prefix_is_no_ambiguous_base_name() -> None:
    cells = catalogue(dict.fromkeys(["/m/a.pcd", "/m/1/a.pcd"], STAMP))
    assert cells.find("a.pcd") == cells.find("/m/a.pcd") == 1
    assert cells.find("1/a.pcd") == 0


@pytest.mark.parametrize(
    "unknown",
    [
        "",
        "x",
        "a.pc",
        "a.pcd ",
        "a.pcd\0",
        "/m/a.pcd\0",
        "/m/",
        "/m",
        "/",
        "m/a.pcd",
        "/m/A.pcd",
        "\udcff",
        "n" * 5000,
    ],
)
def test_find_unknown(unknown: str) -> None:
    assert catalogue({"/m/a.pcd": STAMP, "/m/b.pcd": STAMP}).find(unknown) is None


def test_find_in_an_empty_catalogue() -> None:
    empty = catalogue({})
    assert len(empty) == 0
    assert empty.find("a.pcd") is None
    assert empty.find("/m/a.pcd") is None
    assert empty.query(Circle(0.0, 0.0, 1e6))[0].tolist() == []
    assert empty.map_version == catalogue({}).map_version


def test_cell_version_is_the_documented_hash() -> None:
    cells = catalogue({"/m/ä.pcd": SourceStamp(5, -6, 7)})
    expected = struct.pack("<I", 9) + "/m/ä.pcd".encode() + struct.pack("<I3q", 24, 5, -6, 7)
    expected += struct.pack("<4d", 0.0, 0.0, 20.0, 20.0)
    assert cells.version(0) == xxhash.xxh3_64(expected).intdigest()


def test_map_version_is_the_documented_hash() -> None:
    n = 4096 + 3
    names = [f"c{i:05d}.pcd" for i in range(n)]
    boxes: list[Box] = [(float(i), 0.5, i + 20.0, 20.5) for i in range(n)]
    stamps = [SourceStamp(i, i + 1, i + 2) for i in range(n)]
    cells = Catalogue.from_cells(
        (f"/map/{name}", box, stamp) for name, box, stamp in zip(names, boxes, stamps, strict=True)
    )
    fixed = b"shmmap map 1\0/map/\0" + "".join(names).encode()
    for side in range(4):
        fixed += struct.pack(f"<{n}d", *(box[side] for box in boxes))
    digests = struct.pack("<Q", xxhash.xxh3_64(fixed).intdigest())
    for start in (0, 4096):
        packed = b"".join(struct.pack("<qqq", *stamp) for stamp in stamps[start : start + 4096])
        digests += struct.pack("<Q", xxhash.xxh3_64(packed).intdigest())
    assert cells.map_version == xxhash.xxh3_64(digests).intdigest()


def test_versions_follow_a_corrected_stamp() -> None:
    many = {f"/m/{i:05d}.pcd": STAMP for i in range(5000)}
    cells = catalogue(many)
    before, map_before = [cells.version(i) for i in (0, 4999)], cells.map_version
    other = SourceStamp(101, 5, 6)
    cells.set_stamp(4999, other.token)
    assert cells.stamp(4999) == other.token
    assert cells.version(0) == before[0]
    assert cells.version(4999) != before[1]
    assert cells.map_version == catalogue({**many, "/m/04999.pcd": other}).map_version != map_before
    cells.set_stamp(4999, STAMP.token)
    assert [cells.version(i) for i in (0, 4999)] == before
    assert cells.map_version == map_before


@pytest.mark.parametrize(
    "box",
    [
        (0.0, 0.0, float("nan"), 1.0),
        (0.0, float("-inf"), 1.0, 1.0),
        (2.0, 0.0, 1.0, 1.0),
        (0.0, 2.0, 1.0, 1.0),
    ],
)
def test_impossible_boxes_are_refused(box: Box) -> None:
    with pytest.raises(MapDataError, match=r"/m/a\.pcd"):
        catalogue({"/m/a.pcd": STAMP}, box=box)


def test_names_must_be_ascending_and_unique() -> None:
    with pytest.raises(ValueError, match="ascending"):
        Catalogue.from_cells([("/m/a", (0, 0, 1, 1), STAMP), ("/m/a", (0, 0, 1, 1), STAMP)])


versions = st.dictionaries(
    st.sampled_from([f"/m/{folder}{name}.pcd" for folder in ("", "x/", "x/y/") for name in "abcdef"]),
    st.builds(SourceStamp, st.integers(0, 2), st.just(1), st.just(2)),
)


@given(versions, versions)
@settings(max_examples=200, deadline=None)
def test_compare_equals_set_differences(old: dict[str, SourceStamp], new: dict[str, SourceStamp]) -> None:
    change = compare(catalogue(old), catalogue(new))
    assert change.ids("added") == tuple(sorted(new.keys() - old.keys()))
    assert change.ids("removed") == tuple(sorted(old.keys() - new.keys()))
    assert change.ids("changed") == tuple(sorted(i for i in old.keys() & new.keys() if old[i] != new[i]))
    assert change.ids("moved") == ()
    assert bool(change) == (old != new)
    assert change.same_numbers == (old.keys() == new.keys())


places = st.sampled_from(["/m/", "/m/v1/", "/m/v1/x/", "/n/", "/"])
files = st.sampled_from(["a", "b", "a_longer_name.pcd", "v1", "x", "é", "x/a", "v1/x/b"])
paths = st.builds("".join, st.tuples(places, files))


@given(st.sets(paths, max_size=9), st.sets(paths, max_size=9))
@settings(max_examples=300, deadline=None)
def test_compare_whatever_the_directories_and_the_longest_names(old: set[str], new: set[str]) -> None:
    change = compare(catalogue(dict.fromkeys(old, STAMP)), catalogue(dict.fromkeys(new, STAMP)))
    assert set(change.ids("added")) == new - old
    assert set(change.ids("removed")) == old - new
    assert change.count == len(new ^ old)


def test_compare_across_blocks() -> None:
    """Cells that come and go change the others' indices, also beyond the first block that is looked at."""
    ids = [f"/m/{i:06d}.pcd" for i in range(80_000)]
    old, new = dict.fromkeys(ids, STAMP), dict.fromkeys(ids[1:], STAMP)
    new[ids[40_000]] = SourceStamp(1, 2, 3)
    new["/m/070000.pcd.pcd"] = STAMP
    change = compare(catalogue(old), catalogue(new))
    assert change.ids("removed") == (ids[0],)
    assert change.ids("added") == ("/m/070000.pcd.pcd",)
    assert change.ids("changed") == (ids[40_000],)
    assert change.count == 3
