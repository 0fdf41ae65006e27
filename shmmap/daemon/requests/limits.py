# SPDX-License-Identifier: Apache-2.0
"""How much one request may ask for, and how much one session keep for itself alone."""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Final

import numpy as np

from shmmap.daemon.cache.cell_cache import CellCache
from shmmap.daemon.cache.reclaimer import HAND_OUT_GRACE_S
from shmmap.daemon.loading.loads import Loads
from shmmap.daemon.records import Key, Resident
from shmmap.daemon.requests.pending_request import PendingRequest, parts
from shmmap.daemon.transport.sessions import Session
from shmmap.errors import BadRequest, Busy
from shmmap.layers.spec import canonical_layer, canonical_layers
from shmmap.protocol import messages
from shmmap.quantities import format_bytes

__all__ = [
    "MOST_CELLS",
    "SessionQuota",
    "admitted_layers",
    "check_count",
    "check_held",
    "check_intent",
    "check_queue",
    "layers_named",
]

MOST_CELLS: Final = 20_000
"""Cells, in all layers together, of one request."""
MOST_QUEUED: Final = 20_000
"""A process of whose loads so many wait may add none; each takes 2 kB of the daemon's memory."""
MOST_HELD: Final = 100_000
MOST_LAYERS_HELD: Final = 64
"""Different layers named as held; reading what a layer is called takes some 40 us."""
MOST_LAYERS: Final = 16
"""Layers of one request."""


def check_count(count: int) -> None:
    """Refuse a request for more than `MOST_CELLS` cells, or layers of cells.

    Raises
    ------
    BadRequest
        There are more.
    """
    if count > MOST_CELLS:
        raise BadRequest(
            f"more than {MOST_CELLS} cells in one request",
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


def check_queue(
    cache: CellCache, loads: Loads, wanted: PendingRequest, cold: Sequence[tuple[int, str]]
) -> Iterator[None]:
    """Refuse to queue more loads for a process that waits for very many; ``cold`` is what they are of.

    Raises
    ------
    Busy
        It waits for `MOST_QUEUED` loads, and these are others.
    MapChanged, NoSession
        See `PendingRequest.pause`.
    """
    if loads.queued_of(wanted.session.asker) < MOST_QUEUED:
        return
    for number, part in enumerate(parts(cold)):
        if number:
            yield from wanted.pause(cache)
        for index, layer in part:
            if Key(cache.catalogue.id(index), layer) not in loads.by_key:
                raise Busy(f"{MOST_QUEUED} loads of this process wait already", hint="wait for some of them")


def admitted_layers(cache: CellCache, specs: Sequence[str]) -> tuple[str, ...]:
    """Return the layers a request names, in canonical form.

    Raises
    ------
    BadRequest
        One makes no sense, they are too many, or one looks too far.
    """
    if len(specs) > MOST_LAYERS:
        raise BadRequest(f"{len(specs)} layers in one request; {MOST_LAYERS} is the most")
    layers = canonical_layers(specs)
    for layer in layers:
        cache.layers.check_reach(layer)
    return layers


def layers_named(message: messages.Area | messages.Differential | messages.Selected) -> tuple[str, ...]:
    """The layers that an admitted request names, one for each, in canonical form."""
    return tuple(map(canonical_layer, message.layers))


def check_intent(intent: messages.Intent) -> None:
    """Refuse an intent that has no order by distance: it would mix up everybody's evictions and loads.

    Raises
    ------
    BadRequest
        A number in it is not finite.
    """
    numbers = (intent.x, intent.y, intent.vx, intent.vy, intent.heading or 0.0, *chain(*intent.route))
    if not all(map(math.isfinite, numbers)):
        raise BadRequest("intent: every number in it must be finite")


@dataclass(eq=False, slots=True)
class SessionQuota:
    """Refuses what would exceed it, cell by cell.

    Parameters
    ----------
    nbytes
        Most bytes one session may keep that no other session also holds.
    clock
        The serving loop's clock, seconds.
    """

    nbytes: int
    cache: CellCache
    clock: Callable[[], float]

    def has_room(self, session: Session, residents: Sequence[Resident]) -> bool:
        """Whether the session may surely have these, too."""
        return session.held_bytes + sum(resident.nbytes for resident in residents) <= self.nbytes

    def check(self, wanted: PendingRequest, sizes: Sequence[int]) -> Iterator[None]:
        """Note in ``wanted.refused`` what is too much, farthest cells first.

        Parameters
        ----------
        sizes
            Bytes of each cell that is wanted.

        Raises
        ------
        MapChanged, NoSession
            See `PendingRequest.pause`.
        """
        session, cache = wanted.session, self.cache
        if session.held_bytes + sum(sizes) <= self.nbytes:
            return
        too_much, added, keys = yield from self._excess(wanted, sizes)
        if too_much:  # unless it has let go of something
            before_s = self.clock() - HAND_OUT_GRACE_S
            enough = lambda: session.exclusive_bytes + added <= self.nbytes  # noqa: E731
            for _ in cache.survey.look_at(session, before_s, enough, keys):
                yield from wanted.pause(cache)
            too_much, _, _ = yield from self._excess(wanted, sizes)
        message = (
            f"this client would keep more than its quota of {format_bytes(self.nbytes)} for itself alone"
        )
        for number, part in enumerate(parts(too_much)):
            if number:
                yield from wanted.pause(cache)
            for key in part:
                wanted.refused[key] = ("over_budget", message)
                cache.statistics.add("refused_quota")
                cache.events.pressure.refused(cache.wire_id(key.cell_id), key.layer, "quota", self.clock())

    def _excess(
        self, wanted: PendingRequest, sizes: Sequence[int]
    ) -> Generator[None, None, tuple[list[Key], int, set[Key]]]:
        """What is too much, how many bytes all would add to what nobody else holds, and what all is."""
        session, cache = wanted.session, self.cache
        boxes = cache.catalogue.boxes_of(np.array([index for index, _ in wanted.cells], dtype=np.intp))
        counted: set[Key] = set()
        too_much: list[Key] = []
        added = 0
        nearest = np.argsort(wanted.distances_m(boxes), kind="stable").tolist()
        for number, part in enumerate(parts(nearest)):
            if number:
                yield from wanted.pause(cache)
            for position in part:
                index, layer = wanted.cells[position]
                key = Key(cache.catalogue.id(index), layer)
                if key in counted:
                    continue
                counted.add(key)
                resident = cache.warm.get(index, layer)
                if resident is not None and resident.sessions:
                    continue  # somebody keeps it anyway, perhaps this session itself
                added += sizes[position] - self._replaced_bytes(session, key)
                if session.exclusive_bytes + added > self.nbytes:
                    too_much.append(key)
        return too_much, added, counted

    def _replaced_bytes(self, session: Session, key: Key) -> int:
        """Bytes of an old version: its holder is about to drop it for the new one."""
        for known in (self.cache.ledger.by_key.get(key), self.cache.reclaimer.retired_of(key)):
            if known is not None and session.slot in known.sessions and not self.cache.is_current(known):
                return known.nbytes
        return 0
