# SPDX-License-Identifier: Apache-2.0
"""Set arithmetic of a differential request: the cells a client lacks, and those it should drop.

A version identifies a layer of a cell *and* its state, so a client that holds exactly the current versions
of an area lacks nothing.  Nearly every request of a moving vehicle is answered by `warm_difference`, which
is kept short.  `difference` covers all cases, with arrays: a client may hold many thousands of cells.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final, cast

import numpy as np
from numpy.typing import NDArray

from shmmap.daemon.cache.cell_cache import CellCache
from shmmap.daemon.records import Key, Resident
from shmmap.layers.spec import canonical_layers
from shmmap.protocol.codec import check_packed, pack_versions, unpack_versions
from shmmap.protocol.messages import Differential, HeldCell

MAX_WARM_HELD: Final = 1024
"""Versions held that `warm_difference` compares; with more, arrays are faster than sets."""


@dataclass(eq=False, slots=True)
class WarmDifference:
    """The difference for an area whose cells are all in memory."""

    residents: list[Resident]
    removed: tuple[str, ...]
    removed_packed: bytes


def holds_few(message: Differential) -> bool:
    """Whether so little is held that `warm_difference` is the faster one."""
    return len(message.packed) <= 8 * MAX_WARM_HELD and len(message.held) <= MAX_WARM_HELD


def warm_difference(
    cache: CellCache, message: Differential, found: NDArray[np.intp], layer: str
) -> WarmDifference | None:
    """Return the difference if the request names versions only and all cells of the area are warm, else None.

    ``found`` are the catalogue indices of the area's cells, ascending.
    """
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


@dataclass(eq=False, slots=True)
class Difference:
    """The difference for some of an area's cells; what it does not name, the client holds.

    Attributes
    ----------
    cells
        Catalogue indices and layers that the client lacks, in the area's order.
    looked_at
        Number of cells that were compared: the area's first ones from where the request begins.
    removed, removed_packed
        What the client should drop, as the reply encodes it.
    held
        Versions that the client holds, ascending.
    held_old
        Layers of cells that the client holds in an outdated version, as far as they are known.
    """

    cells: list[tuple[int, str]]
    looked_at: int
    held: NDArray[np.uint64]
    removed: tuple[str, ...] = ()
    removed_packed: bytes = b""
    held_old: set[Key] = field(default_factory=set)


def difference(
    cache: CellCache,
    message: Differential,
    area: NDArray[np.intp],
    layers: Sequence[str],
    *,
    start: int = 0,
    most: int = 1 << 62,
    covered: bool = True,
) -> Difference:
    """Find which cells of an area the client lacks, whether they are in memory or not.

    What it should drop is found with the last cell of the area.

    Parameters
    ----------
    area
        Catalogue indices of the area's cells.
    start
        Place in ``area`` to begin at.
    most
        Number of layers of cells after which the search ends, with the cell's other layers.
    covered
        Whether ``area`` has all cells of the area.  If not, a held cell that is not known may lie in it, and
        stays.
    """
    check_packed(message.packed)
    held = np.sort(np.frombuffer(message.packed, "<u8"))
    is_first = np.ones(len(held), np.bool_)
    is_first[1:] = held[1:] != held[:-1]
    held = held[is_first]  # a tenth of the time of np.unique
    enough = most + len(held) + len(message.held)  # cells of which ``most`` are lacked
    current, looked_at, complete = cache.layers.of_cells(area[start : start + enough], layers)
    has, others = _compared(current[:looked_at], held)
    found = Difference([], looked_at, held)
    if message.held:
        places = {index: place - start for place, index in enumerate(area.tolist())}
        _mark_named(cache, message.held, places, layers, covered, current[:looked_at], has, found)
    lacked = np.flatnonzero(~has)
    if len(lacked) > most:
        found.looked_at = int(lacked[most - 1]) // len(layers) + 1
        lacked = lacked[lacked < found.looked_at * len(layers)]
    rows, columns = np.divmod(lacked, len(layers))
    of_layers = [layers[column] for column in columns.tolist()]
    found.cells = list(zip(area[start + rows].tolist(), of_layers, strict=True))
    if len(held) and start + found.looked_at == len(area):
        if start:
            current, _, complete = cache.layers.of_cells(area, layers)
            _, others = _compared(current, held)
        _mark_gone(cache, area, others.tolist(), covered and complete, found)
    return found


def _mark_named(
    cache: CellCache,
    held: Sequence[HeldCell],
    places: dict[int, int],
    layers: Sequence[str],
    covered: bool,
    current: NDArray[np.uint64],
    has: NDArray[np.bool_],
    found: Difference,
) -> None:
    """Mark the layers that the client names as held; note its outdated layers, and what it should drop."""
    columns, versions = {layer: column for column, layer in enumerate(layers)}, current.tolist()
    removed: dict[str, None] = {}
    marked: list[tuple[int, int]] = []
    for cell in held:
        index = cache.index_of(cell.id)
        place = places.get(index) if index is not None else None
        if place is None:
            if covered or index is not None:
                removed[cell.id] = None
            continue
        if not 0 <= place < len(versions):
            continue
        named = layers if cell.layers is None else canonical_layers(cell.layers)
        mine = [columns[layer] for layer in named if layer in columns]
        if cell.version is not None:  # the current version of one of these layers, or an outdated one
            current_of = [column for column in mine if cell.version == versions[place][column]]
            if not current_of and index is not None:
                found.held_old.update(cache.key(index, layers[column]) for column in mine)
            mine = current_of
        marked += [(place, column) for column in mine]
    if marked:
        has[tuple(np.array(marked).T)] = True
    found.removed = tuple(removed)


def _mark_gone(
    cache: CellCache, area: NDArray[np.intp], others: Sequence[int], complete: bool, found: Difference
) -> None:
    """Note of held versions that are not current in the area: outdated ones of its cells, and those to drop.

    ``complete`` is whether all cells of the area and their versions are known.
    """
    catalogue, of_version = cache.catalogue, cache.warm.of_version
    inside = set(map(catalogue.id, area.tolist())) if others else ()
    known = {version: of_version[version] for version in of_version.among(others)}
    replaced = {version for version, key in known.items() if key.cell_id in inside}
    found.held_old.update(known[version] for version in replaced)
    if complete:
        gone = set(others) - replaced
    else:  # what is not known may be current somewhere in the area
        elsewhere = known.keys() - replaced
        gone = {version for version in elsewhere if catalogue.find(known[version].cell_id) is not None}
    found.removed_packed = pack_versions(gone)


def _compared(
    current: NDArray[np.uint64], held: NDArray[np.uint64]
) -> tuple[NDArray[np.bool_], NDArray[np.uint64]]:
    """Return which current versions are held, and the held ones, ascending, that are not among them."""
    if not len(held):
        return np.zeros(current.shape, np.bool_), held
    places = np.searchsorted(held, current) % len(held)
    has: NDArray[np.bool_] = held[places] == current
    others = np.ones(len(held), np.bool_)
    others[places[has]] = False
    return has, held[others]
