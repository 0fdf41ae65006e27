# SPDX-License-Identifier: Apache-2.0
"""Published maps in directories, read from ORIGIN.md and LAYOUT.md, and signed by python-tuf, alone."""

from __future__ import annotations

import hashlib
import json
import math
import struct
from dataclasses import dataclass
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import numpy as np
import xxhash
from cryptography.hazmat.primitives.serialization import load_pem_private_key
from numpy.typing import NDArray
from securesystemslib.signer import CryptoSigner
from tuf.api.metadata import Metadata

from tests.support.message_pack import unpack

EMPTY = {"source": (56, 80), "source_digest": (80, 96), "box": (96, 128), "mm_origin": (296, 320)}


@dataclass
class ReadCell:
    """A cell: its columns by layer, and its versions."""

    box: tuple[float, ...]
    z: tuple[float, float]
    points: int
    columns: dict[str, dict[str, NDArray[Any]]]
    versions: dict[str, int]
    index: int


class PublishedMapReader:
    """Reads every object of the current version and checks all that the pages say of it."""

    def __init__(self, root: Path) -> None:
        self.directory = root
        self.current = json.loads((root / "CURRENT").read_bytes())
        self.entry = json.loads((root / f"versions/{self.current['version']}.json").read_bytes())
        assert [*self.current] == ["version", "root", "bytes"]
        assert {key: self.entry[key] for key in self.current} == self.current
        assert [*self.entry][3:] == ["created", "before", "restored"]
        frame = self.blob(bytes.fromhex(self.current["root"]), self.current["bytes"])
        unpacked = unframed(frame, 16 << 20)
        self.map_version = int(hashlib.sha256(unpacked).hexdigest()[:16], 16)
        self.root: dict[str, Any] = unpack(unpacked)
        assert self.root["format"] == "shmmap published map"
        assert self.root["min_reader"] == 1
        self.cells: dict[str, ReadCell] = {}
        self.index_bytes = len(frame)
        self._read_shards()
        assert len(self.cells) == self.root["cells"]

    def blob(self, digest: bytes, size: int) -> bytes:
        """An object, verified."""
        data = (self.directory / "blobs/sha256" / digest.hex()).read_bytes()
        assert len(data) == size
        assert hashlib.sha256(data).digest() == digest
        return data

    def _read_shards(self) -> None:
        root = self.root
        keys = np.frombuffer(root["shard_keys"], "<i4").reshape(-1, 2)
        counts = np.frombuffer(root["shard_cells"], "<u4")
        sizes = np.frombuffer(root["shard_bytes"], "<u4")
        assert keys.tolist() == sorted(keys.tolist())
        at = 0
        for number, (row, column) in enumerate(keys.tolist()):
            frame = self.blob(root["shard_sha256"][32 * number : 32 * number + 32], int(sizes[number]))
            self.index_bytes += len(frame)
            shard = unpack(unframed(frame, 4 << 20))
            names = shard["names"].split(b"\0")
            assert len(names) == counts[number]
            assert names == sorted(names)
            boxes = struct.iter_unpack("<4d", shard["boxes"])
            z = struct.iter_unpack("<2d", shard["z"])
            points = np.frombuffer(shard["points"], "<u4").tolist()
            assert list(shard["layers"]) == sorted(root["layers"])
            for i, (name, box, heights, rows) in enumerate(zip(names, boxes, z, points, strict=True)):
                assert (math.floor(box[1] / root["shard_m"]), math.floor(box[0] / root["shard_m"])) == (
                    row,
                    column,
                )
                cell_id = root["id_prefix"] + name.decode()
                self.cells[cell_id] = self._cell(cell_id, shard, i, box, heights, rows, at + i)
            at += len(names)

    def _cell(
        self,
        cell_id: str,
        shard: dict[str, Any],
        row: int,
        box: tuple[float, ...],
        z: Any,
        rows: int,
        index: int,
    ) -> ReadCell:
        columns, versions = {}, {}
        stamp = shard["layers"]["points"]["content_sha256"][32 * row : 32 * row + 24]
        name = cell_id.encode()
        points_version = xxhash.xxh3_64_intdigest(
            struct.pack("<I", len(name)) + name + struct.pack("<I", 24) + stamp + struct.pack("<4d", *box)
        )
        for spec, layer in shard["layers"].items():
            size, raw = (struct.unpack_from("<I", layer[key], 4 * row)[0] for key in ("size", "raw_size"))
            content = layer["content_sha256"][32 * row : 32 * row + 32]
            unpacked = unframed(self.blob(layer["sha256"][32 * row : 32 * row + 32], size), raw)
            assert len(unpacked) == raw
            assert hashlib.sha256(unpacked).digest() == content
            columns[spec] = columns_of(unpacked, spec, self.root["layers"][spec])
            versions[spec] = (
                points_version
                if spec == "points"
                else xxhash.xxh3_64_intdigest(
                    struct.pack("<QI", points_version, len(spec))
                    + spec.encode()
                    + struct.pack("<I", self.root["layers"][spec])
                    + content
                )
            )
        return ReadCell(box, z, rows, columns, versions, index)


def unframed(frame: bytes, most: int) -> bytes:
    """What is in a frame."""
    import zstandard  # which tests without it skip

    assert 0 <= zstandard.frame_content_size(frame) <= most
    return zstandard.ZstdDecompressor().decompress(frame)


def columns_of(unpacked: bytes, layer: str, builder_version: int) -> dict[str, NDArray[Any]]:
    """The columns of an unpacked object, as they will be in memory."""
    assert unpacked[:8] == b"SHMMAP\x00\x01"
    header_bytes, total_bytes = struct.unpack_from("<QQ", unpacked, 16)
    assert total_bytes == len(unpacked)
    flags = struct.unpack_from("<I", unpacked, 208)[0]
    assert flags in (1, 3)
    assert flags == 1 or layer == "points"
    for name, (first, last) in EMPTY.items():
        assert unpacked[first:last] == bytes(last - first) or (flags == 3 and name == "mm_origin")
    mm_origin = struct.unpack_from("<3d", unpacked, 296)
    count, table, row_bytes = struct.unpack_from("<III", unpacked, 172)
    assert struct.unpack_from("<I", unpacked, 168)[0] == builder_version
    id_bytes, _, layer_at, layer_bytes, _, frame_bytes = (
        struct.unpack_from("<I", unpacked, at)[0] for at in (188, 192, 192, 196, 200, 204)
    )
    assert id_bytes == frame_bytes == 0
    assert unpacked[layer_at : layer_at + layer_bytes].decode() == layer
    assert unpacked[header_bytes - 64 : header_bytes] == bytes(64)
    found = {}
    for i in range(count):
        at = table + i * row_bytes
        name = unpacked[at : at + 40].rstrip(b"\0").decode()
        dtype = np.dtype(unpacked[at + 40 : at + 48].rstrip(b"\0").decode())
        dimensions, _, *shape = struct.unpack_from("<II4Q", unpacked, at + 64)
        offset, nbytes, checksum = struct.unpack_from("<QQQ", unpacked, at + 104)
        row = dtype.itemsize
        if dimensions == 2 and 1 <= shape[1] <= 8:
            row *= shape[1]
        planes = unpacked[offset : offset + nbytes]
        count_rows = nbytes // row
        data = bytearray(nbytes)
        for b in range(row):
            data[b::row] = planes[b * count_rows : (b + 1) * count_rows]
        values = np.frombuffer(bytes(data), dtype).reshape(shape[:dimensions])
        if flags == 3 and name == "xyz":
            assert dtype == "<u2"
            values = (np.array(mm_origin) + 0.001 * values.astype(np.float64)).astype("<f4")
        assert xxhash.xxh3_64_intdigest(np.ascontiguousarray(values).tobytes()) == checksum
        found[name] = values
    return found


# A signed map, read and changed with python-tuf alone: nothing of shmmap's own signing is used


class Signed:
    """The newest metadata of a map in a directory, each verified with the key of its role."""

    def __init__(self, store: Path, keys: Path) -> None:
        self.store, self.keys = store, keys
        self.root: Any = Metadata.from_file(str(store / "1.root.json"))
        assert (store / "1.root.json").read_bytes() == (keys / "ROOT.json").read_bytes()
        while (path := store / f"{self.root.signed.version + 1}.root.json").exists():
            following: Any = Metadata.from_file(str(path))
            for root in (self.root, following):
                root.signed.verify_delegate("root", following.signed_bytes, following.signatures)
            assert following.signed.version == self.root.signed.version + 1
            self.root = following
        self.timestamp: Any = self._read("timestamp.json", "timestamp")
        number = self.timestamp.signed.snapshot_meta.version
        self.snapshot: Any = self._read(f"{number}.snapshot.json", "snapshot")
        number = self.snapshot.signed.meta["targets.json"].version
        self.targets: Any = self._read(f"{number}.targets.json", "targets")
        (self.target,) = self.targets.signed.targets.values()
        assert self.target.path == "root"

    def _read(self, name: str, role: str) -> Any:
        found: Any = Metadata.from_file(str(self.store / name))
        self.root.signed.verify_delegate(role, found.signed_bytes, found.signatures)
        assert found.signed.type == role
        return found

    @property
    def version(self) -> int:
        number: int = self.target.custom["map_version"]
        return number

    @property
    def current(self) -> dict[str, Any]:
        """What ``CURRENT`` has to say."""
        return {
            "version": self.version,
            "root": self.target.hashes["sha256"],
            "bytes": self.target.length,
        }

    def write(self, role: str, **fields: Any) -> None:
        """Sign a role's newest metadata again, with other fields, under the same name."""
        metadata = getattr(self, role)
        for name, value in fields.items():
            setattr(metadata.signed, name, value)
        key = {"snapshot": "online", "timestamp": "online"}.get(role, role)
        private = load_pem_private_key((self.keys / f"{key}.pem").read_bytes(), None)
        metadata.sign(CryptoSigner(private))
        name = "timestamp.json" if role == "timestamp" else f"{metadata.signed.version}.{role}.json"
        metadata.to_file(str(self.store / name))

    def write_all(self, number: int, *, timestamp: int = 0, **fields: Any) -> None:
        """Sign targets with other fields, snapshot and timestamp, all with this number."""
        self.write("targets", version=number, **fields)
        self.snapshot.signed.meta["targets.json"].version = number
        self.timestamp.signed.snapshot_meta.version = number
        self.write("snapshot", version=number)
        self.write("timestamp", version=timestamp or number)


def read_signed(store: Path, keys: Path) -> Signed:
    """Read a signed map whose entry and ``CURRENT`` say what is signed."""
    signed = Signed(store, keys)
    current = json.loads((store / "CURRENT").read_bytes())
    entry = json.loads((store / f"versions/{signed.version}.json").read_bytes())
    assert current == signed.current
    assert {name: entry[name] for name in current} == current
    return signed


def in_days(days: float) -> datetime:
    return datetime.now(timezone.utc).replace(microsecond=0) + timedelta(days=days)
