# SPDX-License-Identifier: Apache-2.0
"""Limits on the size of one request, and on the memory that only one session holds."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import chain
from typing import Final, TypeAlias

import numpy as np

from shmmap.daemon.cache.cell_cache import CellCache
from shmmap.daemon.cache.eviction_plan import HAND_OUT_GRACE_S
from shmmap.daemon.loading.loads import Loads
from shmmap.daemon.records import Key, Resident
from shmmap.daemon.transport.sessions import Session
from shmmap.errors import BadRequest, Busy
from shmmap.layers.spec import canonical_layer, canonical_layers
from shmmap.protocol import messages
from shmmap.quantities import format_bytes

MAX_CELLS: Final = 20_000
"""Cells of one area, over all its layers."""
MAX_QUEUED: Final = 20_000
"""A process with this many queued loads may add none; each takes 2 kB of the daemon's memory."""
MAX_HELD: Final = 20_000
MAX_LAYERS_HELD: Final = 64
"""Distinct layers among the cells that a client says it holds; parsing a layer's name takes some 40 us."""
MAX_LAYERS: Final = 16
"""Layers of one request."""

Distances: TypeAlias = Callable[[Sequence[tuple[int, str]]], Sequence[float]]


def check_count(count: int) -> None:
    """Refuse a request for more than `MAX_CELLS` cells, counting each layer of a cell.

    Raises
    ------
    BadRequest
        The request has more.
    """
    if count > MAX_CELLS:
        raise BadRequest(
            f"more than {MAX_CELLS} cells in one request",
            hint="ask for a smaller area, or for some ids at a time",
        )


def check_selected(message: messages.Selected, layers: Sequence[str]) -> None:
    """Refuse a request for more than `MAX_SELECTED` cells by id, counting each layer of a cell.

    Raises
    ------
    BadRequest
        The request names more.
    """
    if len(message.ids) * len(layers) > messages.MAX_SELECTED:
        raise BadRequest(
            f"more than {messages.MAX_SELECTED} cells selected in one request",
            hint="ask for some ids at a time",
        )


def check_held(message: messages.Differential) -> None:
    """Refuse a client that reports more than `MAX_HELD` held cells, counting each layer named one by one.

    Raises
    ------
    BadRequest
        The client reports more, or names more than `MAX_LAYERS_HELD` distinct layers.
    """
    count = len(message.packed) // 8 + sum(
        1 if cell.layers is None else len(cell.layers) for cell in message.held
    )
    if count > MAX_HELD:
        raise BadRequest(f"{count} cells held; {MAX_HELD} is the most one request may name")
    layers = {layer for cell in message.held if cell.layers is not None for layer in cell.layers}
    if len(layers) > MAX_LAYERS_HELD:
        raise BadRequest(f"{len(layers)} layers held; {MAX_LAYERS_HELD} is the most one request may name")


def check_queue(loads: Loads, asker: Hashable, cold: Iterable[Key]) -> None:
    """Refuse to queue loads of the ``cold`` cells for a process that already waits for too many.

    Raises
    ------
    Busy
        The process waits for `MAX_QUEUED` loads, and not all the cold cells are among them.
    """
    if loads.queue.count(asker) >= MAX_QUEUED and not all(key in loads.by_key for key in cold):
        raise Busy(f"{MAX_QUEUED} loads of this process wait already", hint="wait for some of them")


@lru_cache(maxsize=128)  # requests have few specs, and repeat them
def layers_of(specs: tuple[str, ...]) -> tuple[str, ...]:
    """Return the layers that a request names, in canonical form and without duplicates.

    Raises
    ------
    BadRequest
        A layer's name is invalid, or there are too many layers.
    """
    if len(specs) > MAX_LAYERS:
        raise BadRequest(f"{len(specs)} layers in one request; {MAX_LAYERS} is the most")
    return canonical_layers(specs)


@lru_cache(maxsize=128)
def layers_named(specs: tuple[str, ...]) -> tuple[str, ...]:
    """Return the layers that an admitted request names, one per spec, in canonical form."""
    return tuple(map(canonical_layer, specs))


def check_intent(intent: messages.Intent) -> None:
    """Refuse an intent with a number that is not finite: it would corrupt the order of evictions and loads.

    Raises
    ------
    BadRequest
        A number in the intent is not finite.
    """
    numbers = (intent.x, intent.y, intent.vx, intent.vy, intent.heading or 0.0, *chain(*intent.route))
    if not all(map(math.isfinite, numbers)):
        raise BadRequest("intent: every number in it must be finite")


@dataclass(eq=False, slots=True)
class SessionQuota:
    """Quota of a session: refuses the cells that would exceed it, one by one.

    Parameters
    ----------
    nbytes
        Limit of the bytes that one session alone holds.
    clock
        The serving loop's clock, seconds.
    """

    nbytes: int
    cache: CellCache
    clock: Callable[[], float]

    @property
    def message(self) -> str:
        """Message that a refused cell carries."""
        return f"this client would keep more than its quota of {format_bytes(self.nbytes)} for itself alone"

    def has_room(self, session: Session, residents: Sequence[Resident]) -> bool:
        """Whether these segments certainly fit in the session's quota."""
        return session.held_bytes + sum(resident.nbytes for resident in residents) <= self.nbytes

    def refused(
        self, session: Session, cells: Sequence[tuple[int, str]], sizes: Sequence[int], distances: Distances
    ) -> set[Key]:
        """Return the cells that exceed the quota, farthest cells first.

        Parameters
        ----------
        sizes
            Bytes of each requested cell.
        distances
            Returns their distances from the client.
        """
        if session.held_bytes + sum(sizes) <= self.nbytes:
            return set()
        nearest = np.argsort(distances(cells), kind="stable").tolist()
        keys = {self.cache.key(*cell) for cell in cells}
        refused, added = self._excess(session, cells, sizes, nearest)
        if refused:  # look whether the session has released something
            self.cache.survey.look_at(
                session,
                self.clock() - HAND_OUT_GRACE_S,
                lambda: session.exclusive_bytes + added <= self.nbytes,
                keys,
            )
            refused, _ = self._excess(session, cells, sizes, nearest)
        return refused

    def _excess(
        self,
        session: Session,
        cells: Sequence[tuple[int, str]],
        sizes: Sequence[int],
        nearest: Sequence[int],
    ) -> tuple[set[Key], int]:
        """Return the keys over quota, and the bytes that all keys add to the session's exclusive memory."""
        counted: set[Key] = set()
        refused: set[Key] = set()
        added = 0
        for position in nearest:
            index, layer = cells[position]
            key = self.cache.key(index, layer)
            if key in counted:
                continue
            counted.add(key)
            resident = self.cache.warm.get(index, layer)
            if resident is not None and resident.sessions:
                continue  # a session holds it already, perhaps this one
            added += sizes[position] - self.cache.replaced_bytes(session, key)
            if session.exclusive_bytes + added > self.nbytes:
                refused.add(key)
        return refused, added
