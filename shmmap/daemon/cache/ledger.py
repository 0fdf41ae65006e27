# SPDX-License-Identifier: Apache-2.0
"""What is in memory, what it takes, and whether more fits; without any I/O.

Every byte is in exactly one place: *resident* (a named segment that can be handed out), *retired* (out
of service, perhaps still mapped), or *reserved* (promised to a load).  Their sum never exceeds the
budget: a load starts only when its reservation fits.

Times are seconds on any one clock, injected by the caller.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

from shmmap.daemon.records import Key, Resident, Retired

__all__ = ["Ledger"]


class Ledger:
    """The bytes of one daemon.

    Parameters
    ----------
    budget_bytes
        Never exceeded by resident, retired and reserved bytes together.

    Attributes
    ----------
    by_key : dict
        What can be handed out.
    retired : dict
        By the name they had, segments out of service.
    overhead_bytes
        What the daemon itself keeps in shared memory (its statistics); counts as used.
    unchecked_count
        How many residents are of an earlier life and not yet checked.
    """

    def __init__(self, budget_bytes: int) -> None:
        self.budget_bytes = budget_bytes
        self.by_key: dict[Key, Resident] = {}
        self.retired: dict[str, Retired] = {}
        self.resident_bytes = 0
        self.retired_bytes = 0
        self.reserved_bytes = 0
        self.overhead_bytes = 0
        self.unchecked_count = 0
        self._by_name: dict[str, Resident] = {}
        self._needed: dict[Key, int] = {}
        self._layers: Counter[str] = Counter()

    # --- sums ---------------------------------------------------------------------------------

    @property
    def used_bytes(self) -> int:
        """Resident, retired and reserved bytes together, and the daemon's own overhead."""
        return self.resident_bytes + self.retired_bytes + self.reserved_bytes + self.overhead_bytes

    def shortage(self, nbytes: int) -> int:
        """How many bytes must be freed before ``nbytes`` more fit; 0 or less when they fit."""
        return self.used_bytes + nbytes - self.budget_bytes

    def reserve(self, nbytes: int) -> bool:
        """Promise bytes to a load; False if they do not fit."""
        fits = nbytes <= 0 or self.shortage(nbytes) <= 0
        self.reserved_bytes += nbytes if fits else 0
        return fits

    def add_overhead(self, nbytes: int) -> bool:
        """The daemon itself keeps more; False if that does not fit."""
        fits = self.shortage(nbytes) <= 0
        self.overhead_bytes += nbytes if fits else 0
        return fits

    @property
    def resident_count(self) -> int:
        """How many segments can be handed out."""
        return len(self._by_name)

    def residents(self) -> Iterator[Resident]:
        """All segments that can be handed out."""
        return iter(self._by_name.values())

    def resident_named(self, name: str) -> Resident | None:
        """The segment of that name, if it can be handed out."""
        return self._by_name.get(name)

    def of_cell(self, cell_id: str) -> list[Resident]:
        """All layers of one cell that can be handed out."""
        found = (self.by_key.get(Key(cell_id, layer)) for layer in self._layers)
        return [resident for resident in found if resident is not None]

    def everything(self) -> list[Resident]:
        """All segments in memory, retired ones included, largest first."""
        found = [*self._by_name.values(), *(retired.resident for retired in self.retired.values())]
        return sorted(found, key=lambda resident: -resident.nbytes)

    # --- being needed ---------------------------------------------------------------------------

    def need(self, key: Key) -> None:
        """A waiting request or an operator's pin needs this: it is no candidate for eviction."""
        self._needed[key] = self._needed.get(key, 0) + 1

    def need_no_more(self, key: Key) -> None:
        """Take back one `need`."""
        count = self._needed.pop(key) - 1
        if count:
            self._needed[key] = count

    # --- coming ---------------------------------------------------------------------------------

    def enter(self, resident: Resident) -> Resident | None:
        """A segment is in service now; returns the version it supersedes, to be retired by name."""
        old = self.by_key.get(resident.key)
        self.by_key[resident.key] = self._by_name[resident.name] = resident
        self._layers[resident.key.layer] += 1
        self.resident_bytes += resident.nbytes
        self.unchecked_count += not resident.checked
        if old is not None:
            self._leave_service(old)
        return old

    def checked(self, resident: Resident) -> None:
        """A segment of an earlier life is what it should be: it can be handed out."""
        resident.checked = True
        self.unchecked_count -= 1

    # --- leaving --------------------------------------------------------------------------------

    def _leave_service(self, resident: Resident) -> None:
        del self._by_name[resident.name]
        self._layers[resident.key.layer] -= 1
        if not self._layers[resident.key.layer]:
            del self._layers[resident.key.layer]
        self.unchecked_count -= not resident.checked
        self.resident_bytes -= resident.nbytes
        self.add_retired(resident)

    def add_retired(self, resident: Resident) -> Retired:
        """Count a segment that is out of service, perhaps since an earlier life of the daemon."""
        self.retired_bytes += resident.nbytes
        retired = self.retired[resident.name] = Retired(resident)
        return retired

    def rename(self, resident: Resident, name: str) -> None:
        """A segment has another name from now on."""
        if resident.name in self._by_name:
            self._by_name[name] = self._by_name.pop(resident.name)
        else:
            self.retired[name] = self.retired.pop(resident.name)
        resident.name = name

    def retire(self, resident: Resident) -> None:
        """Nobody gets this segment any more; its bytes count until `freed`."""
        if self.by_key.get(resident.key) is resident:
            del self.by_key[resident.key]
        self._leave_service(resident)

    def revive(self, retired: Retired) -> Resident | None:
        """A retired segment is wanted again and still whole: hand it out as before.

        Returns the version that it supersedes, to be retired by name (the map went back to an
        earlier state).
        """
        self.freed(retired.resident.name)
        return self.enter(retired.resident)

    def freed(self, name: str) -> int:
        """A retired segment's memory is back with the kernel; returns its bytes."""
        nbytes = self.retired.pop(name).resident.nbytes
        self.retired_bytes -= nbytes
        return nbytes

    def condemned_bytes(self) -> int:
        """Bytes of retired segments that nobody had open at the last look: they are about to be freed."""
        return sum(one.resident.nbytes for one in self.retired.values() if one.condemned)

    def candidates(self, now_s: float, grace_s: float) -> tuple[list[Resident], list[Resident]]:
        """Residents that may be retired now, and those that may be soon, first come first.

        Left out are those somebody needs.  Those handed out less than ``grace_s`` ago come second: their
        reader may not have opened them yet.
        """
        free: list[Resident] = []
        graced: list[Resident] = []
        for resident in self._by_name.values():
            if resident.key not in self._needed:
                (graced if resident.last_use_s + grace_s > now_s else free).append(resident)
        graced.sort(key=lambda resident: resident.last_use_s)
        return free, graced
