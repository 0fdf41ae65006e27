# SPDX-License-Identifier: Apache-2.0
"""Text without a font file: its place, its width, and a shape for every character."""

from __future__ import annotations

import string

import numpy as np

from shmmap.viewing.lettering import Canvas, text_width

INK = (10, 20, 30)


def marks(canvas: Canvas) -> tuple[int, int, int, int]:
    """Left, top, right and bottom of what is not white."""
    rows, columns = np.nonzero((canvas.pixels != 255).any(axis=2))
    return int(columns.min()), int(rows.min()), int(columns.max()), int(rows.max())


def test_text_stands_on_its_baseline_and_is_as_wide_as_it_says() -> None:
    for anchor, left in (("start", 100.0), ("middle", 100.0 - text_width("H80", 12.0) / 2)):
        canvas = Canvas(300, 60)
        canvas.text(100, 40, "H80", INK, size=12.0, anchor=anchor)  # type: ignore[arg-type]
        first, top, last, bottom = marks(canvas)
        assert abs(first - left) <= 2
        assert abs(last - left - text_width("H80", 12.0)) <= 2
        assert abs(top - 28) <= 2
        assert abs(bottom - 40) <= 2


def test_every_character_has_a_shape_of_its_own() -> None:
    shapes = set()
    characters = string.ascii_letters + string.digits + ".,:;-+_/\\()[]=%<>|!?'\"~*#@&^" + "ä"
    for character in characters:
        canvas = Canvas(40, 40)
        canvas.text(12, 26, character, INK, size=12.0)
        shapes.add(canvas.pixels.tobytes())
    assert len(shapes) == len(characters)


def test_what_lies_beside_the_canvas_is_left_out() -> None:
    canvas = Canvas(50, 20)
    canvas.line([(-40.0, 10.0), (-5.0, 10.0)], INK)
    canvas.text(400, 10, "far", INK)
    canvas.polygon([(-9.0, -9.0), (-1.0, -9.0), (-5.0, -1.0)], INK)
    assert (canvas.pixels == 255).all()
    canvas.line([(-40.0, 10.5), (60.0, 10.5)], INK)
    assert (canvas.pixels[10] == INK).all()
