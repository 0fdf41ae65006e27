# SPDX-License-Identifier: Apache-2.0
"""A drive seen from above, as one SVG file: what was kept in red, what the map explained in grey."""

from __future__ import annotations

import base64
import math
from typing import Any, Final
from xml.sax.saxutils import escape

import numpy as np
from numpy.typing import NDArray

from shmmap_clients.png import png_bytes
from shmmap_clients.spread import Decimated

__all__ = ["TopView"]

_PIXELS: Final = 2400  # along the longer side, at most
_WIDTH_PX: Final = 1200.0
_CAPTION_PX: Final = 64.0
_MARGIN: Final = 2.0  # metres
_REMOVED: Final = (178, 186, 194)
_KEPT: Final = (214, 40, 40)
_MOST: Final = 1 << 20  # pixels that are remembered before they are made twice as large
_OFFSET: Final = 1 << 30  # makes indices positive; two of them fit one int64


class TopView:
    """Collects which pixels of the ground have kept and which have removed points.

    Parameters
    ----------
    pixel
        Side of a pixel, metres; the picture is made coarser where it would be too large.
    """

    def __init__(self, pixel: float = 0.1) -> None:
        self._pixel = pixel
        self._offset = _OFFSET
        self._kept = np.empty(0, np.int64)
        self._removed = np.empty(0, np.int64)
        self._path: Decimated[tuple[float, float]] = Decimated()

    def add(self, xyz: NDArray[Any], kept: NDArray[np.bool_], position: tuple[float, float]) -> None:
        """Add a scan: (N, 3) and (N,), metres, map frame; and where it was taken."""
        places = np.floor(xyz[:, :2].astype(np.float64) / self._pixel)
        finite = np.isfinite(places).all(axis=1) & (np.abs(places) < self._offset).all(axis=1)
        index = places[finite].astype(np.int64) + self._offset
        packed = (index[:, 1] << 32) | index[:, 0]
        mine = kept[finite]
        self._kept = np.union1d(self._kept, packed[mine])
        self._removed = np.union1d(self._removed, packed[~mine])
        self._path.add(position)
        while len(self._kept) + len(self._removed) > _MOST:
            self._coarsen()

    def _coarsen(self) -> None:
        """Make pixels twice as large: memory does not grow with the length of the drive."""
        self._pixel *= 2
        self._offset //= 2
        self._kept, self._removed = (
            np.unique(((packed >> 33) << 32) | ((packed & 0xFFFFFFFF) >> 1))
            for packed in (self._kept, self._removed)
        )

    def svg(self, title: str, note: str) -> str:
        """Return the picture, north up, with a scale and two lines of text below."""
        removed, kept = (_unpacked(packed) - self._offset for packed in (self._removed, self._kept))
        both = np.concatenate([removed, kept])
        if not len(both):
            both = np.zeros((1, 2), np.int64)
        rim = math.ceil(_MARGIN / self._pixel)
        low, high = both.min(axis=0) - rim, both.max(axis=0) + rim + 1
        coarse = max(1, math.ceil(int((high - low).max()) / _PIXELS))
        columns, rows = (int(v) for v in np.ceil((high - low) / coarse))
        image = np.full((rows, columns, 3), 255, np.uint8)
        for places, colour in ((removed, _REMOVED), (kept, _KEPT)):
            at = (places - low) // coarse
            image[rows - 1 - at[:, 1], at[:, 0]] = colour
        size = self._pixel * coarse
        scale = _WIDTH_PX / columns
        height = rows * scale
        data = base64.b64encode(png_bytes(image)).decode("ascii")
        corner = low * self._pixel

        def place(x: float, y: float) -> str:
            return f"{(x - corner[0]) / size * scale:.1f},{height - (y - corner[1]) / size * scale:.1f}"

        path = " ".join(place(x, y) for x, y in self._path.values)
        bar = 10.0 ** math.floor(math.log10(max(columns * size / 4, 1e-3)))
        bar_px = bar / size * scale
        top = height + 24
        right = _WIDTH_PX - 16
        box = f"0 0 {_WIDTH_PX:.0f} {height + _CAPTION_PX:.0f}"
        extent = f'x="0" y="0" width="{_WIDTH_PX:.0f}" height="{height:.1f}"'
        line = 'stroke="#1f2933" stroke-width="3"'
        return "\n".join(
            [
                f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{box}" width="{_WIDTH_PX:.0f}">',
                f"<title>{escape(title)}</title>",
                '<rect width="100%" height="100%" fill="#ffffff"/>',
                f'<image {extent} image-rendering="pixelated" href="data:image/png;base64,{data}"/>',
                f'<polyline points="{path}" fill="none" stroke="#1c7ed6" stroke-width="2"/>',
                '<g font-family="system-ui, DejaVu Sans, sans-serif" font-size="15" fill="#1f2933">',
                f'<text x="16" y="{top}" font-weight="600">{escape(title)}</text>',
                f'<text x="16" y="{top + 22}">{escape(note)}</text>',
                _legend(_WIDTH_PX - 560, top, "#d62828", "kept: not in the map"),
                _legend(_WIDTH_PX - 360, top, "#b2bac2", "removed"),
                _legend(_WIDTH_PX - 250, top, "#1c7ed6", "drive"),
                f'<path d="M{right - bar_px:.1f} {top + 18} h{bar_px:.1f}" {line}/>',
                f'<text x="{right:.0f}" y="{top + 10}" text-anchor="end">{bar:g} m</text>',
                "</g>",
                "</svg>",
                "",
            ]
        )


def _legend(x: float, y: float, colour: str, text: str) -> str:
    return (
        f'<rect x="{x:.0f}" y="{y - 11}" width="12" height="12" fill="{colour}"/>'
        f'<text x="{x + 18:.0f}" y="{y}">{escape(text)}</text>'
    )


def _unpacked(packed: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.stack([packed & 0xFFFFFFFF, packed >> 32], axis=1)
