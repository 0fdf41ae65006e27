# SPDX-License-Identifier: Apache-2.0
"""When a source file last changed, and the version of a cell that follows from it."""

from __future__ import annotations

import os
import struct
from typing import NamedTuple

from xxhash import xxh3_64_intdigest

__all__ = ["Stamp", "cell_version"]


class Stamp(NamedTuple):
    """What ``stat`` says about a file's content without reading it.

    ``ctime_ns`` is what makes it sound: no program can set it back, so a rewrite that restores size
    and mtime (``cp -p``, ``rsync -t``) still shows.
    """

    size: int
    mtime_ns: int
    ctime_ns: int

    @classmethod
    def of(cls, status: os.stat_result) -> Stamp:
        """Stamp of a file from its `os.stat` or `os.fstat` result."""
        return cls(status.st_size, status.st_mtime_ns, status.st_ctime_ns)


def cell_version(cell_id: str, stamp: Stamp) -> int:
    """Return the 64-bit version of a cell whose source carries ``stamp``.

    The recipe, so that another program can compute it: XXH3 (64 bit, seed 0) of the id's bytes as
    the file system has them (UTF-8), one zero byte, then ``size``, ``mtime_ns`` and ``ctime_ns`` as
    signed 64-bit little-endian integers.
    """
    return xxh3_64_intdigest(os.fsencode(cell_id) + b"\0" + struct.pack("<qqq", *stamp))
