# SPDX-License-Identifier: Apache-2.0
"""A canvas of pixels with anti-aliased lines, and text written in them: no font file is needed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Final, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

Colour: TypeAlias = tuple[int, int, int]
Anchor: TypeAlias = Literal["start", "middle", "end"]
Place: TypeAlias = tuple[float, float]

WHITE: Final[Colour] = (255, 255, 255)

_STROKES: Final = """
0=102031352616050110 1=112026,1636 2=01103041420646 3=01103041423323,23334445361605 4=36300444
5=400003334445361605 6=413010010516364544331304 7=00404116 8=133342413010010213,133344453616050413
9=051636454130100102133342 a=12324346,441405163645 b=0006,0312324345361605 c=4332120305163645
d=4046,4332120305163645 e=04444332120305163645 f=30201116,0232 g=4247381807,4332120305163645
h=0006,0312324346 i=0206,00 j=22271808,20 k=0006,4204,2346 l=000516 m=0206,0312223336,3342526366
n=0206,0312324346 o=123243453616050312 p=0208,0312324345361605 q=4248,4332120305163645 r=0206,031232
s=43321203143445361605 t=10152636,0232 u=0205163645,4246 v=022642 w=0216335662 x=0246,4206
y=0226,4218 z=02420646 A=062046,1434 B=06003041423303,3344453606 C=4130100105163645 D=06002042442606
E=40000646,0333 F=400006,0333 G=41301001051636454323 H=0006,4046,0343 I=0020,1016,0626 J=3035261605
K=0006,4004,1346 L=000646 M=0600234046 N=06004640 O=103041453616050110 P=06003041423303
Q=103041453616050110,2446 R=06003041423303,2346 S=413010010213334445361605 T=0040,2026 U=000516364540
V=002640 W=0016325660 X=0046,4006 Y=002340,2326 Z=00400646 .=06 ,=1608 :=03,06 ;=03,1608 -=0434
+=0444,2226 _=0747 /=0730 \\=0037 (=10010516 )=00111506 [=10000616 ]=00101606 ==0343,0545
%=4006,0010110100,3545463635 <=320436 >=023406 |=0007 !=0004,06 ?=01103041422324,26 '=0002 "=0002,2022
~=04133544 *=0245,0542,2125 #=1016,3036,0242,0444 @=34242232344441301001051646 &=46121120310405162644 ^=022042
"""
"""Each character's strokes on a grid: x and y of their points, y downwards, baseline 6, capitals 6 high."""

_UNKNOWN: Final = "0040460600"
_GAP: Final = 2.0
_SPACE: Final = 3.0
_STRIP: Final = 64  # rows of pixels at a time: a line across the picture covers all of it


@lru_cache(maxsize=256)
def _glyph(character: str) -> tuple[tuple[tuple[Place, ...], ...], float]:
    """Return the strokes of a character, and its width, in grid units."""
    strokes = tuple(
        tuple((float(x), float(y)) for x, y in zip(stroke[::2], stroke[1::2], strict=True))
        for stroke in _GLYPHS.get(character, _UNKNOWN).split(",")
    )
    return strokes, max(x for stroke in strokes for x, _ in stroke)


_GLYPHS: Final = {word[0]: word[2:] for word in _STROKES.split()}


def text_width(text: str, size: float) -> float:
    """Return the width of a line of text whose capitals are ``size`` pixels high."""
    widths = [_SPACE if character == " " else _glyph(character)[1] for character in text]
    return (sum(widths) + _GAP * max(len(text) - 1, 0)) * size / 6.0


class Canvas:
    """A white picture, (rows, columns, 3) uint8 in ``pixels``; x to the right, y downwards, in pixels."""

    def __init__(self, width: int, height: int) -> None:
        self.pixels = np.full((height, width, 3), 255, np.uint8)

    def rectangle(self, x: float, y: float, width: float, height: float, colour: Colour) -> None:
        """Fill whole pixels."""
        left, top = max(round(x), 0), max(round(y), 0)
        self.pixels[top : max(round(y + height), 0), left : max(round(x + width), 0)] = colour

    def line(self, points: Sequence[Place], colour: Colour, width: float = 1.0) -> None:
        """Draw a line through points; a single point is a dot."""
        self._cover([points], colour, width)

    def polygon(self, points: Sequence[Place], colour: Colour) -> None:
        """Fill a convex polygon whose corners are given clockwise, as seen."""
        area = self._area(points, 1.0)
        if area is None:
            return
        rows, columns, y, x = area
        inside = np.full((len(y), x.shape[1]), np.inf)
        for (x0, y0), (x1, y1) in zip(points, [*points[1:], points[0]], strict=True):
            side = ((x1 - x0) * (y - y0) - (y1 - y0) * (x - x0)) / max(math.hypot(x1 - x0, y1 - y0), 1e-9)
            np.minimum(inside, side, out=inside)
        self._blend(rows, columns, np.clip(inside + 0.5, 0.0, 1.0), colour)

    def text(
        self,
        x: float,
        y: float,
        text: str,
        colour: Colour,
        *,
        size: float = 9.0,
        anchor: Anchor = "start",
        halo: bool = False,
    ) -> None:
        """Write a line of text.

        Parameters
        ----------
        x, y
            Start, middle or end of the text, as ``anchor`` says; baseline.
        size
            Height of capitals.
        halo
            Whether the letters have a white border, for text on a picture.
        """
        unit = size / 6.0
        at = x - {"start": 0.0, "middle": 0.5, "end": 1.0}[anchor] * text_width(text, size)
        lines: list[list[Place]] = []
        for character in text:
            width = _SPACE
            if character != " ":
                strokes, width = _glyph(character)
                lines += [[(at + u * unit, y + (v - 6.0) * unit) for u, v in stroke] for stroke in strokes]
            at += (width + _GAP) * unit
        weight = max(size / 7.0, 1.0)
        if halo:
            self._cover(lines, WHITE, weight + 4.0)
        self._cover(lines, colour, weight)

    def _cover(self, lines: Sequence[Sequence[Place]], colour: Colour, width: float) -> None:
        """Draw lines, each with round ends."""
        for points in lines:
            area = self._area(points, width / 2.0 + 1.0)
            if area is None:
                continue
            rows, columns, all_y, x = area
            for first in range(0, len(all_y), _STRIP):
                y = all_y[first : first + _STRIP]
                least = np.full((len(y), x.shape[1]), np.inf)
                for (x0, y0), (x1, y1) in zip(points, points[1:] or points, strict=False):
                    along_x, along_y = x1 - x0, y1 - y0
                    squared = along_x * along_x + along_y * along_y or 1.0
                    at = np.clip(((x - x0) * along_x + (y - y0) * along_y) / squared, 0.0, 1.0)
                    apart = (x - x0 - at * along_x) ** 2 + (y - y0 - at * along_y) ** 2
                    np.minimum(least, apart, out=least)
                share = np.clip(width / 2.0 + 0.5 - np.sqrt(least), 0.0, 1.0)
                strip = slice(rows.start + first, rows.start + first + len(y))
                self._blend(strip, columns, share, colour)

    def _area(
        self, points: Sequence[Place], margin: float
    ) -> tuple[slice, slice, NDArray[np.float64], NDArray[np.float64]] | None:
        """Return the pixels around points: rows, columns, and centres y and x; None if there are none."""
        height, width = self.pixels.shape[:2]
        x, y = zip(*points, strict=True)
        left, right = max(math.floor(min(x) - margin), 0), min(math.ceil(max(x) + margin), width)
        top, bottom = max(math.floor(min(y) - margin), 0), min(math.ceil(max(y) + margin), height)
        if left >= right or top >= bottom:
            return None
        rows, columns = slice(top, bottom), slice(left, right)
        return rows, columns, np.arange(top, bottom)[:, None] + 0.5, np.arange(left, right)[None, :] + 0.5

    def _blend(self, rows: slice, columns: slice, share: NDArray[np.float64], colour: Colour) -> None:
        part = self.pixels[rows, columns]
        mixed = part + (np.array(colour, np.float64) - part) * share[..., None]
        self.pixels[rows, columns] = mixed.round().astype(np.uint8)
