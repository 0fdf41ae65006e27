# SPDX-License-Identifier: Apache-2.0
"""A ``binary_compressed`` PCD file larger than memory.

Its one LZF block holds whole fields one after the other, so the first point needs all of it.  It is
decompressed into a file without a name, mapped: the kernel writes its pages out and drops them when
memory is short.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shmmap.formats.causes import refusal
from shmmap.formats.pcd import lzf
from shmmap.formats.pcd.body import check_sizes, field_arrays
from shmmap.formats.pcd.fields import AXES
from shmmap.formats.pcd.reader import PcdReader
from shmmap.formats.pcd.table import coordinate_dtype

__all__ = ["expanded_blocks"]


def expanded_blocks(
    reader: PcdReader, scratch_dir: str, block_points: int, start: int = 0
) -> Iterator[dict[str, NDArray[Any]]]:
    """Yield the columns of the points from ``start`` on, points that are not finite included.

    Parameters
    ----------
    reader
        An open ``binary_compressed`` file.
    scratch_dir
        Directory of the file without a name, as large as the decompressed points.

    Raises
    ------
    MapDataError
        ``bad_lzf``, ``truncated`` or ``coordinate_range``.
    OSError
        The disk is full.
    """
    header = reader.header
    if start >= header.points:
        return
    size = os.fstat(reader.fileno()).st_size
    head = os.pread(reader.fileno(), 8, header.data_offset)
    body = header.data_offset + 8
    if len(head) < 8:
        raise refusal("truncated", "the file ends before its data", path=reader.path, offset=size)
    compressed_bytes, output_bytes = (int(part) for part in np.frombuffer(head, "<u4"))
    padded = check_sizes(header, compressed_bytes, output_bytes, left=size - body, path=reader.path)
    with tempfile.TemporaryFile(dir=scratch_dir) as file:
        os.posix_fallocate(file.fileno(), 0, output_bytes)  # a full disk is an error here, not a SIGBUS
        data = np.memmap(file, np.uint8, mode="r+", shape=(output_bytes,))
        packed = np.memmap(reader.path, np.uint8, mode="r", offset=body, shape=(compressed_bytes,))
        if not lzf.reachable(compressed_bytes, output_bytes) or not lzf.decompress(packed, data):
            raise refusal(
                "bad_lzf",
                f"{compressed_bytes} bytes do not decompress to {output_bytes}",
                path=reader.path,
                offset=body,
            )
        del packed
        fields = field_arrays(data, header, padded=padded)
        dtype = coordinate_dtype([fields[axis].dtype for axis in AXES])
        for at in range(start, header.points, block_points):
            stop = min(at + block_points, header.points)
            block = {"xyz": np.empty((stop - at, 3), dtype)}
            for axis, name in enumerate(AXES):
                reader.put_axis(block["xyz"], axis, np.array(fields[name][at:stop]))
            for spec in reader.columns[1:]:
                block[spec.name] = np.array(fields[spec.name][at:stop])
            yield block
