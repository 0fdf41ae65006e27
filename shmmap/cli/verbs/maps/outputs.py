# SPDX-License-Identifier: Apache-2.0
"""JSON output of the verbs that make and publish maps; imported only for ``--json``."""

from __future__ import annotations

from typing import Annotated

import msgspec

from shmmap.cli.json_output import Failure, Hex, more_of


def divided_kind() -> object:
    """Return the struct that ``divide --json`` prints."""
    from shmmap.origin.map_report import DividedMap

    return more_of(DividedMap, seconds=float, peak_memory_bytes=int)


def merged_kind() -> object:
    """Return the struct that ``merge --json`` prints."""
    from shmmap.dividing.merge import MergedCloud

    return more_of(MergedCloud, seconds=float, peak_memory_bytes=int)


class Fetched(msgspec.Struct):
    """A fetched version: totals of the written map, and the part that was downloaded."""

    url: str
    path: str
    version: int
    map_version: Hex
    cells: int
    points: int
    fetched_cells: int
    fetched_bytes: int
    seconds: float


class PublishedMap(msgspec.Struct):
    """The version current after publishing, and the amount of data sent for it."""

    map: str
    url: str
    changed: bool
    version: int
    map_version: Hex
    root: Annotated[str, msgspec.Meta(description="hash of its object")]
    cells: int
    layers: list[str]
    id_prefix: str
    encoding: str
    objects: Annotated[int, msgspec.Meta(description="layers of cells")]
    bytes: int
    sent_objects: int
    sent_bytes: int
    seconds: float
    failed: list[Failure]
    notes: Annotated[list[str], msgspec.Meta(description="oddities of the map")]


class Joined(msgspec.Struct):
    """The version current after joining slices with --join."""

    url: str
    run: str
    slices: int
    changed: bool
    version: int
    map_version: Hex
    root: str
    cells: int
    layers: list[str]
    objects: Annotated[int, msgspec.Meta(description="that were checked")]
    seconds: float


class Prepared(msgspec.Struct):
    """The stored layers of a map."""

    map: str
    cells: int
    layers: list[str]
    kept: int
    recognised: Annotated[int, msgspec.Meta(description="by contents")]
    built: Annotated[int, msgspec.Meta(description="layers of cells")]
    bytes: int
    cache_dir: str
    cache_bytes: Annotated[int, msgspec.Meta(description="disk space of the whole cache")]
    seconds: float
    failed: list[Failure]


class Slice(msgspec.Struct):
    """A slice of layers made with --shards."""

    url: str
    version: Annotated[int, msgspec.Meta(description="the current one")]
    run: str
    slice: int
    slices: int
    shards: int
    cells: Annotated[int, msgspec.Meta(description="of the slice")]
    layers: list[str]
    there: Annotated[bool, msgspec.Meta(description="it had been made before")]
    kept: Annotated[int, msgspec.Meta(description="layers of cells that the version has")]
    made: int
    bytes: Annotated[int, msgspec.Meta(description="of their objects")]
    sent_objects: int
    sent_bytes: int
    seconds: float
    failed: list[Failure]


class Version(msgspec.Struct):
    """One version of a published map."""

    version: int
    state: Annotated[str, msgspec.Meta(description="current, earlier, or never served")]
    created: Annotated[str, msgspec.Meta(description="RFC 3339, or empty")]
    root: Annotated[str, msgspec.Meta(description="hash")]
    bytes: Annotated[int, msgspec.Meta(description="of the root")]
    before: int
    restored: Annotated[int, msgspec.Meta(description="the version whose content it has again, or 0")]


class Versions(msgspec.Struct):
    """All versions of a published map, the latest first."""

    url: str
    current: int
    valid_until: Annotated[float | None, msgspec.Meta(description="Unix time; null without --trust")]
    versions: list[Version]


class RolledBack(msgspec.Struct):
    """The result of --rollback."""

    url: str
    changed: bool
    version: Annotated[int, msgspec.Meta(description="the current one")]
    restored: int
    objects: Annotated[int, msgspec.Meta(description="that were looked for")]


class Refreshed(msgspec.Struct):
    """The result of --refresh."""

    url: str
    version: int
    valid_until: Annotated[dict[str, str], msgspec.Meta(description="RFC 3339, by role")]


def rotated_kind() -> object:
    """Return the struct that ``versions --rotate`` prints."""
    from shmmap.publishing.signing import Rotated

    return more_of(Rotated, url=str)


def pruned_kind() -> object:
    """Return the struct that ``versions --prune`` prints."""
    from shmmap.publishing.prune import Pruned

    return more_of(Pruned, url=str)
