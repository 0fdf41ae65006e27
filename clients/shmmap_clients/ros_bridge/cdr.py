# SPDX-License-Identifier: Apache-2.0
"""Hand-written encoder of messages: CDR (OMG, Common Data Representation), version 1, little-endian.

Every number is aligned to its own size, counted from the end of the four bytes of encapsulation.  A text is
its length including a closing zero byte, then its bytes.  A sequence is its length, then its elements.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Mapping
from functools import lru_cache, partial
from typing import Any, Final

from numpy.typing import NDArray

from shmmap_clients.ros_cells import MAX_BYTES, CloudLayout, cloud_layout, fill_rows

_ENCAPSULATION: Final = b"\x00\x01\x00\x00"  # CDR_LE, no options

Fill = Callable[[memoryview], None]


class Content(bytearray):
    """The bytes of a sample, already of the required length, so that `cyclonedds` does not copy them."""

    def ljust(self, width: int, fill: bytes = b"\0") -> Content:  # type: ignore[override]
        """Return this object, if it is long enough."""
        return self if len(self) >= width else Content(super().ljust(width, fill))


def copy_into(place: memoryview, data: bytearray | memoryview) -> None:
    """Copy bytes to their place in a sample, as the ``fill`` of a `CdrWriter.blob`."""
    place[:] = data


class CdrWriter:
    """Writer of a message; large parts are written once, directly to their place in the sample.

    Numbers and texts are kept until `content` is called. It allocates the whole sample at once, and each
    `blob` writes its bytes into the sample.
    """

    def __init__(self) -> None:
        self._large: list[tuple[int, int, Fill]] = []  # place, size and writer of each blob
        self._small: list[tuple[int, bytearray]] = []  # place and bytes of the parts in between
        self._now = bytearray()
        self._start = 0  # place of the beginning of `_now`

    @property
    def size(self) -> int:
        """Number of bytes so far, without the encapsulation."""
        return self._start + len(self._now)

    def numbers(self, form: str, *values: float) -> None:
        """Append numbers; none may be larger than the one before, so that only the first needs alignment.

        Parameters
        ----------
        form
            A code of `struct` for each number: ``B`` and ``?`` have one byte, ``i``, ``I`` and ``f`` four,
            ``q``, ``Q`` and ``d`` eight.
        values
            The numbers.
        """
        self._now += b"\0" * (-self.size % struct.calcsize(f"<{form[0]}"))
        self._now += struct.pack(f"<{form}", *values)

    def text(self, value: str) -> None:
        """Append a text."""
        data = value.encode()
        self.numbers("I", len(data) + 1)
        self._now += data
        self._now.append(0)

    def texts(self, values: Iterable[str]) -> None:
        """Append a sequence of texts."""
        listed = list(values)
        self.numbers("I", len(listed))
        for one in listed:
            self.text(one)

    def prepared(self, data: bytes) -> None:
        """Append the bytes of another writer, aligned to four."""
        self._now += b"\0" * (-self.size % 4)
        self._now += data

    def blob(self, nbytes: int, fill: Fill) -> None:
        """Append ``nbytes`` bytes; ``fill`` writes them later, when it is called with their memory."""
        self._small.append((self._start, self._now))
        self._large.append((self.size, nbytes, fill))
        self._start = self.size + nbytes
        self._now = bytearray()

    def content(self, over: Content | None = None) -> Content:
        """Return the sample: encapsulation, message, and padding to a multiple of four bytes.

        Parameters
        ----------
        over
            A sample that has been sent, whose memory is reused without clearing. Each ``fill`` then has to
            write all its bytes.

        Raises
        ------
        ValueError
            The sample is larger than DDS can send.
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


def write_cloud(
    writer: CdrWriter,
    columns: Mapping[str, NDArray[Any]],
    origin: tuple[float, float, float],
    frame_id: str = "",
    stamp_ns: int = 0,
) -> None:
    """Append a ``PointCloud2``; inside a cell, its header is empty, as in Autoware.

    Parameters
    ----------
    columns
        Columns of equal lengths; they are read when the message is assembled.
    origin
        Origin of ``xyz``, metres.
    frame_id, stamp_ns
        Frame and time of the header, nanoseconds since 1970.
    """
    layout, points = cloud_layout(columns), len(columns["xyz"])
    write_cloud_head(writer, layout, points, frame_id, stamp_ns)
    if points:
        fill = partial(fill_rows, columns=columns, origin=origin, layout=layout)
        writer.blob(points * layout.point_step, fill)
    writer.numbers("?", True)  # is_dense: every coordinate is finite


def write_cloud_head(
    writer: CdrWriter, layout: CloudLayout, points: int, frame_id: str = "", stamp_ns: int = 0
) -> None:
    """Append the part before the points: header, size, fields, and the number of their bytes."""
    writer.numbers("iI", stamp_ns // 10**9, stamp_ns % 10**9)
    writer.text(frame_id)
    writer.numbers("II", 1, points)  # height, width
    writer.prepared(_described(layout.fields, layout.point_step))
    writer.numbers("II", layout.point_step * points, layout.point_step * points)  # row_step, data's length


@lru_cache(maxsize=64)
def _described(fields: tuple[tuple[str, int, int, int], ...], point_step: int) -> bytes:
    """Return the fields of a cloud as bytes of its message, to be aligned to four."""
    writer = CdrWriter()
    writer.numbers("I", len(fields))
    for name, start, datatype, count in fields:
        writer.text(name)
        writer.numbers("IB", start, datatype)
        writer.numbers("I", count)
    writer.numbers("?", False)  # is_bigendian
    writer.numbers("I", point_step)
    return bytes(writer.content()[4:])
