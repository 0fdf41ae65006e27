# SPDX-License-Identifier: Apache-2.0
"""When a source file last changed, and the version of a cell that follows from it."""

from __future__ import annotations

import os
import struct

from xxhash import xxh3_64_intdigest

from shmmap.segment.layout import SourceStamp as Stamp

__all__ = ["Stamp", "cell_version"]


def cell_version(cell_id: str, stamp: Stamp) -> int:
    """Return the 64-bit version of a cell whose source carries ``stamp``.

    The recipe, so that another program can compute it: XXH3 (64 bit, seed 0) of the id's bytes as
    the file system has them (UTF-8), one zero byte, then ``size``, ``mtime_ns`` and ``ctime_ns`` as
    signed 64-bit little-endian integers.
    """
    return xxh3_64_intdigest(os.fsencode(cell_id) + b"\0" + struct.pack("<qqq", *stamp))
