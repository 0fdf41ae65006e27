# SPDX-License-Identifier: Apache-2.0
"""What ``shmmap top`` has seen since it started, as one line of blocks each: memory, hits, waits."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from functools import reduce
from typing import TYPE_CHECKING, Final, NamedTuple

from shmmap.cli.screens.status_parts import taken_bytes
from shmmap.statistics.counters import Histogram

if TYPE_CHECKING:
    from shmmap.statistics.reader import Snapshot

MAX_SAMPLES: Final = 1024
"""Samples kept; of more, each two neighbours become one."""
_BLOCKS: Final = "▁▂▃▄▅▆▇█"


class Sample(NamedTuple):
    """What happened between two looks at the statistics.

    Attributes
    ----------
    taken
        Share of the budget that was taken, 0 to 1: the most.
    hits, misses
        Cells that were asked for: in memory, and not.
    waits, waited_ns
        Requests that waited for loads and got their answer, and how long they waited in all.
    """

    taken: float
    hits: int = 0
    misses: int = 0
    waits: int = 0
    waited_ns: int = 0

    @property
    def hit_ratio(self) -> float | None:
        """Share of cells that were in memory; None if none was asked for."""
        asked = self.hits + self.misses
        return self.hits / asked if asked else None

    @property
    def wait_s(self) -> float | None:
        """Mean wait of a request that had to wait; None if none had to."""
        return self.waited_ns * 1e-9 / self.waits if self.waits else None

    def joined(self, other: Sample) -> Sample:
        """Return both as one."""
        sums = (mine + theirs for mine, theirs in zip(self[1:], other[1:], strict=True))
        return Sample(max(self.taken, other.taken), *sums)


class History:
    """Samples since the first look, at most `MAX_SAMPLES`: older ones cover longer spans."""

    def __init__(self) -> None:
        self._samples: list[Sample] = []
        self._last: Snapshot | None = None
        self._first_ns = 0
        self._joined = 1  # looks that are one sample
        self._pending: list[Sample] = []

    @property
    def span_s(self) -> float:
        """Seconds from the first look to the last."""
        return (self._last.beat_monotonic_ns - self._first_ns) * 1e-9 if self._last is not None else 0.0

    def add(self, found: Snapshot) -> None:
        """Add what happened since the previous look; a daemon that has not beaten since adds nothing."""
        last = self._last
        if not found.counters or (last is not None and found.beat_monotonic_ns == last.beat_monotonic_ns):
            return
        self._last = found
        if last is None:
            self._first_ns = found.beat_monotonic_ns
            return
        if last.identity is None or found.identity is None or last.identity.epoch != found.identity.epoch:
            return  # another run of the daemon counts from 0
        waits = found.histograms.get("wait", Histogram())
        waited = waits.since(last.histograms.get("wait", Histogram()))
        counts = {name: found.counters[name] - last.counters[name] for name in ("hits", "misses")}
        taken = taken_bytes(found.counters) / max(found.counters["budget_bytes"], 1)
        self._pending.append(Sample(min(taken, 1.0), **counts, waits=waited.total, waited_ns=waited.sum_ns))
        if len(self._pending) == self._joined:
            self._samples.append(reduce(Sample.joined, self._pending))
            self._pending = []
        if len(self._samples) == MAX_SAMPLES:
            pairs = zip(self._samples[::2], self._samples[1::2], strict=True)
            self._samples = [first.joined(second) for first, second in pairs]
            self._joined *= 2

    def samples(self, width: int) -> list[Sample]:
        """Return the samples of all that was seen, at most ``width``, oldest first."""
        samples = [*self._samples, *([reduce(Sample.joined, self._pending)] if self._pending else [])]
        if len(samples) <= width:
            return samples
        ends = [len(samples) * index // width for index in range(width + 1)]
        return [reduce(Sample.joined, samples[begin:end]) for begin, end in itertools.pairwise(ends)]


def spark(
    samples: Sequence[Sample], value: Callable[[Sample], float | None], highest: float | None = None
) -> str:
    """Draw one block for each sample, as high as its value; a blank where there is none.

    Parameters
    ----------
    highest
        The value of a full block; None: the highest there is.
    """
    values = [value(sample) for sample in samples]
    top = highest if highest is not None else max((one for one in values if one is not None), default=0.0)
    return "".join(
        " " if one is None else _BLOCKS[min(int(one / top * len(_BLOCKS)), len(_BLOCKS) - 1) if top else 0]
        for one in values
    )
