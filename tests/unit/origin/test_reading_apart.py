# SPDX-License-Identifier: Apache-2.0
"""Long metadata is read in a process of its own: errors, what is shared, and what memory it takes."""

from __future__ import annotations

import io
import json
import os
import struct
import sys
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from xxhash import xxh3_64_intdigest

from shmmap.errors import MapDataError, MapMissing, ShmmapError
from shmmap.geometry import Circle
from shmmap.origin import cell_names, map_directory, spatial_index
from shmmap.origin.catalogue import Catalogue, compare
from shmmap.origin.catalogue_bytes import Source, read_catalogue, write_catalogue
from shmmap.origin.map_directory import MapDirectory
from shmmap.origin.reading_apart import read_apart
from shmmap.segment.layout import SourceStamp

HEAD = "x_resolution: 20\ny_resolution: 20\n"
LONG = 100_000
"""Bytes; more than a daemon reads itself."""


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A map of three cells."""
    cells = tmp_path / "map" / "pointcloud_map.pcd"
    cells.mkdir(parents=True)
    for i in range(3):
        (cells / f"c_{20 * i}_0.pcd").write_bytes(b"x" * i)
    write_metadata(tmp_path / "map", "")
    return tmp_path / "map"


def write_metadata(root: Path, more: str) -> None:
    lines = "".join(f"c_{20 * i}_0.pcd: [{20 * i}, 0]\n" for i in range(3))
    (root / "pointcloud_map_metadata.yaml").write_text(HEAD + lines + more)


def origin(root: Path) -> MapDirectory:
    return MapDirectory(path=str(root), cache_dir=str(root.parent / "cache"))


@pytest.fixture
def never_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is parsed and no directory is listed in this process."""

    def refuse(*_: Any, **__: Any) -> Any:
        raise AssertionError("read here")

    monkeypatch.setattr(map_directory, "parse_metadata", refuse)
    monkeypatch.setattr(map_directory, "scan", refuse)


@pytest.mark.usefixtures("never_here")
@pytest.mark.parametrize(
    ("more", "message"),
    [
        (f"a.pcd: [{'7' * LONG}, 0]\n", r"line 6: a\.pcd: the corner must be two numbers, not \[777.*100,0"),
        (f"a.pcd: [0x{'f' * LONG}, 0]\n", r"line 6: a\.pcd: the corner must be two numbers"),
        (f"x_resolution: {'7' * LONG}\n", "line 6: x_resolution must be a positive number of metres, not '7"),
        (f"{'n' * LONG}.pcd: [0, 0]\n", "line 6: no YAML: could not find expected ':'"),
        (f"? {'n' * LONG}.pcd\n: [0, 0]\n", "nnn.*100,004 characters.*: no file has so long a name"),
        ("n" * LONG, "line 6: no YAML: could not find expected ':'"),
        (f'"{"n" * LONG}', "line 6: no YAML: found unexpected end of stream"),
        (f"a.pcd: {'[' * LONG}", "line 6: nested too deeply"),
        (f"a.pcd: {'{b: ' * LONG}", "line 6: nested too deeply"),
        ("a: &a [1, 2]\n" + "".join(f"b{i}: &b{i} [*a, *a]\n" for i in range(LONG // 16)), "aliases are not"),
        ("---\n" * (LONG // 4) + "%TAG !a! b\n", "tag directives are not read"),
    ],
    ids=lambda value: value[:16].strip(),
)  # fmt: skip
def test_endless_metadata_is_refused_in_a_few_words(root: Path, more: str, message: str) -> None:
    write_metadata(root, more)
    with pytest.raises(MapDataError, match=message) as caught:
        origin(root).load()
    error = caught.value
    assert error.path == str(root / "pointcloud_map_metadata.yaml")
    assert str(error).startswith(error.path)
    assert error.offset is not None
    assert error.cause in ("bad_corner", "bad_yaml", "no_resolution")
    assert len(str(error)) < 600


@pytest.mark.usefixtures("never_here")
def test_very_many_anchors_are_read_apart(root: Path) -> None:
    """They name cells that no client needs."""
    write_metadata(root, "".join(f"a{i}: &a{i} [1, 2]\n" for i in range(LONG // 16)))
    (problem,) = origin(root).load().problems
    assert f"entries whose file is missing, not served: a0, a1, a2, ... ({LONG // 16} in all)" in problem


@pytest.mark.usefixtures("never_here")
def test_other_errors_come_through_as_they_are(root: Path) -> None:
    write_metadata(root, "#" * LONG)
    for path in (root / "pointcloud_map.pcd").iterdir():
        path.unlink()
    with pytest.raises(MapMissing, match="there is no PCD file in"):
        origin(root).load(fresh=True)


def test_metadata_is_never_longer_than_it_may_be(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_metadata(root, "#" * LONG)
    file = root / "pointcloud_map_metadata.yaml"
    with pytest.raises(MapDataError, match=r"0 MiB of metadata.*it has a line for each cell") as caught:
        origin(root).scanned(file.stat().st_size - 1)
    assert caught.value.path == str(file)
    assert len(origin(root).scanned(file.stat().st_size)) == 3
    monkeypatch.setattr(map_directory, "read_apart", None)
    monkeypatch.setattr(map_directory, "_READ_HERE_BYTES", file.stat().st_size)
    assert len(origin(root).load(fresh=True)) == 3


def test_a_process_that_ends_before_it_is_done(root: Path) -> None:
    with pytest.raises(
        ShmmapError, match=f"{root}: the process that reads it ended with exit code 1"
    ) as caught:
        read_apart(str(root), json.dumps({"nonsense": 1}), None)
    assert "was it killed" in caught.value.hint


def test_no_process_is_to_be_had(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_metadata(root, "#" * LONG)
    monkeypatch.setattr(sys, "executable", str(root / "nowhere"))
    with pytest.raises(ShmmapError, match="cannot start a process that reads it: No such file") as caught:
        origin(root).load(fresh=True)
    assert "raise the limit" in caught.value.hint


def test_what_has_not_changed_is_shared(root: Path) -> None:
    write_metadata(root, "#" * LONG + "\n")
    first = origin(root).load(fresh=True)
    assert first.find("c_20_0.pcd") == 1  # and remembered
    os.utime(root / "pointcloud_map.pcd" / "c_20_0.pcd", ns=(1, 1))
    second = origin(root).load(fresh=True, before=first)
    assert second.names is first.names
    assert second.boxes is first.boxes
    assert second.stamps is not first.stamps
    assert compare(first, second).ids("changed") == (first.id(1),)
    second.set_stamp(0, first.stamp(1))
    assert first.stamp(0) != second.stamp(0)
    write_metadata(root, "#" * LONG + "\nc_0_0.pcd: [0, 40]\n")
    third = origin(root).load(fresh=True, before=second)
    assert third.names is second.names
    assert compare(second, third).ids("moved") == (first.id(0),)
    assert third.query(Circle(5.0, 50.0, 1.0))[0].tolist() == [0]
    assert second.query(Circle(5.0, 50.0, 1.0))[0].tolist() == []
    (root / "pointcloud_map.pcd" / "c_20_0.pcd").unlink()
    fourth = origin(root).load(fresh=True, before=third)
    here = origin(root).scanned()
    assert fourth.ids(np.arange(2)) == here.ids(np.arange(2))
    assert np.array_equal(fourth.boxes, here.boxes)
    assert fourth.map_version == here.map_version
    assert compare(third, fourth).ids("removed") == (first.id(1),)


def test_a_reader_sorts_nothing_again(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is made of names and boxes comes with them; of the same ones it is that of the state before."""
    monkeypatch.setattr(spatial_index, "_LINEAR_CELLS", 0)
    for i in range(3):
        folder = root / "pointcloud_map.pcd" / "more"
        folder.mkdir(exist_ok=True)
        (folder / f"d_{20 * i}_0.pcd").write_bytes(b"x")
    write_metadata(root, "".join(f"d_{20 * i}_0.pcd: [{20 * i}, {500 * i}]\n" for i in range(3)))
    here = origin(root).scanned()
    assert len(here.made_of_boxes.grids) == 1
    assert len(here.by_base) == len(here) == 6
    out = io.BytesIO()
    write_catalogue(out, "", (), here)
    with monkeypatch.context() as patch:
        patch.setattr(spatial_index.MadeOfBoxes, "of", None)
        patch.setattr(cell_names, "order_by_base", None)
        _, first = read_catalogue(io.BytesIO(out.getvalue()), len(out.getvalue()))
        _, second = read_catalogue(io.BytesIO(out.getvalue()), before=first)
    assert second.by_base is first.by_base
    for found in (first, second):
        assert found.find("d_40_0.pcd") == here.find("d_40_0.pcd") is not None
        assert found.find("more/d_40_0.pcd") == here.find("d_40_0.pcd")
        assert found.query(Circle(45.0, 1005.0, 1.0))[0].tolist() == [here.find("d_40_0.pcd")]
        assert (
            (found.bounds, found.mean_size) == (here.bounds, here.mean_size) == ((0, 0, 60, 1020), (20, 20))
        )
        ((grid, right),) = zip(found.made_of_boxes.grids, here.made_of_boxes.grids, strict=True)
        assert grid.frame == right.frame
        assert grid.keys.tolist() == right.keys.tolist()
        assert grid.cells.tolist() == right.cells.tolist()


def test_bytes_of_a_catalogue(monkeypatch: pytest.MonkeyPatch) -> None:
    """As `shmmap.origin.catalogue_bytes` says them: other bytes need another version of the layout."""
    monkeypatch.setattr(spatial_index, "_LINEAR_CELLS", 0)
    boxes = [(0.0, 0.0, 20.0, 20.0), (20.0, -20.0, 40.0, 0.0), (0.0, 40.0, 5.0, 45.0)]
    names = ("a/two.pcd", "b/one.pcd", "b/two.pcd")
    cells = [(f"/m/{names[n]}", boxes[n], SourceStamp(n, n + 1, n + 2)) for n in range(3)]
    out = io.BytesIO()
    write_catalogue(out, "key", (Source("/m", 0, 1, 2, 3),), Catalogue.from_cells(cells, ["odd"]))
    written = out.getvalue()
    fixed = xxh3_64_intdigest(
        b"shmmap map 1\0/m/\0" + b"".join(map(str.encode, names)) + np.array(boxes).T.tobytes()
    )
    magic, version, header_bytes, digest = struct.unpack_from("<8sIIQ", written)
    assert (magic, version, digest) == (b"SHMMAPCT", 2, xxh3_64_intdigest(written[24:]))
    assert json.loads(written[24 : 24 + header_bytes]) == {
        "key": "key", "sources": [["/m", 0, 1, 2, 3]], "prefix": "/m/", "cells": 3, "name_bytes": 9,
        "problems": ["odd"], "by_base": 3, "bounds": [0, -20, 40, 45], "mean_size": [15, 15],
        "grids": [[[0, 40, 5, 5, 5, 5, 1, 1], 1], [[0, -20, 20, 20, 20, 20, 2, 2], 2]],
        "fixed_digest": fixed, "stamps_only": False,
    }  # fmt: skip
    rest = written[24 + -(-header_bytes // 8) * 8 :]
    assert rest[:32] == b"a/two.pcdb/one.pcdb/two.pcd\0\0\0\0\0"
    assert np.frombuffer(rest, "<f8", 12, 32).reshape(4, 3).T.tolist() == [list(box) for box in boxes]
    assert np.frombuffer(rest, "<i8", 9, 128).tolist() == [0, 1, 2, 1, 2, 3, 2, 3, 4]
    assert np.frombuffer(rest, "<i4", 4, 200).tolist() == [1, 0, 2, 0]  # one.pcd, two.pcd, two.pcd
    assert np.frombuffer(rest, "<i8", 2, 216).tolist() == [0, 2]  # key and cell of the small one's grid
    assert np.frombuffer(rest, "<i8", 2, 232).tolist() == [1, 1 << 32]
    assert np.frombuffer(rest, "<i4", 2, 248).tolist() == [1, 0]
    assert len(rest) == 256


def test_a_process_with_names_and_boxes_gets_only_the_stamps() -> None:
    before, other = many(1_000_000), many(1_000_000, 5.0)
    after = many(1_000_000)
    after.set_stamp(CELLS - 1, before.stamp(0))
    whole, short = io.BytesIO(), io.BytesIO()
    write_catalogue(whole, "", (), after, other.fixed_digest)
    write_catalogue(short, "", (), after, before.fixed_digest)
    assert len(short.getvalue()) < CELLS * 24 + 1024 < len(whole.getvalue())
    found = [read_catalogue(io.BytesIO(out.getvalue()), before=before)[1] for out in (whole, short)]
    for one in found:
        assert one.names is before.names
        assert one.boxes is before.boxes
        assert one.map_version == after.map_version != before.map_version
        assert compare(before, one).changed.tolist() == [CELLS - 1]
        assert one.query(Circle(505.0, 505.0, 1.0))[0].tolist() == [25 * 500 + 25]
    for without in (None, other):
        with pytest.raises(ValueError, match="stamps alone, of other cells"):
            read_catalogue(io.BytesIO(short.getvalue()), len(short.getvalue()), without)


CELLS = 200_000
PREFIX = "/m/"


def many(first: int, shift: float = 0.0) -> Catalogue:
    """A catalogue of very many cells whose names begin at a number."""
    corners = np.stack(np.divmod(np.arange(CELLS), 500), axis=1) * 20.0 + shift
    names = np.char.add(b"c", np.arange(first, first + CELLS).astype("S7")).astype("S12")
    stamps = np.arange(3 * CELLS).reshape(-1, 3)
    return Catalogue(id_prefix=PREFIX, names=names, boxes=np.hstack((corners, corners + 20.0)), stamps=stamps)


def peak_of(written: bytes, before: Catalogue) -> tuple[int, int]:
    """Bytes that reading and comparing take at most, and how many cells differ."""
    file = io.BytesIO(written)
    tracemalloc.start()
    try:
        _, after = read_catalogue(file, len(written), before)
        change = compare(before, after)
        return tracemalloc.get_traced_memory()[1], change.count
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    ("first", "shift", "bytes_a_cell", "differing"),
    [
        (1_000_000, 0.0, 0, 0),
        (1_000_000, 5.0, 32 + 16 + 8, CELLS),
        (5_000_000, 0.0, 12 + 16, 2 * CELLS),
        (1_000_001, 0.0, 12 + 32 + 16, 2 * CELLS),
    ],
    ids=["the same", "moved", "renamed", "one more and one less"],
)
def test_another_state_takes_what_is_new_and_no_further_table(
    first: int, shift: float, bytes_a_cell: int, differing: int
) -> None:
    """A stamp a cell, what has changed, and a few blocks; indices of what differs are 8 bytes each."""
    before = many(1_000_000)
    out = io.BytesIO()
    write_catalogue(out, "", (), many(first, shift))
    peak, count = peak_of(out.getvalue(), before)
    assert count == differing
    assert peak < CELLS * (24 + bytes_a_cell) + (6 << 20)


def test_cells_that_are_the_same_are_not_copied() -> None:
    """Other threads wait for the interpreter lock meanwhile."""
    before, after = many(1_000_000), many(1_000_000)
    tracemalloc.start()
    try:
        assert not compare(before, after)
        assert tracemalloc.get_traced_memory()[1] < CELLS + (1 << 18)
    finally:
        tracemalloc.stop()
