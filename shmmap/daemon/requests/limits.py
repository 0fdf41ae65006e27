# SPDX-License-Identifier: Apache-2.0
"""How much one request may ask for, and one session keep: nobody may take the loop or the memory for long."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import chain
from typing import Final

import msgspec

from shmmap.daemon.cache.cell_cache import CellCache
from shmmap.daemon.records import Key
from shmmap.daemon.transport.sessions import ROUTE_VERTICES, Session
from shmmap.errors import BadRequest, Busy
from shmmap.layers.spec import canonical_layers
from shmmap.protocol import messages

__all__ = ["MOST_CELLS", "admitted_layers", "bounded_intent", "check_count", "check_held", "check_queue"]

MOST_CELLS: Final = 20_000
"""Cells, in all layers together, of one request: about half a second of the loop when all are cold."""
MOST_QUEUED: Final = 20_000
"""A process of whose loads so many wait may add none; each takes 2 kB of the daemon's memory."""
MOST_HELD: Final = 100_000
MOST_LAYERS_HELD: Final = 64
"""Different layers named as held; reading what a layer is called takes some 40 us."""
MOST_LAYERS: Final = 16
"""Layers of one request."""
LAYER_TABLES_BYTES: Final = 256 << 20
"""Each layer in memory takes the daemon 8 bytes for every cell of the map; so much for all of them."""
LEAST_LAYERS_IN_MEMORY: Final = 64


def check_count(count: int) -> None:
    """Refuse a request for more than `MOST_CELLS` cells, or layers of cells.

    Raises
    ------
    BadRequest
        There are more.
    """
    if count > MOST_CELLS:
        raise BadRequest(
            f"{count} cells in one request; {MOST_CELLS} is the most",
            hint="ask for a smaller area, or for some ids at a time",
        )


def check_held(message: messages.Differential) -> None:
    """Refuse a client that says it holds more than `MOST_HELD` cells, or layers of cells named one by one.

    Raises
    ------
    BadRequest
        It says so, or names more than `MOST_LAYERS_HELD` different layers.
    """
    count = len(message.packed) // 8 + sum(
        1 if cell.layers is None else len(cell.layers) for cell in message.held
    )
    if count > MOST_HELD:
        raise BadRequest(f"{count} cells held; {MOST_HELD} is the most one request may name")
    layers = {layer for cell in message.held if cell.layers is not None for layer in cell.layers}
    if len(layers) > MOST_LAYERS_HELD:
        raise BadRequest(f"{len(layers)} layers held; {MOST_LAYERS_HELD} is the most one request may name")


def check_queue(cache: CellCache, session: Session, cold: Sequence[tuple[int, str]]) -> None:
    """Refuse to queue more loads for a process that waits for very many; ``cold`` is what they are of.

    Raises
    ------
    Busy
        It waits for `MOST_QUEUED` loads, and these are others.
    """
    if cache.ledger.queued_of(session.asker) < MOST_QUEUED:
        return
    slots, id_of = cache.ledger.slots, cache.catalogue.id
    for index, layer in cold:
        slot = slots.get(Key(id_of(index), layer))
        if slot is None or slot.load is None:
            raise Busy(f"{MOST_QUEUED} loads of this process wait already", hint="wait for some of them")


def admitted_layers(cache: CellCache, specs: Sequence[str]) -> tuple[str, ...]:
    """Return the layers a request names, in canonical form.

    Raises
    ------
    BadRequest
        One makes no sense, they are too many, or too many others are in memory.
    """
    if len(specs) > MOST_LAYERS:
        raise BadRequest(f"{len(specs)} layers in one request; {MOST_LAYERS} is the most")
    layers = canonical_layers(specs)
    new = [layer for layer in layers if layer not in cache.warm.layers]
    most = max(LEAST_LAYERS_IN_MEMORY, LAYER_TABLES_BYTES // (8 * max(1, len(cache.catalogue))))
    if new and len(cache.warm.layers) >= most:
        raise BadRequest(
            f"{len(cache.warm.layers)} different layers are in memory already, {most} is the most",
            hint="agree on parameters, or `shmmap evict` what nobody needs",
        )
    return layers


def bounded_intent(intent: messages.Intent) -> messages.Intent:
    """Return what the daemon remembers of an intent: of a route only its beginning.

    Raises
    ------
    BadRequest
        A number in it is not finite: it has no order by distance, and would mix up everybody's
        evictions and loads.
    """
    if len(intent.route) > ROUTE_VERTICES:
        intent = msgspec.structs.replace(intent, route=intent.route[:ROUTE_VERTICES])
    numbers = (intent.x, intent.y, intent.vx, intent.vy, intent.heading or 0.0, *chain(*intent.route))
    if not all(map(math.isfinite, numbers)):
        raise BadRequest("intent: every number in it must be finite")
    return intent
