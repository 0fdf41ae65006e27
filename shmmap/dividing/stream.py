# SPDX-License-Identifier: Apache-2.0
"""All inputs as one stream of rows, with a place to continue from."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from shmmap.dividing.partition import Partition
from shmmap.dividing.progress import Progress
from shmmap.dividing.row_layout import RowLayout
from shmmap.dividing.sources import Source
from shmmap.formats.causes import refusal

__all__ = ["Stream"]


class Stream:
    """Reads sources one after the other into a `Partition`.

    Attributes
    ----------
    position
        Points read, of all sources together.
    kept, dropped, extremes
        As in `Partition`, with what an earlier run did.
    """

    def __init__(self, sources: Sequence[Source], layout: RowLayout) -> None:
        self._sources = sources
        self._layout = layout
        self.position = 0
        self.kept = self.dropped = 0
        self.extremes = np.array([[np.inf] * 3, [-np.inf] * 3])

    def restore(self, state: dict[str, Any]) -> None:
        """Return to where ``save`` was called; the state has passed through JSON."""
        self.position = state["position"]
        self.kept, self.dropped = state["kept"], state["dropped"]
        if self.kept:
            self.extremes = np.array(state["extremes"])

    def run(
        self,
        partition: Partition,
        progress: Progress,
        *,
        save: Callable[[dict[str, Any]], None],
        every_s: float,
    ) -> None:
        """Read everything from the present position on; call ``save`` with the state now and then."""
        progress.stage("dividing", sum(source.points for source in self._sources))
        progress.advance(self.position)
        before = self.kept, self.dropped, self.extremes
        saved_s = time.monotonic()
        skip = self.position
        for source in self._sources:
            if skip >= source.points:
                skip -= source.points
                continue
            source.begin(replace(self._layout, scale=source.scale), skip)
            left = source.points - skip
            skip = 0
            while left:
                if time.monotonic() - saved_s >= every_s:
                    partition.drain()
                    self._take(partition, before)
                    save(
                        {
                            "position": self.position,
                            "kept": self.kept,
                            "dropped": self.dropped,
                            "extremes": self.extremes.tolist() if self.kept else None,
                        }
                    )
                    saved_s = time.monotonic()
                buffer = partition.buffer()
                count = source.read(buffer[:left])
                if not count:
                    points = source.points
                    raise refusal(
                        "truncated", f"{points} points announced, {points - left} are there", path=source.path
                    )
                partition.submit(buffer, count)
                self.position += count
                left -= count
                progress.advance(count)
            source.close()
        partition.drain()
        self._take(partition, before)

    def _take(self, partition: Partition, before: tuple[int, int, Any]) -> None:
        kept, dropped, extremes = before
        self.kept = kept + partition.kept
        self.dropped = dropped + partition.dropped
        self.extremes = np.array(
            [np.minimum(extremes[0], partition.extremes[0]), np.maximum(extremes[1], partition.extremes[1])]
        )
