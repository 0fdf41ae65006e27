# SPDX-License-Identifier: Apache-2.0
"""The index of a published map: golden bytes, which shards an area needs, versions, and what is refused."""

from __future__ import annotations

import math
import random
import struct
from dataclasses import replace
from hashlib import sha256
from typing import Any

import msgspec
import numpy as np
import pytest
import xxhash

from shmmap.errors import MapDataError
from shmmap.layers.spec import MAX_SPEC_CHARACTERS
from shmmap.segment.version import cell_version
from tests.support.fuzzing import mutate_bytes
from tests.support.message_pack import pack, unpack

zstandard = pytest.importorskip("zstandard", reason="zstandard is not installed")

from shmmap.origin.remote.published_index import (  # noqa: E402
    LayerObjects,
    Root,
    Shard,
    pack_root,
    pack_shard,
    published_layer_version,
    unpack_root,
    unpack_shard,
)

NDT = "ndt(leaf=2.0)"
NO_SHARD = dict.fromkeys(("shard_keys", "shard_cells", "shard_bytes", "shard_sha256"), b"")
BOXES = np.array([[-20.0, 0, 0, 20], [0, 0, 20, 20]])


def hashes(first: int, count: int = 2) -> Any:
    return np.frombuffer(bytes(range(first, first + 32 * count)), np.uint8).reshape(count, 32)


def objects(first: int, sizes: tuple[int, ...] = (1000, 2000)) -> LayerObjects:
    return LayerObjects(
        np.array(sizes, np.uint32), np.array([8192, 4096], np.uint32), hashes(first), hashes(first + 64)
    )


def with_raws(*raws: int) -> LayerObjects:
    return replace(objects(0), raws=np.array(raws, np.uint32))


def shard_of(**changes: Any) -> Shard:
    described = {
        "names": (b"-20_0.pcd", b"b/0_0.pcd"),
        "boxes": BOXES,
        "z": np.array([[-1.5, 2.25], [math.nan, math.nan]]),
        "points": np.array([5, 0], np.uint32),
        "layers": {"points": objects(0), NDT: objects(100)},
    }
    return Shard(**{**described, **changes})


def framed(unpacked: bytes) -> bytes:
    return bytes(zstandard.ZstdCompressor().compress(unpacked))


def root_of(shard: bytes, **changes: Any) -> Root:
    described = {
        "id_prefix": "/town/",
        "frame_id": "map",
        "crs": "EPSG:32632",
        "origin": (1.0, 2.0, 3.0),
        "unit_m": (1.0, 0.3048),
        "encoding": "exact",
        "cells": 2,
        "bounds": (-20.0, 0.0, 20.0, 20.0),
        "shard_m": 640.0,
        "largest_m": (20.0, 20.0),
        "mean_m": (20.0, 20.0),
        "layers": {"points": 1, NDT: 3},
        "keys": np.array([[0, 0]], np.int32),
        "counts": np.array([2], np.uint32),
        "sizes": np.array([len(shard)], np.uint32),
        "hashes": np.frombuffer(sha256(shard).digest(), np.uint8).reshape(1, 32),
    }
    return Root(**{**described, **changes})


# one shard at (0, 0): both corners lie right of x = 0 here
ONE = shard_of(boxes=BOXES + np.array([20.0, 0, 20, 0]))
ONE_FRAME = framed(pack_shard(ONE))
GOLDEN_ROOT = (
    b"\xde\x00\x12"
    b"\xa6format\xb4shmmap published map"
    b"\xaamin_reader\x01"
    b"\xa9id_prefix\xa6/town/"
    b"\xa8frame_id\xa3map"
    b"\xa3crs\xaaEPSG:32632"
    b"\xa6origin\x93" + b"".join(b"\xcb" + struct.pack(">d", v) for v in (1, 2, 3)) + b"\xa6unit_m\x92"
    b"" + b"".join(b"\xcb" + struct.pack(">d", v) for v in (1, 0.3048)) + b"\xa8encoding\xa5exact"
    b"\xa5cells\x02"
    b"\xa6bounds\x94" + b"".join(b"\xcb" + struct.pack(">d", v) for v in (-20, 0, 20, 20)) + b"\xa7shard_m"
    b"\xcb" + struct.pack(">d", 640) + b"\xa9largest_m\x92" + 2 * (b"\xcb" + struct.pack(">d", 20)) + b"\xa6"
    b"mean_m\x92"
    + 2
    * (b"\xcb" + struct.pack(">d", 20))
    + b"\xa6layers\x82\xadndt(leaf=2.0)\x03\xa6points\x01"
    b"\xaashard_keys\xc4\x08\xff\xff\xff\xff\x02\x00\x00\x00"
    b"\xabshard_cells\xc4\x04\x02\x00\x00\x00"
    b"\xabshard_bytes\xc4\x04\xe8\x03\x00\x00"
    b"\xacshard_sha256\xc4\x20" + bytes(range(32))
)
GOLDEN_LAYER = (
    b"\x84\xa4size\xc4\x08\xe8\x03\x00\x00\xd0\x07\x00\x00"
    b"\xa8raw_size\xc4\x08\x00\x20\x00\x00\x00\x10\x00\x00"
    b"\xa6sha256\xc4\x40%b\xaecontent_sha256\xc4\x40%b"
)
GOLDEN_SHARD = (
    b"\x85\xa5names\xc4\x13-20_0.pcd\x00b/0_0.pcd"
    b"\xa5boxes\xc4\x40" + struct.pack("<8d", -20, 0, 0, 20, 0, 0, 20, 20) + b"\xa1z\xc4\x20"
    b"" + struct.pack("<4d", -1.5, 2.25, math.nan, math.nan) + b"\xa6points\xc4\x08\x05"
    + bytes(7) + b""
    b"\xa6layers\x82\xadndt(leaf=2.0)"
    + GOLDEN_LAYER % (bytes(range(100, 164)), bytes(range(164, 228)))
    + b"\xa6points"
    + GOLDEN_LAYER % (bytes(range(64)), bytes(range(64, 128)))
)  # fmt: skip


def test_golden_bytes_of_a_root() -> None:
    root = root_of(
        b"", keys=np.array([[-1, 2]], np.int32), sizes=np.array([1000], np.uint32), hashes=hashes(0, 1)
    )
    assert pack_root(root) == GOLDEN_ROOT
    read = unpack_root(framed(GOLDEN_ROOT))
    assert read.map_version == int(sha256(GOLDEN_ROOT).hexdigest()[:16], 16)
    for name in ("id_prefix", "crs", "origin", "unit_m", "bounds", "shard_m", "largest_m", "layers", "cells"):
        assert getattr(read, name) == getattr(root, name), name
    assert pack_root(read) == GOLDEN_ROOT


def test_golden_bytes_of_a_shard() -> None:
    assert pack_shard(shard_of()) == GOLDEN_SHARD


def test_versions_follow_from_content_not_from_names_of_objects() -> None:
    stamp = bytes(range(64, 88))
    version = ONE.version(0, "/town/")
    assert version == cell_version("/town/-20_0.pcd", stamp, (0.0, 0.0, 20.0, 20.0))
    renamed = shard_of(layers={"points": replace(objects(0), hashes=hashes(9))}, boxes=ONE.boxes)
    assert renamed.version(0, "/town/") == version
    changed = shard_of(layers={"points": replace(objects(0), contents=hashes(9))}, boxes=ONE.boxes)
    assert changed.version(0, "/town/") != version
    spec = NDT.encode()
    by_hand = struct.pack("<QI", version, len(spec)) + spec + struct.pack("<I", 3) + bytes(range(32))
    assert published_layer_version(version, NDT, 3, bytes(range(32))) == xxhash.xxh3_64_intdigest(by_hand)


# --- areas --------------------------------------------------------------------------------------------


def test_only_neighbours_are_asked_below_and_left() -> None:
    keys = np.array([[row, column] for row in range(-3, 4) for column in range(-3, 4)], np.int32)
    root = root_of(b"", keys=keys, bounds=(-1920.0, -1920.0, 2560.0, 2560.0))
    assert root.keys[root.shards_near((100.0, 100.0, 200.0, 200.0))].tolist() == [[0, 0]]
    at_a_corner = root.keys[root.shards_near((10.0, 10.0, 200.0, 200.0))].tolist()
    assert at_a_corner == [[-1, -1], [-1, 0], [0, -1], [0, 0]]
    assert root.shards_near((1e9, 1e9, 2e9, 2e9)).tolist() == []
    assert len(root.shards_near((-math.inf, -math.inf, math.inf, math.inf))) == 49
    assert root.shards_near((math.nan,) * 4).tolist() == []


# --- what is refused ----------------------------------------------------------------------------------


def altered(**changes: Any) -> bytes:
    found = unpack(pack_root(root_of(ONE_FRAME)))
    return framed(pack({**found, **changes}))


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"format": "something else"}, "its format is 'something else'"),
        ({"id_prefix": "town/"}, "cannot begin ids"),
        ({"id_prefix": "/town"}, "cannot begin ids"),
        ({"crs": "x" * 5000}, "too long"),
        ({"shard_m": 0.0}, "not positive"),
        ({"shard_m": math.nan}, "not finite"),
        ({"unit_m": [0.0, 1.0]}, "not positive"),
        ({"bounds": [1.0, 0.0, 0.0, 1.0]}, "no rectangle"),
        ({"largest_m": [-1.0, 1.0]}, "not positive"),
        ({"layers": {NDT: 1}}, "no points"),
        ({"layers": {"points": -1}}, "builder version"),
        ({"layers": {"points": 1, "v" * 201: 1}}, "no spec"),
        ({"layers": {"points": 1, **{f"voxel(leaf={i}.5)": 1 for i in range(64)}}}, "too many"),
        ({"cells": 3}, "do not have 3 cells"),
        ({"shard_keys": bytes(16)}, "not of one length"),
        ({"shard_cells": b""}, "not of one length"),
        ({"shard_cells": bytes(4), "cells": 0}, "cells"),
        ({**NO_SHARD, "cells": 0}, "no shard"),
        ({"shard_bytes": struct.pack("<I", (4 << 20) + 1)}, "larger than"),
        ({"shard_bytes": bytes(4)}, "is empty"),
        ({"shard_sha256": bytes(31)}, "not of one length"),
        ({"cells": "two"}, "MessagePack"),
        ({"origin": [1.0, 2.0]}, "MessagePack"),
        ({"bounds": [-1e308, 0.0, 1e308, 1.0]}, "out of range"),
        ({"origin": [0.0, 1e300, 0.0]}, "out of range"),
        ({"shard_m": 1e13}, "out of range"),
        ({"largest_m": [1e308, 1.0]}, "out of range"),
        ({"unit_m": [1e-300, 1.0]}, "out of range"),
    ],
)  # fmt: skip
def test_a_root_that_contradicts_itself(changes: dict[str, Any], why: str) -> None:
    with pytest.raises(MapDataError, match=why) as error:
        unpack_root(altered(**changes))
    assert error.value.cause == "damaged"


@pytest.mark.parametrize("changes", [{"min_reader": 2, "shard_keys": "other"}, {"encoding": "cm"}])
def test_a_root_for_later_readers_says_so(changes: dict[str, Any]) -> None:
    with pytest.raises(MapDataError) as error:
        unpack_root(altered(**changes))
    assert (error.value.cause, error.value.hint) == ("newer", "update shmmap")


def test_a_layer_may_have_the_longest_spec_there_is() -> None:
    longest = "v" * MAX_SPEC_CHARACTERS
    assert longest in unpack_root(altered(layers={"points": 1, longest: 1})).layers


def test_what_a_later_root_has_more_is_ignored() -> None:
    assert unpack_root(altered(more=[1, {"a": None}])).cells == 2


def test_shards_ascend() -> None:
    two = {
        "shard_cells": struct.pack("<2I", 1, 1),
        "shard_bytes": struct.pack("<2I", 9, 9),
        "shard_sha256": bytes(64),
    }
    assert unpack_root(altered(**two, shard_keys=struct.pack("<4i", -1, 5, 0, -9))).cells == 2
    for keys in ((0, 0, 0, 0), (0, 1, 0, 0), (1, 0, 0, 1)):
        with pytest.raises(MapDataError, match="ascend"):
            unpack_root(altered(**two, shard_keys=struct.pack("<4i", *keys)))


def shard_refusal(shard: Shard, **root_changes: Any) -> str:
    frame = framed(pack_shard(shard))
    with pytest.raises(MapDataError) as error:
        unpack_shard(frame, root_of(frame, **root_changes), 0)
    assert error.value.cause == "damaged"
    return str(error.value)


@pytest.mark.parametrize(
    "names",
    [
        (b"", b"b"), (b"../a", b"b"), (b"a/../../b", b"c"), (b"/etc/passwd", b"b"), (b"a//b", b"c"),
        (b"./a", b"b"), (b"a/", b"b"), (b"\xff", b"\xff\xff"), (b"a",), (b"a", b"b", b"c"),
    ],
)  # fmt: skip
def test_names_that_leave_the_map_are_refused(names: tuple[bytes, ...]) -> None:
    assert "its names are not those" in shard_refusal(replace(ONE, names=names))


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"names": (b"b", b"a")}, "do not ascend"),
        ({"names": (b"a", b"a")}, "do not ascend"),
        ({"boxes": ONE.boxes[:, [2, 1, 0, 3]]}, "no rectangle"),
        ({"boxes": ONE.boxes * np.array([1, 1, math.nan, 1])}, "no rectangle"),
        ({"boxes": ONE.boxes + np.array([0, 0, 1, 0])}, "larger than the root's largest"),
        ({"boxes": ONE.boxes + 640.0}, "in another shard"),
        ({"boxes": ONE.boxes[:1]}, "not of one length"),
        ({"z": np.array([[2.0, 1.0], [0, 0]])}, "above its highest"),
        ({"z": np.array([[math.nan, 1.0], [0, 0]])}, "above its highest"),
        ({"z": np.array([[0.0, 1e308], [0, 0]])}, "out of range"),
        ({"boxes": ONE.boxes + 1e300}, "out of range"),
        ({"points": np.array([1], np.uint32)}, "not of one length"),
        ({"layers": {"points": objects(0)}}, "its layers"),
        ({"layers": {"points": objects(0), "voxel(leaf=1.0)": objects(1)}}, "its layers"),
        ({"layers": {"points": objects(0, (0, 1)), NDT: objects(1)}}, "out of range"),
        ({"layers": {"points": objects(0, (1, 1 << 20)), NDT: objects(1)}}, "out of range"),
        ({"layers": {"points": with_raws(4095, 4096), NDT: objects(1)}}, "out of range"),
        ({"layers": {"points": with_raws(4096, 1 << 31), NDT: objects(1)}}, "out of range"),
    ],
)  # fmt: skip
def test_a_shard_that_contradicts_itself_or_its_root(changes: dict[str, Any], why: str) -> None:
    assert why in shard_refusal(replace(ONE, **changes))


def test_another_shard_is_refused_before_it_is_unpacked(monkeypatch: pytest.MonkeyPatch) -> None:
    root = root_of(ONE_FRAME)
    monkeypatch.setattr(zstandard, "ZstdDecompressor", None)
    with pytest.raises(MapDataError, match="its SHA-256 is not its name"):
        unpack_shard(ONE_FRAME + b"\0", root, 0)


def test_bombs_are_not_unpacked(monkeypatch: pytest.MonkeyPatch) -> None:
    root_bomb, shard_bomb = framed(bytes((16 << 20) + 1)), framed(bytes((4 << 20) + 1))
    monkeypatch.setattr(zstandard, "ZstdDecompressor", None)
    with pytest.raises(MapDataError, match="at most 16,777,216"):
        unpack_root(root_bomb)
    with pytest.raises(MapDataError, match="at most 4,194,304"):
        unpack_shard(shard_bomb, root_of(shard_bomb), 0)


def test_nested_bombs_are_errors() -> None:
    for data in (b"\x91" * 100_000, b"\xdd\xff\xff\xff\xff", b"\x81\xa6format" + b"\x91" * 100_000, b""):
        with pytest.raises(MapDataError):
            unpack_root(framed(data))


def test_whatever_is_in_a_root_or_a_shard_is_read_or_refused_clearly() -> None:
    rng = random.Random(8)
    good_root, good_shard = pack_root(root_of(ONE_FRAME)), pack_shard(ONE)
    outcomes = {"read": 0, "refused": 0}
    for _ in range(1500):
        frame = framed(mutate_bytes(good_root, rng, [good_root, good_shard]))
        try:
            root = unpack_root(frame)
            root.shards_near((0.0, 0.0, 1.0, 1.0))
            outcomes["read"] += 1
        except MapDataError:
            outcomes["refused"] += 1
        frame = framed(mutate_bytes(good_shard, rng, [good_root, good_shard]))
        try:
            shard = unpack_shard(frame, root_of(frame), 0)
            assert [shard.version(row, "/") for row in range(len(shard))]
            outcomes["read"] += 1
        except MapDataError:
            outcomes["refused"] += 1
    assert min(outcomes.values()) > 20, outcomes


def test_the_fields_are_those_of_the_document() -> None:
    from importlib.resources import files

    from shmmap.origin.remote import map_versions, published_index

    page = files("shmmap.origin.remote").joinpath("ORIGIN.md").read_text(encoding="utf-8")
    documented = [line.split("`")[1] for line in page.splitlines() if line.startswith("| `")]
    keys = [
        *map_versions.Current.__struct_fields__,
        *map_versions.Entry.__struct_fields__[3:],
        *published_index.RootFields.__struct_fields__,
        *published_index.ShardFields.__struct_fields__,
        *published_index.LayerFields.__struct_fields__,
    ]
    at = documented.index("version")
    assert documented[at : at + len(keys)] == keys
    assert all(field.required for field in msgspec.structs.fields(published_index.RootFields))
