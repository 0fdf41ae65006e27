# SPDX-License-Identifier: Apache-2.0
"""What a client lacks, and what it should drop: the set arithmetic of a differential request.

Versions do the work: one names a layer of a cell *and* its state, so that a client that holds exactly the
current versions of an area lacks nothing.  `warm_difference` is the way of nearly every request of
a moving vehicle and is kept short; `difference` covers everything, a part a turn.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Final, cast

import numpy as np
from numpy.typing import NDArray

from shmmap.daemon.cache.cell_cache import CellCache
from shmmap.daemon.records import Key, Resident
from shmmap.daemon.requests.pending_request import PendingRequest, parts
from shmmap.layers.spec import canonical_layers
from shmmap.protocol.codec import pack_versions, unpack_versions
from shmmap.protocol.messages import Differential, HeldCell

__all__ = ["Difference", "WarmDifference", "difference", "lacking", "warm_difference"]

UNKNOWN_A_STEP: Final = 16
"""Versions of layers with a halo that are found in one turn: half a millisecond."""


@dataclass(eq=False, slots=True)
class WarmDifference:
    """The difference where all of the area is in memory."""

    residents: list[Resident]
    removed: tuple[str, ...]
    removed_packed: bytes


def warm_difference(
    cache: CellCache, message: Differential, found: NDArray[np.intp], layer: str
) -> WarmDifference | None:
    """Return the difference if it takes versions only and every cell of the area is warm, else None.

    ``found`` are the catalogue indices of the area's cells, ascending.
    """
    versions = cache.warm.versions(layer, found)
    if versions is None:
        return None
    packed = unpack_versions(message.packed)
    named = message.held
    current, held = set(versions), set(packed)
    if named:
        given = [cell.version for cell in named]
        if None in given or [cell for cell in named if cell.layers is not None]:
            return None
        held.update(cast("list[int]", given))
    if 0 in current:
        return None  # 0 stands for "not in memory"
    warm = cache.warm.layers[layer]
    cells = zip(found.tolist(), versions, strict=True)
    lacks = [warm[cell] for cell, version in cells if version not in held]
    removed: tuple[str, ...] = ()
    removed_packed = b""
    gone = held - current
    if gone:
        # an old version of a cell inside the area is replaced, not removed; another layer of one stays
        of_version, index_of = cache.warm.of_version, cache.catalogue.find
        suspects = gone if len(cache.warm.layers) > 1 else gone & cache.warm.retired.keys()
        known = ((version, key) for version in suspects if (key := of_version.get(version)) is not None)
        of_cells = ((version, index_of(key.cell_id)) for version, key in known)
        inside = ((version, warm.get(index)) for version, index in of_cells if index is not None)
        gone.difference_update([v for v, now in inside if now is not None and now.version in current])
        if named:
            removed = _removed_names(cache, named, gone, current, layer)
        if message.packed:
            removed_packed = pack_versions(gone if not named else gone.intersection(packed))
    return WarmDifference(lacks, removed, removed_packed)


def _removed_names(
    cache: CellCache, named: Sequence[HeldCell], gone: set[int], current: set[int], layer: str
) -> tuple[str, ...]:
    """Held ids to drop, in the order given; one whose cell is in the area at another version stays."""
    removed: dict[str, None] = {}
    for cell_id in [cell.id for cell in named if cell.version in gone]:
        index = cache.index_of(cell_id)
        resident = cache.warm.get(index, layer) if index is not None else None
        if resident is None or resident.version not in current:
            removed[cell_id] = None
    return tuple(removed)


@dataclass(eq=False, slots=True)
class Difference:
    """The difference of any request.

    Attributes
    ----------
    cells
        Catalogue index and layer of everything to send, in reply order.
    removed, removed_packed
        What to drop, as the reply says it.
    old
        Layers of cells in the area that the client holds in an older version.
    """

    cells: list[tuple[int, str]] = field(default_factory=list)
    removed: tuple[str, ...] = ()
    removed_packed: bytes = b""
    old: set[Key] = field(default_factory=set)


def difference(
    cache: CellCache,
    message: Differential,
    indices: Sequence[int],
    layers: tuple[str, ...],
    covered: bool,
    pause: Callable[[], Iterator[None]],
) -> Generator[None, None, Difference]:
    """Find what the client lacks of the area's cells ``indices``, whether in memory or not.

    Parameters
    ----------
    covered
        Whether these are all; else a cell that is not known may lie in the area.
    pause
        Lets others have a turn: called before each part but the first.
    """
    version_of, id_of = cache.layers.version, cache.catalogue.id
    for number, unknown in enumerate(cache.layers.unknown(indices, layers)):
        if number and number % UNKNOWN_A_STEP == 0:
            yield from pause()
        version_of(*unknown)
    packed = set(unpack_versions(message.packed))
    inside = set(indices)
    result = Difference()
    has: dict[int, set[str]] = {}
    removed: dict[str, None] = {}
    for number, some in enumerate(parts(message.held)):
        if number:
            yield from pause()
        for cell in some:
            index = cache.index_of(cell.id)
            if index is None or index not in inside:
                if covered or index is not None:
                    removed[cell.id] = None
                continue
            named = layers if cell.layers is None else canonical_layers(cell.layers)
            mine = [layer for layer in named if layer in layers]
            if cell.version is not None:  # that of one of them; else it is an old one
                current_of = [layer for layer in mine if cell.version == version_of(index, layer)]
                if not current_of:
                    result.old.update(Key(id_of(index), layer) for layer in mine)
                mine = current_of
            has.setdefault(index, set()).update(mine)
    current: set[int] = set()
    for number, inner in enumerate(parts(indices)):
        if number:
            yield from pause()
        for index in inner:
            for layer in layers:
                version = version_of(index, layer)
                current.add(version)
                if version not in packed and layer not in has.get(index, ()):
                    result.cells.append((index, layer))
    gone = packed - current
    for number, outdated in enumerate(parts([*gone])):
        if number:
            yield from pause()
        for version in outdated:
            key = cache.warm.of_version.get(version)
            index = cache.index_of(key.cell_id) if key is not None else None
            if key is not None and index in inside:
                gone.discard(version)
                result.old.add(key)
            elif index is None and not covered:
                gone.discard(version)
    result.removed = tuple(removed)
    result.removed_packed = pack_versions(gone)
    return result


def lacking(
    cache: CellCache, message: Differential, found: NDArray[np.intp], layers: tuple[str, ...],
    wanted: PendingRequest,
) -> Generator[None, None, None]:  # fmt: skip
    """Note in ``wanted`` what a client lacks of an area whose known cells are ``found``, a part a turn.

    Raises
    ------
    MapChanged, NoSession
        See `PendingRequest.pause`.
    """
    z = wanted.area.z if wanted.area is not None else None
    indices = cache.at_height(found.tolist(), z)
    lacks = yield from difference(
        cache, message, indices, layers, wanted.covered, partial(wanted.pause, cache)
    )
    wanted.cells, wanted.held_old = lacks.cells, lacks.old
    wanted.removed, wanted.removed_packed = lacks.removed, lacks.removed_packed
