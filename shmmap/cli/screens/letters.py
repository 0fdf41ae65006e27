# SPDX-License-Identifier: Apache-2.0
"""How many columns of a terminal text takes: a letter of Chinese takes two, an accent of its own none."""

from __future__ import annotations


def columns_of(text: str) -> int:
    """Return how many columns a printable text takes."""
    return len(text) if text.isascii() else sum(map(_columns, text))


def _columns(letter: str) -> int:
    import unicodedata  # for names that are not ASCII alone

    if unicodedata.category(letter) in ("Mn", "Me", "Cf"):
        return 0
    return 2 if unicodedata.east_asian_width(letter) in ("W", "F") else 1


def cut(text: str, room: int) -> str:
    """Return as much of the text's start as takes at most ``room`` columns."""
    if text.isascii():
        return text[: max(room, 0)]
    for at, letter in enumerate(text):
        room -= _columns(letter)
        if room < 0:
            return text[:at]
    return text


def folded(text: str, width: int) -> list[str]:
    """Return the text in pieces that take at most ``width`` columns each, or are one letter."""
    pieces = []
    while len(piece := cut(text, width) or text[:1]) < len(text):
        pieces.append(piece)
        text = text[len(piece) :]
    return [*pieces, text]


def padded(text: str, width: int, align: str = "left") -> str:
    """Return the text with blanks up to ``width`` columns."""
    blanks = " " * (width - columns_of(text))
    return blanks + text if align == "right" else text + blanks
