# SPDX-License-Identifier: Apache-2.0
"""The result of one slice of a run: shards of a published map to which layers were added.

A *run* adds layers to one version of a map.  Each of its slices is made independently, on any machine and in
any order; its result is its *part*.  The name of a run is derived from the version's content, the layers and
the number of slices, so programs that make slices of the same run need not communicate.  ``ORIGIN.md``
specifies the format byte by byte.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from hashlib import sha256
from typing import Final, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from shmmap.errors import BadRequest, MapDataError
from shmmap.origin.remote.published_index import (
    Damage,
    Root,
    ShardTable,
    check_layers,
    check_shards,
    decode_map,
    pack_fields,
    unpack_fields,
)
from shmmap.origin.remote.published_object import POINTS
from shmmap.origin.remote.zstd_frame import pack_frame, unpack_frame

PARTS: Final = "parts/"
MAX_PART_BYTES: Final = 16 << 20
"""Size limit of a part's object, packed and unpacked."""
MAX_SLICES: Final = 100_000
FORMAT: Final = "shmmap slice"
READER: Final = 1
_RUN: Final = re.compile(r"([0-9a-f]{16})-([1-9]\d{0,5})")
_DIGEST_BYTES: Final = 32


class RunName(NamedTuple):
    """Name of a run: 16 hex digits, and the number of slices."""

    digest: str
    slices: int

    def __str__(self) -> str:
        return f"{self.digest}-{self.slices}"

    @property
    def path(self) -> str:
        """Folder of the run's parts, relative to the map's URL."""
        return f"{PARTS}{self}/"

    def part_path(self, number: int) -> str:
        """Return the path of a slice's part; slices are numbered from 1."""
        return f"{self.path}{number}"


def run_of(content: bytes, layers: Iterable[str], slices: int) -> RunName:
    """Return the name of a run.

    Parameters
    ----------
    content
        Content digest of the version's root, 32 bytes.
    layers
        Specs in canonical form, in any order.
    """
    named = content + struct.pack("<I", slices)
    for layer in sorted(layers):
        spec = layer.encode()
        named += struct.pack("<I", len(spec)) + spec
    return RunName(sha256(named).digest()[:8].hex(), slices)


def read_run(text: str) -> RunName:
    """Parse the name of a run; raise `BadRequest` if the text is not a run's name."""
    found = _RUN.fullmatch(text)
    if found is None or int(found[2]) > MAX_SLICES:
        raise BadRequest(
            f"{text!r} is no name of a run", hint="`shmmap prepare URL --layer ... --shards I/N` prints it"
        )
    return RunName(found[1], int(found[2]))


def part_number(run: RunName, path: str) -> int | None:
    """Return the number of the slice whose part is at ``path``; None if that is not a part of this run."""
    name = path.removeprefix(run.path)
    is_one = path.startswith(run.path) and re.fullmatch(r"[1-9]\d{0,5}", name) is not None
    return int(name) if is_one and int(name) <= run.slices else None


def slice_of_shards(root: Root, slices: int) -> NDArray[np.int64]:
    """Return the slice of each shard of a root, (S,) int64, ascending; the first slice is 1.

    All slices have about the same number of cells; a slice may have no shard.
    """
    found: NDArray[np.int64] = root.first_indices[:-1] * slices // root.cells + 1
    return found


class _Head(msgspec.Struct, frozen=True):
    """The fields that show whether the rest of a part can be read."""

    format: str
    min_reader: int


class PartFields(_Head, frozen=True):
    """The MessagePack map of a part: those of `_Head`, and then these, in this order of keys."""

    version: int
    root_content: bytes
    slice: int
    slices: int
    layers: dict[str, int]
    shard_keys: bytes
    shard_cells: bytes
    shard_bytes: bytes
    shard_sha256: bytes


# created at import: msgspec crashes the process if two threads decode a type for the first time at once
_HEAD: Final = msgspec.msgpack.Decoder(_Head)
_PART: Final = msgspec.msgpack.Decoder(PartFields)


@dataclass(frozen=True, slots=True, eq=False)
class Part(ShardTable):
    """The result of a slice: the layers of its run, and its shards, whose objects include these layers.

    Attributes
    ----------
    version
        Number of the version that the part was made from.
    root_content
        Content digest of that version's root, 32 bytes.
    slice, slices
        Number of the slice, from 1, and number of slices.
    """

    version: int
    root_content: bytes
    slice: int
    slices: int

    @property
    def run(self) -> RunName:
        """The run that the part belongs to."""
        return run_of(self.root_content, self.layers, self.slices)


def pack_part(part: Part) -> bytes:
    """Return the object of a part."""
    fields = PartFields(format=FORMAT, min_reader=READER, **pack_fields(part, PartFields))
    return pack_frame(msgspec.msgpack.encode(fields))


def unpack_part(frame: bytes | memoryview, run: RunName, number: int, *, name: str = "") -> Part:
    """Read and check the object of a slice's part.

    Parameters
    ----------
    run, number
        The run and the slice that the part's path names; the part must belong to both.
    name
        Name of the object, for messages.

    Raises
    ------
    MapDataError
        The object is not a valid part of that slice (cause ``damaged``), or needs a later reader (``newer``).
    """
    name = name or run.part_path(number)
    wrong = Damage(name)
    unpacked = unpack_frame(frame, MAX_PART_BYTES, name=name)
    head = decode_map(unpacked, _HEAD, wrong)
    if head.format != FORMAT:
        raise wrong(f"its format is {head.format[:40]!r}, not {FORMAT!r}")
    if head.min_reader > READER:
        raise MapDataError(
            f"it needs reader {head.min_reader}, this is reader {READER}",
            path=name,
            cause="newer",
            hint="update shmmap",
        )
    found = decode_map(unpacked, _PART, wrong)
    if len(found.root_content) != _DIGEST_BYTES or not 1 <= found.version < 1 << 63:
        raise wrong("it names no version")
    if (found.slice, found.slices) != (number, run.slices):
        raise wrong(f"it is slice {found.slice} of {found.slices}, not {number} of {run.slices}")
    if not found.layers or POINTS in found.layers:
        raise wrong("its layers are none, or have points")
    check_layers(found.layers, wrong)
    part = Part(**unpack_fields(found, wrong))
    check_shards(part.keys, part.sizes, wrong)
    if not part.counts.all():
        raise wrong("a shard has no cell")
    if part.run != run:
        raise wrong(f"it is of run {part.run}")
    return part


def shards_of(root: Root, part: Part) -> NDArray[np.intp] | None:
    """Return the numbers of a part's shards in a root, ascending; None if the slice has other shards."""
    numbers = np.flatnonzero(slice_of_shards(root, part.slices) == part.slice)
    same = np.array_equal(root.keys[numbers], part.keys) and np.array_equal(root.counts[numbers], part.counts)
    return numbers if same else None


def with_parts(root: Root, parts: Sequence[Part]) -> Root:
    """Return the root with the shards of these parts, and with the layers of their run added.

    Raises
    ------
    MapDataError
        A part has other shards than those of its slice.
    """
    sizes, hashes = root.sizes.copy(), root.hashes.copy()
    layers = dict(root.layers)
    for part in parts:
        numbers = shards_of(root, part)
        if numbers is None:
            wrong = Damage(part.run.part_path(part.slice))
            raise wrong(f"its shards are not those of slice {part.slice} of {part.slices}")
        sizes[numbers], hashes[numbers] = part.sizes, part.hashes
        layers |= part.layers
    return replace(root, layers=dict(sorted(layers.items())), sizes=sizes, hashes=hashes)
