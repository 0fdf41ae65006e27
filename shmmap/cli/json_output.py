# SPDX-License-Identifier: Apache-2.0
"""JSON output that several verbs share, and the schemas of all verbs; imported only for ``--json``."""

from __future__ import annotations

import importlib
import inspect
from typing import Annotated, Any, TypeAlias, get_type_hints

import msgspec

from shmmap.cli.screens.output import user_name
from shmmap.protocol import rows
from shmmap.segment.names import retired_name, segment_prefix

Hex: TypeAlias = Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{16}$", description="64 bits")]
Point: TypeAlias = tuple[float, float, float]
Box: TypeAlias = Annotated[
    tuple[float, float, float, float],
    msgspec.Meta(description="min x, min y, max x, max y: metres, map frame"),
]


def hexed(number: int) -> str:
    """Return a 64-bit number as 16 hexadecimal digits."""
    return f"{number:016x}"


class Failure(msgspec.Struct):
    """A layer of a cell that could not be made."""

    id: str
    layer: str
    message: str


class Holder(msgspec.Struct):
    """A process that holds memory; session 0 and pid 0: a process that did not use the client library."""

    session: Hex
    pid: int
    uid: int
    user: str
    client: str
    command: str
    cells: int
    bytes: int

    @classmethod
    def of(cls, row: rows.Holder) -> Holder:
        """Return the JSON form of a holder's row."""
        return cls(
            hexed(row.session),
            row.pid,
            row.uid,
            user_name(row.uid),
            row.client,
            row.command,
            row.cells,
            row.bytes,
        )


class Client(msgspec.Struct):
    """A client; ``cells`` and ``bytes`` are those that it holds."""

    session: Hex
    pid: Annotated[int, msgspec.Meta(description="as the kernel says; 0: unknown")]
    uid: int
    gid: int
    user: str
    client: str
    command: str
    cells: int
    bytes: int
    requests: int
    idle_s: float
    pose: Annotated[tuple[float, float] | None, msgspec.Meta(description="metres, map frame")]
    heading: float | None
    mapped_bytes: Annotated[
        int | msgspec.UnsetType, msgspec.Meta(description="mapped now, as the kernel says")
    ] = msgspec.UNSET
    superseded: Annotated[
        int | msgspec.UnsetType, msgspec.Meta(description="stale or retired segments among those")
    ] = msgspec.UNSET
    superseded_bytes: int | msgspec.UnsetType = msgspec.UNSET

    @classmethod
    def of(cls, row: rows.ClientRow, now_monotonic_ns: int, *, mapped: bool = False) -> Client:
        """Return the JSON form of a client's row, with its mapped bytes if ``mapped``."""
        found = cls(
            hexed(row.session),
            row.pid,
            row.uid,
            row.gid,
            user_name(row.uid),
            row.client,
            row.command,
            row.cells,
            row.bytes,
            row.requests,
            round(row.idle_s(now_monotonic_ns), 3),
            row.pose,
            row.heading,
        )
        if mapped:
            found.mapped_bytes = row.mapped_bytes
            found.superseded, found.superseded_bytes = row.superseded, row.superseded_bytes
        return found


class Segment(msgspec.Struct):
    """A layer of a cell in shared memory; state "zombie" is a retired segment that clients still map."""

    id: str
    version: Hex
    layer: str
    state: rows.CellState
    segment: str
    ahead: Annotated[bool, msgspec.Meta(description="prefetched, and not requested yet")]
    bytes: int
    points: int
    box: Box
    hits: int
    idle_s: Annotated[float | None, msgspec.Meta(description="since the last use; null: never used")]
    load_s: float
    holders: list[Holder] | msgspec.UnsetType = msgspec.UNSET

    @classmethod
    def of(cls, row: rows.CellRow, now_monotonic_ns: int, *, id_prefix: str, instance: str) -> Segment:
        """Return the JSON form of a row in a list, whose names lack their prefixes."""
        found = cls.whole(row, now_monotonic_ns)
        found.id = row.id if row.id.startswith("/") else id_prefix + row.id
        name = segment_prefix(instance) + row.segment
        found.segment = retired_name(name) if row.retired else name
        return found

    @classmethod
    def whole(cls, row: rows.CellRow, now_monotonic_ns: int) -> Segment:
        """Return the JSON form of a row whose names are complete."""
        idle_s = row.idle_s(now_monotonic_ns)
        return cls(
            row.id,
            hexed(row.version),
            row.layer,
            row.state,
            row.segment,
            row.ahead,
            row.bytes,
            row.points,
            row.box,
            row.hits,
            None if idle_s is None else round(idle_s, 3),
            round(row.load_ns * 1e-9, 6),
        )


class LiveMap(msgspec.Struct):
    """A live map."""

    name: str
    path: str
    resolution: Annotated[float, msgspec.Meta(description="edge of a voxel, metres")]
    frame_id: str
    chunks: Annotated[int, msgspec.Meta(description="in memory")]
    active: Annotated[int, msgspec.Meta(description="voxels known in them")]
    bytes: int
    loading: int
    dirty: Annotated[int, msgspec.Meta(description="changed and not saved")]
    saving: int
    waiting_bytes: Annotated[int, msgspec.Meta(description="of scans that wait")]
    files: int
    file_bytes: int
    scans: Annotated[int, msgspec.Meta(description="applied since the start")]
    durable: Annotated[int, msgspec.Meta(description="those of them on disk")]
    budget_bytes: int
    damaged: Annotated[list[str], msgspec.Meta(description="lost chunks, damaged databases")]
    mappers: Annotated[list[str], msgspec.Meta(description="uid/name")]
    problem: str
    change: Annotated[int, msgspec.Meta(description="number of the last change")]
    beside_bytes: Annotated[int, msgspec.Meta(description="of lists of voxels and marks")]
    readers: Annotated[
        list[tuple[int, int]],
        msgspec.Meta(description="the busiest: session, thousandths of a processor"),
    ]
    damaged_count: int
    mapper_count: int

    @classmethod
    def of(cls, row: rows.LiveMapRow) -> LiveMap:
        """Return the JSON form of a live map's row."""
        return msgspec.convert(row, cls, from_attributes=True)


def output_kinds(output: str) -> list[Any]:
    """Return the types of a verb's JSON output.

    Parameters
    ----------
    output
        Names, separated by blanks, of structs below `shmmap.cli.verbs` or of functions that return structs,
        such as ``"look.cells.Listed"``.
    """
    kinds = []
    for name in output.split():
        module, _, kind = name.rpartition(".")
        found = getattr(importlib.import_module(f"shmmap.cli.verbs.{module}"), kind)
        kinds.append(found() if inspect.isfunction(found) else found)
    return kinds


def json_schema(output: str) -> dict[str, Any]:
    """Return the schema of a verb's JSON output; ``output`` as in `output_kinds`."""
    schemas, definitions = msgspec.json.schema_components(output_kinds(output))
    (head, *others) = schemas
    whole = {"anyOf": [head, *others]} if others else head
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **whole, "$defs": definitions}


def more_of(kind: type, **others: type) -> type[msgspec.Struct]:
    """Return a new struct type with the fields of a dataclass, struct or named tuple, and further fields."""
    return msgspec.defstruct(kind.__name__, list({**get_type_hints(kind), **others}.items()))


def with_more(made: Any, **others: Any) -> msgspec.Struct:
    """Return a struct with all fields of ``made``, and further ones."""
    kind = more_of(type(made), **{name: type(value) for name, value in others.items()})
    return kind(**{name: getattr(made, name) for name in get_type_hints(type(made))}, **others)
