# SPDX-License-Identifier: Apache-2.0
"""Set arithmetic of a differential request: the cells a client lacks, and those it should drop.

A version identifies a layer of a cell *and* its state, so a client that holds exactly the current versions
of an area lacks nothing.  Nearly every request of a moving vehicle is answered by `warm_difference`, which
is kept short.  `difference` covers all cases, in as many turns as it needs.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray

from shmmap.daemon.cache.cell_cache import CellCache
from shmmap.daemon.records import Resident
from shmmap.daemon.requests.pending_request import LARGE, PendingRequest
from shmmap.daemon.turns import BATCH, batched
from shmmap.layers.spec import canonical_layers
from shmmap.protocol.codec import check_packed, pack_versions, unpack_versions
from shmmap.protocol.messages import Differential, HeldCell


@dataclass(eq=False, slots=True)
class WarmDifference:
    """The difference for an area whose cells are all in memory."""

    residents: list[Resident]
    removed: tuple[str, ...]
    removed_packed: bytes


def warm_difference(
    cache: CellCache, message: Differential, found: NDArray[np.intp], layer: str
) -> WarmDifference | None:
    """Return the difference if the request names versions only and all cells of the area are warm, else None.

    ``found`` are the catalogue indices of the area's cells, ascending.  With very many held cells the answer
    would take more than a turn, so it is None, too.
    """
    if len(message.packed) > 8 * LARGE or len(message.held) > LARGE:
        return None
    index = cache.warm
    versions = index.versions(layer, found)
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
    warm = index.layers[layer]
    cells = zip(found.tolist(), versions, strict=True)
    lacks = [warm[cell] for cell, version in cells if version not in held]
    removed: tuple[str, ...] = ()
    removed_packed = b""
    gone = held - current
    if gone:
        # an old version of a cell inside the area is replaced, not removed; its other layers stay
        of_version, catalogue = index.of_version, cache.catalogue
        suspects = gone if len(index.layers) > 1 else gone & index.retired.keys()
        known = ((version, key) for version in suspects if (key := of_version.get(version)) is not None)
        of_cells = ((version, catalogue.find(key.cell_id)) for version, key in known)
        inside = ((version, warm.get(cell)) for version, cell in of_cells if cell is not None)
        gone.difference_update([v for v, now in inside if now is not None and now.version in current])
        if named:
            removed = _removed_names(cache, named, gone, current, layer)
        if message.packed:
            removed_packed = pack_versions(gone if not named else gone.intersection(packed))
    return WarmDifference(lacks, removed, removed_packed)


def _removed_names(
    cache: CellCache, named: Sequence[HeldCell], gone: set[int], current: set[int], layer: str
) -> tuple[str, ...]:
    """Return held ids to drop, in the order given; a cell that the area has at another version stays."""
    removed, warm = dict[str, None](), cache.warm
    for cell_id in [cell.id for cell in named if cell.version in gone]:
        index = cache.index_of(cell_id)
        resident = warm.get(index, layer) if index is not None else None
        if resident is None or resident.version not in current:
            removed[cell_id] = None
    return tuple(removed)


def difference(
    wanted: PendingRequest, message: Differential, indices: list[int], layers: tuple[str, ...]
) -> Generator[None, None, None]:
    """Find which of the area's cells ``indices`` the client lacks, whether they are in memory or not.

    If they are not all the cells of the area, a held cell that is not known may lie in it, and stays.

    Raises
    ------
    MapChanged, NoSession
        See `PendingRequest.pause`.
    """
    cache, found = wanted.cache, wanted.found
    versions, of_version = cache.layers, cache.warm.of_version
    version_of = versions.version
    current = np.zeros(len(indices) * len(layers), np.uint64)
    cells = [(index, layer) for index in indices for layer in layers]
    yield from wanted.pause(now=len(indices) > LARGE)
    for some in batched(indices):
        yield from wanted.pause()
        for unknown in versions.unknown(some, layers):
            yield from wanted.pause()
            version_of(*unknown)
    for first in range(0, len(cells), BATCH):
        yield from wanted.pause()
        current[first : first + BATCH] = [version_of(*cell) for cell in cells[first : first + BATCH]]
    inside = set(indices)
    has = yield from _held_layers(wanted, message.held, inside, layers)
    yield from wanted.pause(now=len(cells) > LARGE)
    order = np.argsort(current)
    ordered, is_held = current[order], np.zeros(len(cells), np.bool_)
    removed_packed = []
    for part in _parts(message.packed):
        yield from wanted.pause(now=len(part) > LARGE)
        at = np.searchsorted(ordered, part)
        known = at < len(ordered)
        known[known] = ordered[at[known]] == part[known]
        is_held[order[at[known]]] = True
        gone: list[int] = []
        for some_gone in batched(part[~known].tolist()):
            yield from wanted.pause()
            for version in some_gone:
                key = of_version.get(version)
                cell = cache.index_of(key.cell_id) if key is not None else None
                if key is not None and cell in inside:
                    found.held_old.add(key)
                elif cell is not None or found.covered:
                    gone.append(version)
        removed_packed.append(pack_versions(gone))
    found.removed_packed = b"".join(removed_packed)
    lacked = np.flatnonzero(~is_held).tolist()
    for places in batched(lacked):
        yield from wanted.pause()
        for place in places:
            index, layer = cells[place]
            if layer not in has.get(index, ()):
                found.cells.append((index, layer))


def _parts(packed: bytes) -> Iterator[NDArray[np.uint64]]:
    """Yield the distinct versions that a client holds, in parts that take a fraction of a millisecond each.

    Versions are hashes, so the parts by their first four bits are of about the same size.
    """
    check_packed(packed)
    versions = np.frombuffer(packed, "<u8")
    if len(versions) <= LARGE:
        yield np.unique(versions)
        return
    for first_bits in range(16):
        yield np.unique(versions[versions >> np.uint64(60) == first_bits])


def _held_layers(
    wanted: PendingRequest, held: Sequence[HeldCell], inside: set[int], layers: tuple[str, ...]
) -> Generator[None, None, dict[int, set[str]]]:
    """Return the layers that the client holds, by cell; note its outdated layers, and what it should drop."""
    cache, found = wanted.cache, wanted.found
    version_of = cache.layers.version
    has: dict[int, set[str]] = {}
    removed: dict[str, None] = {}
    for some in batched(held):
        yield from wanted.pause()
        for cell in some:
            index = cache.index_of(cell.id)
            if index is None or index not in inside:
                if found.covered or index is not None:
                    removed[cell.id] = None
                continue
            named = layers if cell.layers is None else canonical_layers(cell.layers)
            mine = [layer for layer in named if layer in layers]
            if cell.version is not None:  # the current version of one of these layers, or an outdated one
                current_of = [layer for layer in mine if cell.version == version_of(index, layer)]
                if not current_of:
                    found.held_old.update(cache.key(index, layer) for layer in mine)
                mine = current_of
            has.setdefault(index, set()).update(mine)
    found.removed = tuple(removed)
    return has
