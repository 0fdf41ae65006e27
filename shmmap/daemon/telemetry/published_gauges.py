# SPDX-License-Identifier: Apache-2.0
"""What the statistics show of a published map: its version, and what the daemon itself has read of it.

Loaders report what they read in the messages that end their loads.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

from shmmap.statistics.counters import REFUSALS

if TYPE_CHECKING:
    from shmmap.origin.remote.object_tier import ObjectCounts
    from shmmap.origin.remote.taken_version import TakenVersion
    from shmmap.statistics.writer import StatisticsWriter

__all__ = ["PublishedGauges", "VersionInService"]


class VersionInService(Protocol):
    """A published map, as its version is served."""

    @property
    def in_service(self) -> TakenVersion | None:
        """The version that is served; None: it is not known yet."""

    @property
    def refused_version(self) -> int:
        """Number of the version that is offered and was refused; 0: none."""

    @property
    def expires_s(self) -> float | None:
        """When the version's signature expires, Unix time; None if it is not signed."""

    @property
    def signed_s(self) -> float:
        """When the version was signed, Unix time; 0: it is not."""

    @property
    def refusal(self) -> str:
        """Why the offer is not taken, one of `REFUSALS`; empty if it is."""

    @property
    def counts(self) -> ObjectCounts:
        """What was read of the index so far."""


class PublishedGauges:
    """Brings the statistics up to date at each beat."""

    def __init__(self, statistics: StatisticsWriter) -> None:
        self._statistics = statistics
        self._counts: ObjectCounts | None = None

    def look(self, origin: VersionInService) -> None:
        """Show what is served, and what was read since the last time."""
        statistics, counts = self._statistics, origin.counts
        if counts != self._counts:
            statistics.add_objects_read(counts if self._counts is None else counts.since(self._counts))
            self._counts = counts
        taken, expires_s = origin.in_service, origin.expires_s
        if taken is not None:
            statistics.set("published_version", taken.version)
            statistics.set("published_taken_unix_ns", int(taken.taken_s * 1e9))
        statistics.set("published_refused", origin.refused_version)
        statistics.set("published_refusal", REFUSALS.index(origin.refusal))
        statistics.set("published_expires_unix_ns", int((expires_s or 0.0) * 1e9))
        statistics.set("published_signed_unix_ns", int(origin.signed_s * 1e9))
