# SPDX-License-Identifier: Apache-2.0
"""Records that all packages of the daemon share: keys, segments in memory and retired, loads, failures."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass, field
from typing import Final, NamedTuple

from shmmap.segment.directory import is_full
from shmmap.segment.version import Stamp

__all__ = ["SPACE_CODES", "Failure", "Key", "Load", "Resident", "Retired", "failure_code"]

SPACE_CODES: Final = frozenset({"over_budget", "no_space"})
"""Failures for lack of memory: they pass when memory is released."""


def failure_code(error: OSError) -> str:
    """Return the code of a load that failed because its segment's file could not be made."""
    return "no_space" if is_full(error) else "load_failed"


class Key(NamedTuple):
    """One layer of one cell."""

    cell_id: str
    layer: str


@dataclass(slots=True, eq=False)
class Resident:
    """A published segment and what the daemon knows of its use.

    ``checked`` is false for one of a previous run of the daemon until its bytes were compared with
    their checksums: until then it is not handed out.  ``prefetched`` is true for one that was fetched ahead,
    until a client asks for it.  ``handle`` and ``stale_handle`` are encoded once, for all
    replies; ``sessions`` are the slots of sessions that hold it; ``place`` is where it stands
    among all segments of its size; ``deferred_s`` how long it was deferred when it was last found in use.
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
    sessions: set[int] = field(default_factory=set)
    place: int = -1
    deferred_s: float = 0.0


@dataclass(slots=True, eq=False)
class Retired:
    """A segment out of service; ``resident`` says what it was.

    ``probe_after_s`` is when its use is next worth a look, ``unopened`` that no process had it open
    at the last look, ``interval_s`` how long the last wait between two looks was; before ``tick_over_s``
    a process may be just opening it.
    """

    resident: Resident
    unopened: bool = False
    probe_after_s: float = 0.0
    interval_s: float = 0.0
    tick_over_s: float = 0.0


@dataclass(slots=True, eq=False)
class Load:
    """A load that is queued or under way; ``reserved`` bytes are promised to it meanwhile.

    ``adopted`` is a segment of a previous run that only has to be checked, ``unless`` the state of a file
    that could not be loaded: in that state it is not tried again.  ``wanted`` says that a client asked for
    it, ``sources`` and ``version`` what the catalogue knew of its file and its neighbours', and which version
    that makes, when a worker was given the job.  ``computed`` says that it is a layer that is computed, which
    may take long.  ``payer`` is the asker whose turn was used for it, ``charged_s`` the loader's time that it
    was expected to need, ``spent_s`` the time that it did, ``took_s`` how long it took, fetching included;
    ``losses`` counts loaders that were lost through no fault of its own.
    ``prefetch`` says that no client has asked for it yet, ``unread`` that what it reads could not be read.
    """

    key: Key
    estimate: int
    priority: float
    number: int
    asker: Hashable = None
    running: bool = False
    reserved: int = 0
    started_s: float = 0.0
    adopted: Resident | None = None
    unless: Stamp | None = None
    wanted: bool = True
    sources: tuple[Stamp, ...] = ()
    version: int = 0
    payer: Hashable = None
    charged_s: float = 0.0
    spent_s: float = 0.0
    took_s: float = 0.0
    losses: int = 0
    computed: bool = False
    prefetch: bool = False
    unread: bool = False


@dataclass(slots=True)
class Failure:
    """Why the last load of a key failed, and when asking again is worth another try.

    ``stamp`` is the state of the file that it failed for: another state is tried at once.  None, if it is
    not known or must not be looked up (its file system may be what hangs).
    """

    code: str
    message: str
    stamp: Stamp | None
    retry_at_s: float
    delay_s: float
