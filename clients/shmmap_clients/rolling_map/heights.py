# SPDX-License-Identifier: Apache-2.0
"""Heights as colours: dark and violet below, orange above; never green or blue, which chunks are."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

__all__ = ["HeightColours"]

_ANCHORS: Final = np.array(
    [
        *((44, 22, 84), (98, 28, 122), (152, 42, 118), (202, 68, 92)),
        *((236, 112, 60), (250, 166, 40), (247, 208, 70)),
    ],
    np.float64,
)
_LEVELS: Final = 256


class HeightColours:
    """A scale of colours between two heights.

    Parameters
    ----------
    low, high
        Metres; what is beyond has the colour of the end.
    """

    def __init__(self, low: float, high: float) -> None:
        self.low, self.high = low, high
        at = np.linspace(0.0, len(_ANCHORS) - 1.0, _LEVELS)
        columns = [np.interp(at, np.arange(len(_ANCHORS)), _ANCHORS[:, channel]) for channel in range(3)]
        self.levels: NDArray[np.uint8] = np.stack(columns, axis=1).round().astype(np.uint8)

    @classmethod
    def of(cls, heights: NDArray[np.float64]) -> HeightColours:
        """Make a scale for these heights, (N,) metres, but for the outermost hundredths."""
        if not len(heights):
            return cls(0.0, 1.0)
        low, high = (float(value) for value in np.percentile(heights, (1, 99)))
        return cls(low, max(high, low + 1e-3))

    def rgb(self, heights: NDArray[np.float64]) -> NDArray[np.uint8]:
        """Return the colours of heights, (N, 3)."""
        part = np.clip((heights - self.low) / (self.high - self.low), 0.0, 1.0)
        found: NDArray[np.uint8] = self.levels[(part * (_LEVELS - 1)).round().astype(np.int64)]
        return found
