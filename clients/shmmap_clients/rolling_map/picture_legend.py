# SPDX-License-Identifier: Apache-2.0
"""What the colours of the picture mean: states of chunks as Rolling-Bonxai shows them, heights, a scale."""

from __future__ import annotations

import base64
import math
from collections.abc import Collection
from typing import Final, NamedTuple
from xml.sax.saxutils import escape

from shmmap_clients.png import png_bytes
from shmmap_clients.rolling_map.heights import HeightColours

__all__ = ["STATES", "chunk_style", "legend"]

_LETTER_PX: Final = 7.6  # width of a letter, on average
_BAR_PX: Final = 200.0


class _Look(NamedTuple):
    colour: str
    opacity: float
    text: str


STATES: Final = {
    "loading": _Look("#111418", 0.30, "loading"),
    "saving": _Look("#0e9db8", 0.24, "saving"),
    "dirty": _Look("#2563eb", 0.17, "dirty: newer than on disk"),
    "clean": _Look("#2f9e44", 0.17, "clean: as on disk"),
    "saved": _Look("#9aa5b1", 0.0, "on disk only"),
}
"""By state, what is drawn; of chunks behind one another, that of the first state here is seen."""


def chunk_style(state: str, *, fill: bool) -> str:
    """Return attributes of the squares' areas, which lie below voxels, or of their outlines."""
    look = STATES[state]
    if fill:
        return f'fill="{look.colour}" fill-opacity="{look.opacity}"'
    width = 0.8 if state == "saved" else 1.2
    return f'fill="none" stroke="{look.colour}" stroke-opacity="0.8" stroke-width="{width}"'


def legend(
    left: float, top: float, width: float, states: Collection[str], colours: HeightColours | None, *,
    free: str, path: str, pixels_per_metre: float,
) -> str:  # fmt: skip
    """Return one line for squares and path, and one for heights and the scale.

    Parameters
    ----------
    left, top, width
        Where, SVG units.
    states
        Of the chunks that are drawn.
    colours
        Of occupied voxels; None: there are none.
    free, path
        Their colours; empty: there are none.
    pixels_per_metre
        Of the views.
    """
    parts, x = [], left
    if states:
        parts.append(f'<text x="{x:.0f}" y="{top:.1f}" font-weight="600">chunks</text>')
        x += 66.0
    for state, look in STATES.items():
        if state in states:
            box = f'x="{x:.1f}" y="{top - 12:.1f}" width="14" height="14"'
            parts += [
                f"<rect {box} {chunk_style(state, fill=True)}/>",
                f"<rect {box} {chunk_style(state, fill=False)}/>",
                f'<text x="{x + 20:.1f}" y="{top:.1f}">{look.text}</text>',
            ]
            x += 20.0 + len(look.text) * _LETTER_PX + 22.0
    if path:
        x = left + width - 132.0
        parts += [
            f'<path d="M{x:.1f} {top - 5:.1f} h26" stroke="{path}" stroke-width="2.2"/>',
            f'<circle cx="{x + 26:.1f}" cy="{top - 5:.1f}" r="5" fill="{path}"/>',
            f'<text x="{x + 38:.1f}" y="{top:.1f}">sensor\'s path</text>',
        ]
    low, x = top + 34.0, left
    if colours is not None:
        parts.append(_heights(x, low, colours))
        x += 66.0 + 56.0 + _BAR_PX + 90.0
    if free:
        parts += [
            f'<rect x="{x:.1f}" y="{low - 12:.1f}" width="14" height="14" fill="{free}" stroke="#c3ced8"/>',
            f'<text x="{x + 20:.1f}" y="{low:.1f}">free</text>',
        ]
    parts.append(_scale(left + width, low, width, pixels_per_metre))
    return "\n".join(parts)


def _heights(x: float, y: float, colours: HeightColours) -> str:
    bar = base64.b64encode(png_bytes(colours.levels[None])).decode("ascii")
    at = x + 66.0 + 56.0
    place = f'x="{at:.1f}" y="{y - 12:.1f}" width="{_BAR_PX:.0f}" height="14"'
    return "\n".join(
        [
            f'<text x="{x:.0f}" y="{y:.1f}" font-weight="600">height</text>',
            f'<text x="{at - 8:.1f}" y="{y:.1f}" text-anchor="end">{_metres(colours.low)}</text>',
            f'<image {place} preserveAspectRatio="none" href="data:image/png;base64,{bar}"/>',
            f'<text x="{at + _BAR_PX + 8:.1f}" y="{y:.1f}">{_metres(colours.high)} m</text>',
        ]
    )


def _metres(value: float) -> str:
    return f"{round(value, 1) + 0.0:.1f}".replace("-", "−")


def _scale(right: float, y: float, width: float, pixels_per_metre: float) -> str:
    """A bar of 1, 2 or 5 times a power of ten metres, at most a fifth of the width."""
    most = width / 5 / pixels_per_metre
    power = 10.0 ** math.floor(math.log10(most))
    metres = max(step * power for step in (1, 2, 5) if step * power <= most)
    bar = metres * pixels_per_metre
    return (
        f'<path d="M{right - bar:.1f} {y - 10:.1f} v7 h{bar:.1f} v-7" fill="none" stroke="#1f2933"'
        f' stroke-width="1.6"/>\n'
        f'<text x="{right - bar - 8:.1f}" y="{y:.1f}" text-anchor="end">{escape(f"{metres:g} m")}</text>'
    )
