# SPDX-License-Identifier: Apache-2.0
"""Records shared by all packages of the daemon: keys, resident and retired segments, failures."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final, NamedTuple

from shmmap.segment.directory import is_full
from shmmap.segment.version import Stamp

SPACE_CODES: Final = frozenset({"over_budget", "no_space"})
"""Failures for lack of memory: they may be retried when memory is released."""


def failure_code(error: OSError) -> str:
    """Return the failure code of a load whose segment's file could not be created."""
    return "no_space" if is_full(error) else "load_failed"


class Key(NamedTuple):
    """One layer of one cell."""

    cell_id: str
    layer: str


class Absent(NamedTuple):
    """A layer of a cell that may have to be loaded: the cell's index, and the bytes to reserve for that."""

    cell: int
    key: Key
    nbytes: int


@dataclass(slots=True, eq=False)
class Resident:
    """A published segment, and the daemon's knowledge of its use.

    ``checked`` is false for a segment of a previous run until its bytes have been compared with their
    checksums; until then it is not handed out.  ``prefetched`` is true for a prefetched segment until a
    client asks for it, ``spare`` for one that was loaded into spare memory and only spare requests asked for.
    ``handle`` and ``stale_handle`` are encoded once for all replies.  ``sessions`` are
    the slots of the sessions that hold it.  ``place`` is its position among all segments of its size,
    ``square`` that of the map in which its middle lies.
    """

    name: str
    key: Key
    version: int
    nbytes: int
    points: int
    box: tuple[float, float, float, float]
    z_min: float
    z_max: float
    handle: bytes = b""
    stale_handle: bytes = b""
    last_use_s: float = 0.0
    load_ns: int = 0
    hits: int = 0
    checked: bool = True
    prefetched: bool = False
    spare: bool = False
    sessions: set[int] = field(default_factory=set)
    place: int = -1
    square: tuple[float, float] = (0.0, 0.0)


@dataclass(slots=True, eq=False)
class Retired:
    """A segment out of service; ``resident`` describes it.

    ``probe_after_s`` is the time of its next check, ``unopened`` whether no process had it open at the last
    check, and ``interval_s`` the last interval between two checks.  Before ``tick_over_s`` a process may be
    opening it.
    """

    resident: Resident
    unopened: bool = False
    probe_after_s: float = 0.0
    interval_s: float = 0.0
    tick_over_s: float = 0.0


@dataclass(slots=True)
class Failure:
    """Why the last load of a key failed, and when the load may be retried.

    ``stamp`` is the state of the file that failed: another state is loaded at once.  It is None if it is not
    known or must not be looked up (the file system may be what hangs).
    """

    code: str
    message: str
    stamp: Stamp | None
    retry_at_s: float
    delay_s: float
