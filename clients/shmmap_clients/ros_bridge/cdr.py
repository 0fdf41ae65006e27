# SPDX-License-Identifier: Apache-2.0
"""Messages as bytes, written by hand: CDR (OMG, Common Data Representation), version 1, little-endian.

Every number stands at a multiple of its own size, counted from the end of the four bytes of encapsulation; a
text is its length with a closing zero byte, then its bytes; a sequence is its length, then its elements.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable
from typing import Final

__all__ = ["MAX_BYTES", "CdrWriter", "Content"]

MAX_BYTES: Final = 2**31 - 1
"""Largest sample that CycloneDDS sends (``Internal/MaxSampleSize``), 2 GiB: lengths in it are of 32 bits."""

_ENCAPSULATION: Final = b"\x00\x01\x00\x00"  # CDR_LE, no options

Fill = Callable[[memoryview], None]


class Content(bytearray):
    """The bytes of a sample. They are as many as a sample needs, so that `cyclonedds` copies them no more."""

    def ljust(self, width: int, fill: bytes = b"\0") -> Content:  # type: ignore[override]
        """Return itself, if it is long enough."""
        return self if len(self) >= width else Content(super().ljust(width, fill))


class CdrWriter:
    """Collects a message's parts; what is large is written once, straight to its place.

    Numbers and texts are kept until `content` is asked for. Then the sample gets all its memory at once, and
    each `blob` writes its bytes into it.
    """

    def __init__(self) -> None:
        self._large: list[tuple[int, int, Fill]] = []  # place, size and writer of each blob
        self._small: list[tuple[int, bytearray]] = []  # places of the bytes in between
        self._now = bytearray()
        self._start = 0  # where `_now` begins

    @property
    def size(self) -> int:
        """Bytes so far, without the encapsulation."""
        return self._start + len(self._now)

    def _pack(self, form: str, align: int, *values: float) -> None:
        self._now += b"\0" * (-self.size % align)
        self._now += struct.pack(form, *values)

    def boolean(self, value: bool) -> None:
        """Append a truth value, one byte."""
        self._pack("<B", 1, value)

    def uint8(self, value: int) -> None:
        """Append a byte."""
        self._pack("<B", 1, value)

    def int32(self, *values: int) -> None:
        """Append signed numbers."""
        self._pack(f"<{len(values)}i", 4, *values)

    def uint32(self, *values: int) -> None:
        """Append numbers that are not negative."""
        self._pack(f"<{len(values)}I", 4, *values)

    def uint64(self, *values: int) -> None:
        """Append numbers that are not negative."""
        self._pack(f"<{len(values)}Q", 8, *values)

    def int64(self, value: int) -> None:
        """Append a signed number."""
        self._pack("<q", 8, value)

    def float32(self, *values: float) -> None:
        """Append numbers."""
        self._pack(f"<{len(values)}f", 4, *values)

    def float64(self, value: float) -> None:
        """Append a number."""
        self._pack("<d", 8, value)

    def text(self, value: str) -> None:
        """Append a text."""
        data = value.encode()
        self.uint32(len(data) + 1)
        self._now += data
        self._now.append(0)

    def texts(self, values: Iterable[str]) -> None:
        """Append a sequence of texts."""
        listed = list(values)
        self.uint32(len(listed))
        for one in listed:
            self.text(one)

    def prepared(self, data: bytes) -> None:
        """Append bytes that were written before, by another writer, to stand at a multiple of four."""
        self._now += b"\0" * (-self.size % 4)
        self._now += data

    def blob(self, nbytes: int, fill: Fill) -> None:
        """Append ``nbytes`` bytes, which ``fill`` writes when it is called with their place."""
        self._small.append((self._start, self._now))
        self._large.append((self.size, nbytes, fill))
        self._start = self.size + nbytes
        self._now = bytearray()

    def content(self, over: Content | None = None) -> Content:
        """Return the sample: encapsulation, message, and up to three bytes to a multiple of four.

        Parameters
        ----------
        over
            A sample that has been sent: its memory is used again, so that none has to be cleared first. What
            is announced then has to be written whole.

        Raises
        ------
        ValueError
            It has more bytes than DDS can send.
        """
        size = len(_ENCAPSULATION) + self.size
        if size > MAX_BYTES:
            raise ValueError(f"{size} bytes, of at most {MAX_BYTES}")
        made = Content() if over is None else over
        nbytes = size + -size % 4
        if len(made) < nbytes:
            made += bytes(nbytes - len(made))
        del made[nbytes:]
        made[size:] = bytes(nbytes - size)
        made[:4] = _ENCAPSULATION
        for start, data in [*self._small, (self._start, self._now)]:
            made[4 + start : 4 + start + len(data)] = data
        with memoryview(made) as whole:
            for start, nbytes, fill in self._large:
                with whole[4 + start : 4 + start + nbytes] as place:
                    fill(place)
        return made
