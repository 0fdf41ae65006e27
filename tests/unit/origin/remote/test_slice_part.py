# SPDX-License-Identifier: Apache-2.0
"""Parts of slices: golden bytes, names of runs, which shards a slice has, and what is refused."""

from __future__ import annotations

import random
import struct
from dataclasses import replace
from hashlib import sha256
from typing import Any

import numpy as np
import pytest

from shmmap.errors import BadRequest, MapDataError
from tests.support.fuzzing import mutate_bytes
from tests.support.message_pack import pack, unpack

zstandard = pytest.importorskip("zstandard", reason="zstandard is not installed")

from shmmap.origin.remote.published_index import Root  # noqa: E402
from shmmap.origin.remote.slice_part import (  # noqa: E402
    MAX_PART_BYTES,
    Part,
    PartFields,
    RunName,
    pack_part,
    part_number,
    read_run,
    run_of,
    slice_of_shards,
    unpack_part,
    with_parts,
)

NDT, VOXEL = "ndt(leaf=2.0)", "voxel(leaf=1.0)"
CONTENT = bytes(range(32))
DIGEST = sha256(
    CONTENT + struct.pack("<I", 3)
    + struct.pack("<I", 13) + b"ndt(leaf=2.0)" + struct.pack("<I", 15) + b"voxel(leaf=1.0)"
).hexdigest()[:16]  # fmt: skip
RUN = RunName(DIGEST, 3)
PART = Part(
    version=7,
    root_content=CONTENT,
    slice=2,
    slices=3,
    layers={VOXEL: 1, NDT: 3},
    keys=np.array([[-1, 2], [0, -3]], np.int32),
    counts=np.array([2, 1000], np.uint32),
    sizes=np.array([500, 70000], np.uint32),
    hashes=np.arange(64, dtype=np.uint8).reshape(2, 32),
)
GOLDEN = (
    b"\x8b"
    b"\xa6format\xacshmmap slice"
    b"\xaamin_reader\x01"
    b"\xa7version\x07"
    b"\xacroot_content\xc4\x20" + CONTENT + b"\xa5slice\x02"
    b"\xa6slices\x03"
    b"\xa6layers\x82\xadndt(leaf=2.0)\x03\xafvoxel(leaf=1.0)\x01"
    b"\xaashard_keys\xc4\x10\xff\xff\xff\xff\x02\x00\x00\x00\x00\x00\x00\x00\xfd\xff\xff\xff"
    b"\xabshard_cells\xc4\x08\x02\x00\x00\x00\xe8\x03\x00\x00"
    b"\xabshard_bytes\xc4\x08\xf4\x01\x00\x00\x70\x11\x01\x00"
    b"\xacshard_sha256\xc4\x40" + bytes(range(64))
)


def framed(unpacked: bytes) -> bytes:
    return bytes(zstandard.ZstdCompressor().compress(unpacked))


def root_of(counts: list[int]) -> Root:
    count = len(counts)
    return Root(
        id_prefix="/t/", frame_id="map", crs="", origin=(0.0, 0.0, 0.0), unit_m=(1.0, 1.0),
        encoding="exact", cells=sum(counts), bounds=(0.0, 0.0, 1.0, 1.0), shard_m=640.0,
        largest_m=(20.0, 20.0), mean_m=(20.0, 20.0), layers={"points": 1},
        keys=np.array([[0, column] for column in range(count)], np.int32),
        counts=np.array(counts, np.uint32), sizes=np.full(count, 9, np.uint32),
        hashes=np.zeros((count, 32), np.uint8),
    )  # fmt: skip


def test_golden_bytes() -> None:
    frame = pack_part(PART)
    assert zstandard.ZstdDecompressor().decompress(frame) == GOLDEN
    read = unpack_part(framed(GOLDEN), RUN, 2)
    for name in ("version", "root_content", "slice", "slices"):
        assert getattr(read, name) == getattr(PART, name)
    assert dict(read.layers) == dict(PART.layers)
    for name in ("keys", "counts", "sizes", "hashes"):
        assert getattr(read, name).tolist() == getattr(PART, name).tolist()
    assert pack_part(read) == frame


def test_the_fields_are_those_of_the_document() -> None:
    from importlib.resources import files

    page = files("shmmap.origin.remote").joinpath("ORIGIN.md").read_text(encoding="utf-8")
    section = page[page.index("## A part of a slice") : page.index("## A signed map")]
    documented = [line.split("`")[1] for line in section.splitlines() if line.startswith("| `")]
    assert documented == list(PartFields.__struct_fields__)


def test_a_slice_without_shards_has_a_part() -> None:
    none = replace(
        PART, keys=PART.keys[:0], counts=PART.counts[:0], sizes=PART.sizes[:0], hashes=PART.hashes[:0]
    )
    assert unpack_part(pack_part(none), RUN, 2).keys.shape == (0, 2)


def test_a_run_is_named_by_what_it_is_made_of() -> None:
    assert run_of(CONTENT, [VOXEL, NDT], 3) == run_of(CONTENT, (NDT, VOXEL), 3) == RUN == PART.run
    others = (run_of(CONTENT, [NDT], 3), run_of(CONTENT, [NDT, VOXEL], 4), run_of(bytes(32), [NDT, VOXEL], 3))
    assert len({RUN, *others}) == 4
    assert str(RUN) == f"{DIGEST}-3"
    assert read_run(str(RUN)) == RUN
    assert RUN.part_path(2) == f"parts/{DIGEST}-3/2"
    for wrong in (
        "",
        DIGEST,
        f"{DIGEST}-0",
        f"{DIGEST}-03",
        f"{DIGEST}-100001",
        f"x{DIGEST}-3",
        f"{DIGEST}-3/",
        "../a-1",
    ):
        with pytest.raises(BadRequest):
            read_run(wrong)


@pytest.mark.parametrize(
    ("name", "number"),
    [("1", 1), ("3", 3), ("4", None), ("0", None), ("01", None), (".1.x", None), ("1/2", None), ("", None)],
)
def test_parts_are_found_by_their_names(name: str, number: int | None) -> None:
    assert part_number(RUN, f"parts/{RUN}/{name}") == number
    assert part_number(RUN, f"parts/{'0' * 16}-3/{name}") is None


def test_each_shard_is_in_one_slice_and_slices_are_about_equal() -> None:
    rng = np.random.default_rng(3)
    for _ in range(50):
        counts = rng.integers(1, 1100, int(rng.integers(1, 200))).tolist()
        root = root_of(counts)
        for slices in (1, 2, 7, 64, 1000, 100_000):
            found = slice_of_shards(root, slices)
            assert found.min() >= 1
            assert found.max() <= slices
            assert (np.diff(found) >= 0).all()
            cells = np.bincount(found, weights=root.counts)
            assert cells.max() < sum(counts) / slices + max(counts)
    assert slice_of_shards(root_of([5, 1, 4]), 2).tolist() == [1, 2, 2]
    assert slice_of_shards(root_of([10_000_000] * 400), 100_000).tolist()[-1] == 99_751


def test_parts_change_the_shards_of_their_slices_alone() -> None:
    root = root_of([4, 4, 4])
    part = replace(
        PART, keys=root.keys[1:2], counts=root.counts[1:2], sizes=PART.sizes[:1], hashes=PART.hashes[1:]
    )
    joined = with_parts(root, [part])
    assert joined.sizes.tolist() == [9, 500, 9]
    assert joined.hashes[1].tolist() == PART.hashes[1].tolist()
    assert not joined.hashes[[0, 2]].any()
    assert joined.layers == {NDT: 3, "points": 1, VOXEL: 1}
    assert root.sizes.tolist() == [9, 9, 9]
    for changes in ({"slice": 1}, {"counts": np.array([5], np.uint32)}, {"keys": root.keys[2:]}):
        with pytest.raises(MapDataError, match="its shards are not those of slice"):
            with_parts(root, [replace(part, **changes)])


# --- what is refused ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"format": "shmmap published map"}, "its format is"),
        ({"version": 0}, "names no version"),
        ({"version": -1}, "names no version"),
        ({"root_content": bytes(31)}, "names no version"),
        ({"slice": 1}, "it is slice 1 of 3, not 2 of 3"),
        ({"slices": 4}, "it is slice 2 of 4, not 2 of 3"),
        ({"layers": {}}, "its layers are none"),
        ({"layers": {NDT: 3, "points": 1}}, "or have points"),
        ({"layers": {NDT: 3}}, "it is of run"),
        ({"layers": {NDT: -1, VOXEL: 1}}, "builder version"),
        ({"layers": {"v" * 201: 1}}, "builder version"),
        ({"layers": {f"voxel(leaf={i}.5)": 1 for i in range(65)}}, "too many"),
        ({"root_content": bytes(32)}, "it is of run"),
        ({"shard_keys": bytes(15)}, "not of one length"),
        ({"shard_keys": struct.pack("<4i", 0, 1, 0, 1)}, "do not ascend"),
        ({"shard_cells": bytes(8)}, "has no cell"),
        ({"shard_cells": bytes(4)}, "not of one length"),
        ({"shard_bytes": struct.pack("<2I", 1, (4 << 20) + 1)}, "larger than"),
        ({"shard_bytes": bytes(8)}, "is empty"),
        ({"shard_sha256": bytes(63)}, "not of one length"),
        ({"slice": "two"}, "MessagePack"),
    ],
)  # fmt: skip
def test_a_part_that_contradicts_itself_or_its_place(changes: dict[str, Any], why: str) -> None:
    with pytest.raises(MapDataError, match=why) as error:
        unpack_part(framed(pack({**unpack(GOLDEN), **changes})), RUN, 2, name="the part")
    assert error.value.cause == "damaged"
    assert str(error.value).startswith("the part: ")


def test_a_part_for_later_readers_says_so_and_what_it_has_more_is_ignored() -> None:
    with pytest.raises(MapDataError, match="update shmmap") as error:
        unpack_part(framed(pack({**unpack(GOLDEN), "min_reader": 2, "slice": None})), RUN, 2)
    assert error.value.cause == "newer"
    assert unpack_part(framed(pack({**unpack(GOLDEN), "more": [1]})), RUN, 2).version == 7


def test_a_bomb_is_refused_before_it_is_unpacked(monkeypatch: pytest.MonkeyPatch) -> None:
    bomb = framed(bytes(MAX_PART_BYTES + 1))
    assert len(bomb) < 10_000
    monkeypatch.setattr(zstandard, "ZstdDecompressor", None)
    with pytest.raises(MapDataError, match="at most 16,777,216 are read"):
        unpack_part(bomb, RUN, 2)


def test_mutated_parts_are_read_or_refused() -> None:
    rng = random.Random(5)
    for _ in range(2000):
        try:
            read = unpack_part(framed(mutate_bytes(GOLDEN, rng, [GOLDEN])), RUN, 2)
        except MapDataError:
            continue
        assert (read.run, read.slice) == (RUN, 2)
