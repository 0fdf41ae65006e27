# SPDX-License-Identifier: Apache-2.0
"""How much counters grew over the last ten seconds, minute and ten minutes."""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from collections.abc import Iterable, Mapping
from typing import Final

__all__ = ["RecentCounts"]

SAMPLE_S: Final = 1.0


class RecentCounts:
    """Remembers the values of some counters once a second.

    Parameters
    ----------
    names
        Which counters.
    spans_s
        Over which spans their growth is told, longest last.
    """

    def __init__(self, names: Iterable[str], spans_s: Iterable[float]) -> None:
        self._names = tuple(names)
        self._spans_s = tuple(spans_s)
        length = int(max(self._spans_s) / SAMPLE_S) + 2
        self._samples: deque[tuple[float, tuple[int, ...]]] = deque(maxlen=length)

    def look(self, values: Mapping[str, int], now_s: float) -> None:
        """Take a sample if the last one is old enough."""
        if not self._samples or now_s - self._samples[-1][0] >= SAMPLE_S:
            self._samples.append((now_s, tuple(values[name] for name in self._names)))

    def growth(self, values: Mapping[str, int], now_s: float) -> list[tuple[int, ...]]:
        """Return for each span how much each counter grew over it, to a sample's precision.

        For a span longer than anything is remembered, it is the growth since the beginning.
        """
        return [
            tuple(values[name] - old for name, old in zip(self._names, self._at(now_s - span), strict=True))
            for span in self._spans_s
        ]

    def _at(self, time_s: float) -> tuple[int, ...]:
        """Return the newest sample that is not younger than ``time_s``, or the oldest one."""
        found = bisect_right(self._samples, time_s, key=lambda sample: sample[0])
        return self._samples[max(0, found - 1)][1]
