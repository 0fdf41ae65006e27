# SPDX-License-Identifier: Apache-2.0
"""The turns of the daemon's loop in some time, as the daemon itself measures them: processor time."""

from __future__ import annotations

from shmmap.statistics.histogram import Histogram, lower_bound_ns
from shmmap.statistics.reader import read_statistics
from tests.support.daemon_process import DaemonProcess

__all__ = ["Turns"]


class Turns:
    """Those since it was made; reading them sends no request."""

    def __init__(self, one: DaemonProcess) -> None:
        self._one = one
        self._before, self._longest_before = self._now()

    def _now(self) -> tuple[Histogram, dict[str, float]]:
        """All turns, and the longest of each kind (ms), of the daemon's life."""
        found = read_statistics(self._one.instance, self._one.shm_dir)
        return found.histograms["turn"], {
            name.removeprefix("longest_turn_").removesuffix("_ns"): value / 1e6
            for name, value in found.counters.items()
            if name.startswith("longest_turn_")
        }

    def quantile_and_longest_ms(self, share: float) -> tuple[float, float]:
        """What ``share`` of the turns do not exceed, and what none does, ms."""
        histogram, longest = self._now()
        found = histogram.since(self._before)
        last = max((bucket for bucket, count in enumerate(found.counts) if count), default=0)
        grown = max((ms for kind, ms in longest.items() if ms > self._longest_before[kind]), default=0.0)
        if grown * 1e6 < lower_bound_ns(last):  # a kind that once had a longer one: only the bucket tells
            grown = lower_bound_ns(last + 1) / 1e6
        return (found.quantile_s(share) or 0.0) * 1e3, grown

    def said(self) -> str:
        """Median, 99.9th percentile and longest, and which kinds had the longest of the daemon's life."""
        p50, longest = self.quantile_and_longest_ms(0.5)
        p999, _ = self.quantile_and_longest_ms(0.999)
        shown = sorted(self._now()[1].items(), key=lambda one: -one[1])[:3]
        return (
            f"p50 {p50:.3f}  p99.9 {p999:.2f}  longest {longest:.1f} ms;"
            f" of the daemon's life: {', '.join(f'{kind} {ms:.1f}' for kind, ms in shown)}"
        )
