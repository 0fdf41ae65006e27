# SPDX-License-Identifier: Apache-2.0
"""Records shared by all packages of the daemon: keys, resident and retired segments, loads, failures."""

from __future__ import annotations

import enum
from collections.abc import Hashable
from dataclasses import dataclass, field
from typing import Final, NamedTuple, TypeAlias

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


@dataclass(slots=True, eq=False)
class Resident:
    """A published segment, and the daemon's knowledge of its use.

    ``checked`` is false for a segment of a previous run until its bytes have been compared with their
    checksums; until then it is not handed out.  ``prefetched`` is true for a prefetched segment until a
    client asks for it, ``spare`` for one that was loaded into spare memory and only spare requests asked for.
    ``handle`` and ``stale_handle`` are encoded once for all replies.  ``sessions`` are
    the slots of the sessions that hold it.  ``place`` is its position among all segments of its size.
    ``deferred_s`` is how long it was deferred when it was last found in use.
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
    deferred_s: float = 0.0


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


class Purpose(enum.Enum):
    """Why a segment is loaded."""

    DEMAND = "a client has asked for it"
    SPARE = "only spare requests have asked for it"
    WISH = "no client has asked for it yet"


@dataclass(frozen=True, slots=True)
class LeftoverCheck:
    """Check of a previous run's segment; its cell is loaded if that fails and a client has asked for it."""

    resident: Resident
    is_asked_for: bool = False


@dataclass(frozen=True, slots=True)
class FailedFileCheck:
    """Check of a file that failed in the state ``stamp``: in another state its cell is loaded."""

    stamp: Stamp


Work: TypeAlias = Purpose | LeftoverCheck | FailedFileCheck
"""What a worker has to do for a key: make a segment, or a check that may lead to that."""


@dataclass(slots=True, eq=False)
class Attempt:
    """A worker's work at a load.

    ``sources`` are the states of its file and its neighbours' files in the catalogue when the worker was
    given the job, none for a check, and ``version`` is the version that follows from them.  ``took_s`` is the
    time that it took in the end, fetching included.
    """

    started_s: float
    sources: tuple[Stamp, ...] = ()
    version: int = 0
    took_s: float = 0.0


@dataclass(slots=True, eq=False)
class Load:
    """Work that is queued or that a worker does.

    ``reserved`` bytes are promised to it while it runs, which is while there is an ``attempt``.  ``computed``
    means that the layer is computed, which may take long.  ``link_bytes`` is what it fetches from a remote
    origin.  ``losses`` counts loaders that were lost through no fault of this load.
    """

    key: Key
    estimate: int
    priority: float
    number: int
    work: Work = Purpose.DEMAND
    asker: Hashable = None
    computed: bool = False
    attempt: Attempt | None = None
    reserved: int = 0
    link_bytes: int = 0
    losses: int = 0

    @property
    def is_running(self) -> bool:
        """Whether a worker has it."""
        return self.attempt is not None

    @property
    def is_ahead(self) -> bool:
        """Whether no client needs its segment now."""
        return self.work is Purpose.WISH or self.work is Purpose.SPARE


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
